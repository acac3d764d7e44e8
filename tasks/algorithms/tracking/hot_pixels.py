"""Hot pixels: detections that stay at a place of the image while the sky moves through it."""

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.geometry.camera import Camera, unproject
from epipole.tasks.algorithms.geometry.rotations import matrix_from_quaternion
from epipole.tasks.algorithms.tracking.apparent_motion import acceleration

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

SHARE = 0.5  # least share of the frames, and of the pointings, that show a hot pixel
FEWEST = 5  # frames
FEWEST_STILL = 10  # frames, where only its steadiness is evidence
STEADY = 0.1  # most of the centroids' variance: light has all of it, a hot pixel none
NEAR_CHI2 = 11.8, 19.3  # of 2 degrees of freedom: 99.7 %; 99.994 % where there are many frames
CHANCE_OF_MIDDLE = 0.02  # accepted chance that light falls on the middle of a pixel
REPOINTED_PX = 20.0  # least motion of the sky through the image at a repointing
BOUND = 10.0  # times the bound on apparent motion: no object follows a repointing
FAST_TURN_RAD_S = 3e-3  # three times a low orbit's: no object is seen to keep it up
HALF_TURN_RAD = np.pi


def hot_pixels(
    frame: Indices,
    x_px: Array,
    y_px: Array,
    sigma_px: Array,
    time_s: Array,
    q_sensor_from_icrs: Array,
    camera: Camera,
) -> Flags:
    """Return which detections of one sensor are hot pixels.

    Parameters
    ----------
    frame, x_px, y_px, sigma_px : (n,)
        Detections: their frame, place in the image and its 1-sigma error [px].
    time_s, q_sensor_from_icrs : (f,), (f, 4) float
        Frames, in time order: time [s] and attitude.
    camera
        The sensor's optics.

    Notes
    -----
    A sensor that follows an object keeps it in place as well, and a sensor with a fixed attitude
    keeps the stars. So a place that is detected in half of all frames, within the centroids'
    error, is a hot pixel only where light cannot do the same. It stays through repointings that
    no object follows, or through a fast turn of more than half a circle; or it scatters less
    than light can; or it stays on the very middle of a pixel.
    """
    out = np.zeros(len(frame), bool)
    n_frames = len(time_s)
    if n_frames < FEWEST or not len(frame):
        return out
    reach = max(4 * float(np.median(sigma_px)), 0.25)
    R = matrix_from_quaternion(q_sensor_from_icrs)
    for members in _fixed_places(x_px, y_px, reach, (camera.width, camera.height), n_frames):
        shown = np.unique(frame[members])
        if len(shown) < max(SHARE * n_frames, FEWEST):
            continue
        place = unproject(
            camera, x_px[members].mean(keepdims=True), y_px[members].mean(keepdims=True)
        )
        path = place[0] @ R  # the row form of R' u: where the place pointed, frame by frame
        if (
            _stays_through_repointing(shown, _pointings(time_s, path, camera.pixel_rad))
            or _turns_fast(time_s, path)
            or _too_steady(x_px[members], y_px[members], sigma_px[members])
            or _is_one_pixel(
                time_s[frame[members]], x_px[members], y_px[members], sigma_px[members]
            )
        ):
            out[members] = True
    return out


def _stays_through_repointing(shown: Indices, pointing: Indices) -> bool:
    """Return whether half of the frames show it in half of the pointings, at least in two."""
    frames_in = np.bincount(pointing)
    shows = np.bincount(pointing[shown], minlength=len(frames_in)) >= SHARE * frames_in
    return bool(shows.sum() > 1 and shows.mean() >= SHARE)


def _too_steady(x_px: Array, y_px: Array, sigma_px: Array) -> bool:
    if len(x_px) < FEWEST_STILL:
        return False
    return bool(x_px.var() + y_px.var() < STEADY * 2 * np.mean(sigma_px**2))


def _is_one_pixel(time_s: Array, x_px: Array, y_px: Array, sigma_px: Array) -> bool:
    """Return whether a place is the middle of a pixel and has no drift, to a small error.

    Light falls anywhere on a pixel. It is so near the middle by chance in one of fifty cases at
    most. An object that the sensor follows drifts, if only a little.
    """
    n, sigma = len(x_px), float(np.sqrt(np.mean(sigma_px**2)))
    if n < FEWEST_STILL:
        return False
    least, most = NEAR_CHI2
    near = min(CHANCE_OF_MIDDLE * n / (np.pi * sigma**2), most)
    if near < least:
        return False
    off_x, off_y = x_px - np.round(x_px.mean()), y_px - np.round(y_px.mean())
    lever = time_s - time_s.mean()
    spread = max(float(lever @ lever), 1e-300)
    middle = n * (off_x.mean() ** 2 + off_y.mean() ** 2) / sigma**2
    drift = ((lever @ off_x) ** 2 + (lever @ off_y) ** 2) / (spread * sigma**2)
    return bool(middle < near and drift < 2 * near)


def _rates(time_s: Array, path: Array) -> tuple[Array, Array]:
    """Return the rates [rad/s] of a path on the sky from frame to frame, and the steps [s]."""
    dt = np.maximum(np.diff(time_s), 1e-9)
    return np.diff(path, axis=0) / dt[:, None], dt


def _pointings(time_s: Array, path: Array, pixel_rad: float) -> Indices:
    """Return a number for each frame that rises wherever the sensor was repointed.

    Repointed: the rate changed by more than an object's apparent motion can.
    """
    rate, dt = _rates(time_s, path)
    change = np.linalg.norm(np.diff(rate, axis=0, prepend=rate[:1]), axis=1)
    bound = np.array([acceleration(r) for r in np.linalg.norm(rate, axis=1)])
    # A repointing enters two rates. The smaller one is the rate an object may have had.
    bound[1:] = np.minimum(bound[1:], bound[:-1])
    jumped = change * dt > REPOINTED_PX * pixel_rad + BOUND * bound * dt * dt
    return np.concatenate([[0], np.cumsum(jumped)]).astype(np.int64)


def _turns_fast(time_s: Array, path: Array) -> bool:
    """Return whether a path is faster and longer than that of any object in orbit."""
    rate, dt = _rates(time_s, path)
    speed = np.linalg.norm(rate, axis=1)
    fast = speed > FAST_TURN_RAD_S
    return bool(np.sum(speed[fast] * dt[fast]) > HALF_TURN_RAD and np.mean(fast) > SHARE)


def _fixed_places(
    x_px: Array, y_px: Array, reach_px: float, size_px: tuple[int, int], n_frames: int
) -> list[Indices]:
    """Return the detections at each place that has some in many frames; each place once."""
    cell = max(2 * reach_px, 1.0)
    width, height = (int(s / cell) + 3 for s in size_px)
    out: list[Indices] = []
    taken = np.zeros(len(x_px), bool)
    # Four grids half a cell apart: in one of them, a place is away from the edges of its cell.
    for shift_x, shift_y in ((0.5, 0.5), (1.0, 0.5), (0.5, 1.0), (1.0, 1.0)):
        column = np.clip(x_px / cell + shift_x, 0, width - 1).astype(np.int64)
        row = np.clip(y_px / cell + shift_y, 0, height - 1).astype(np.int64)
        index = row * width + column
        count = np.bincount(index[~taken], minlength=width * height)
        for busy in np.flatnonzero(count >= max(SHARE * n_frames, FEWEST)):
            inside = np.flatnonzero((index == busy) & ~taken)
            if not len(inside):  # they belong to a place in a neighbouring cell
                continue
            middle_x, middle_y = np.median(x_px[inside]), np.median(y_px[inside])
            near = np.hypot(x_px - middle_x, y_px - middle_y) < reach_px
            members = np.flatnonzero(near & ~taken)
            taken[members] = True
            out.append(members)
    return out
