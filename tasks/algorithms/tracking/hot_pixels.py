"""Hot pixels: detections that stay at one pixel position while the sky moves through the image.

`fixed_positions` finds the positions that half of the frames show, and the odds that each is a hot
pixel. It certainly is one if it stays through a repointing, or a fast turn, that no object can
follow. Otherwise the centroids are the evidence (`log_ratio`), because a sensor that follows an
object keeps its light at one position too:

- Light scatters by the centroid error and drifts, as the sensor follows it imperfectly. It falls
  anywhere on a pixel, and near the middle of the field.
- A hot pixel has another scatter, mostly a small one, and does not drift. It lies at the centre of
  a pixel, anywhere in the field.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.tasks.algorithms.geometry.camera import Camera, unproject
from epipole.tasks.algorithms.geometry.directions import matrix_from_quaternion
from epipole.tasks.algorithms.tracking.sky_filter import acceleration

# Half and double of these were tried on the scenes of the tests. No scene depends on `OFF_MIDDLE`,
# `MIDDLE_PX`, `CENTRE`, `JEFFREYS`, `MIN_FRAMES`, `MIN_STILL`, `CERTAIN` or `MOTION_BOUND`: they
# matter with few frames, or for the odds alone. Of each other one, half or double fails a test.
SCALES = np.geomspace(0.01, 3.0, 200)  # of a position's scatter, over its stated sigmas
STATED_WITHIN = np.log(1.5)  # 1-sigma of ln of that scale for light: accuracy of the stated sigmas
# The same scale of a hot pixel: its ln is uniform between these.
MIN_HOT_SCALE, MAX_HOT_SCALE = 0.01, 2.0
OFF_MIDDLE = 0.1  # share of hot pixels that are not on a middle: two neighbours, for example
MIDDLE_PX = 0.02  # 1-sigma of the others: neighbouring pixels are slightly warm
FOLLOWED_STILL = 0.5  # share of followed objects that do not drift
FOLLOWED_ON_MIDDLE = 0.1  # share of followed objects that the sensor keeps on the middle of a pixel
AT_CENTRE = 0.5  # share of followed objects that are near the principal point
CENTRE = 0.1  # 1-sigma of their distance from it, in widths of the field
JEFFREYS = 0.5  # positions of each kind that are added to those counted: Jeffreys' prior
MIN_SHARE = 0.5  # minimum share of the frames, and of the pointings, that show a hot pixel
MIN_FRAMES = 5  # minimum number of frames that show a hot pixel
MIN_STILL = 10  # minimum number of detections if only the centroids are evidence
NOWHERE = -1
CERTAIN = np.log(1e4)  # from these odds on a position is a hot pixel, whatever other sensors detect
LIKELY = np.log(10.0)  # from these odds on it is one, unless another sensor detects an object there
REPOINTED_PX = 20.0  # minimum motion of the sky through the image at a repointing
MOTION_BOUND = 10.0  # times the bound on apparent motion: no object follows a repointing
FAST_TURN_RAD_S = 3e-3  # three times that of a low orbit: no object keeps it for long
HALF_TURN_RAD = np.pi


class FixedDetections(NamedTuple):
    """Detections at one position of the image.

    time_s, x_px, y_px, sigma_px : (n,) float
    reach_px : detections farther than this from the middle of all belong to no position
    """

    time_s: Array
    x_px: Array
    y_px: Array
    sigma_px: Array
    reach_px: float


class _Line(NamedTuple):
    """A straight line through the centroids of a position, about the middle of a pixel.

    offset, drift : (2,) float, mean position [px] and its rate [px/s]; variances for a scale of 1
    chi2, dof : chi-square and its degrees of freedom
    """

    offset: Array
    offset_variance: float
    drift: Array
    drift_variance: float
    chi2: float
    dof: int


def log_ratio(position: FixedDetections, camera: Camera, n_positions: int) -> float:
    """Return ln of the likelihood of a hot pixel over that of light.

    Parameters
    ----------
    position
        Detections at one position, at least three.
    n_positions
        Number of the sensor's positions that may be light. The sensor keeps at most one of them on
        the middle of a pixel.
    """
    line = _line(position)
    of_scatter = -line.dof * np.log(SCALES) - 0.5 * line.chi2 / SCALES**2
    offset2, drift2 = float(line.offset @ line.offset), float(line.drift @ line.drift)
    on_middle = _normal(offset2, line.offset_variance * SCALES**2 + MIDDLE_PX**2)
    still = _normal(drift2, line.drift_variance * SCALES**2)
    farthest = 2 * position.reach_px / max(float(np.ptp(position.time_s)), 1e-9)
    drifting = _normal(drift2, line.drift_variance * SCALES**2 + farthest**2)
    hot = np.logaddexp(np.log(OFF_MIDDLE), np.log(1 - OFF_MIDDLE) + on_middle) + still
    followed = FOLLOWED_ON_MIDDLE / n_positions
    light = np.logaddexp(np.log(1 - followed), np.log(followed) + on_middle)
    light += np.logaddexp(np.log(FOLLOWED_STILL) + still, np.log(1 - FOLLOWED_STILL) + drifting)
    steady = (SCALES >= MIN_HOT_SCALE) & (SCALES <= MAX_HOT_SCALE)
    as_stated = -0.5 * (np.log(SCALES) / STATED_WITHIN) ** 2
    hot = logsumexp((of_scatter + hot)[steady]) - np.log(np.sum(steady))
    light = logsumexp(of_scatter + light + as_stated) - logsumexp(as_stated)
    return float(hot - light - _nearness(position, camera))


def with_population(ratios: Array) -> Array:
    """Return ln of the odds of positions, from their log ratios and those of the other positions.

    The more of the other positions are hot pixels, the likelier each is one.
    """
    odds = np.zeros(len(ratios))
    for _ in range(100):
        hot = 1 / (1 + np.exp(-np.clip(ratios + odds, -50, 50)))
        others_hot, others_light = hot.sum() - hot, (1 - hot).sum() - (1 - hot)
        odds = np.log((others_hot + JEFFREYS) / (others_light + JEFFREYS))
    return np.asarray(ratios + odds)


def _line(position: FixedDetections) -> _Line:
    weight = position.sigma_px**-2.0
    offset = np.stack([position.x_px - np.round(position.x_px.mean()),
                    position.y_px - np.round(position.y_px.mean())], axis=1)  # fmt: skip
    total = weight.sum()
    mean = weight @ offset / total
    lever = position.time_s - weight @ position.time_s / total
    spread = max(float(weight @ lever**2), 1e-12)
    drift = (weight * lever) @ (offset - mean) / spread
    residual = offset - mean - lever[:, None] * drift
    chi2 = float(weight @ np.sum(residual**2, axis=1))
    return _Line(mean, 1 / total, drift, 1 / spread, chi2, 2 * len(weight) - 4)


def _normal(distance2: float, variance: Array) -> Array:
    """Return ln of the density of a normal distribution on the plane."""
    return np.asarray(-0.5 * distance2 / variance - np.log(2 * np.pi * variance))


def _nearness(position: FixedDetections, camera: Camera) -> float:
    """Return ln of the density of followed objects at a position over the mean of the field."""
    area, variance = camera.width * camera.height, (CENTRE * camera.width) ** 2
    distance2 = (position.x_px.mean() - camera.cx_px) ** 2 + (
        position.y_px.mean() - camera.cy_px
    ) ** 2
    near = np.exp(-0.5 * distance2 / variance) / (2 * np.pi * variance)
    return float(np.log(1 - AT_CENTRE + AT_CENTRE * area * near))


# Fixed positions


class FixedPositions(NamedTuple):
    """Pixel positions at which half of the frames have a detection.

    position : (n,) int, of each detection the index of its position; NOWHERE if at none of these
    log_odds : (p,) float, of each position ln of the odds that it is a hot pixel, not light;
        infinite if light cannot stay there, minus infinite without evidence of a hot pixel
    """

    position: Indices
    log_odds: Array

    def with_odds(self, min_odds: float) -> Flags:
        """Return which detections are at a position with at least these log-odds."""
        odds = np.append(self.log_odds, -np.inf)  # NOWHERE takes the last one
        return np.asarray(odds[self.position] >= min_odds)


def fixed_positions(
    frame: Indices,
    x_px: Array,
    y_px: Array,
    sigma_px: Array,
    time_s: Array,
    q_sensor_from_icrs: Array,
    camera: Camera,
) -> FixedPositions:
    """Return the positions with detections in half of the frames, and the odds of a hot pixel.

    Parameters
    ----------
    frame, x_px, y_px, sigma_px : (n,)
        Detections: their frame, position in the image and its 1-sigma error [px].
    time_s, q_sensor_from_icrs : (f,), (f, 4) float
        Frames, in time order: time [s] and attitude.
    camera
        The sensor's optics.

    Notes
    -----
    A sensor that follows an object keeps it at one position as well, and one with a fixed attitude
    keeps the stars. A position is certainly a hot pixel if it stays through repointings that no
    object follows, or through a fast turn of more than half a circle. Otherwise its centroids are
    the evidence: see `log_ratio`.
    """
    n_frames = len(time_s)
    position = np.full(len(frame), NOWHERE)
    if n_frames < MIN_FRAMES or not len(frame):
        return FixedPositions(position, np.zeros(0))
    reach = max(4 * float(np.median(sigma_px)), 0.25)
    R = matrix_from_quaternion(q_sensor_from_icrs)
    certain: list[bool] = []
    evidence: list[FixedDetections] = []
    for members in _find_positions(x_px, y_px, reach, (camera.width, camera.height), n_frames):
        frames_with = np.unique(frame[members])
        if len(frames_with) < max(MIN_SHARE * n_frames, MIN_FRAMES):
            continue
        position[members] = len(certain)
        x, y = x_px[members], y_px[members]
        where = unproject(camera, x.mean(keepdims=True), y.mean(keepdims=True))
        path = where[0] @ R  # the row form of R' u: the direction of the position in each frame
        certain.append(
            _stays_through_repointing(frames_with, _pointings(time_s, path, camera.pixel_rad))
            or _turns_fast(time_s, path)
        )
        evidence.append(FixedDetections(time_s[frame[members]], x, y, sigma_px[members], reach))
    return FixedPositions(position, _log_odds(np.array(certain, bool), evidence, camera))


def _log_odds(certain: Flags, positions: list[FixedDetections], camera: Camera) -> Array:
    """Return ln of the odds of each position that it is a hot pixel."""
    odds = np.where(certain, np.inf, -np.inf)
    testable = [k for k, position in enumerate(positions) if len(position.x_px) >= MIN_STILL]
    testable = [k for k in testable if not certain[k]]
    for k in testable:
        odds[k] = log_ratio(positions[k], camera, 1)
    # Hot pixels that hardly scatter are no evidence on positions that scatter as light does.
    uncertain = [k for k in testable if odds[k] < CERTAIN]
    ratios = np.array([log_ratio(positions[k], camera, len(uncertain)) for k in uncertain])
    odds[uncertain] = with_population(ratios)
    return odds


def _stays_through_repointing(frames_with: Indices, pointing: Indices) -> bool:
    """Return whether half of the frames have it in half of the pointings, and in two or more."""
    frames_in = np.bincount(pointing)
    in_pointing = (
        np.bincount(pointing[frames_with], minlength=len(frames_in)) >= MIN_SHARE * frames_in
    )
    return bool(in_pointing.sum() > 1 and in_pointing.mean() >= MIN_SHARE)


def _rates(time_s: Array, path: Array) -> tuple[Array, Array]:
    """Return the rates [rad/s] of a path on the sky from frame to frame, and the steps [s]."""
    dt = np.maximum(np.diff(time_s), 1e-9)
    return np.diff(path, axis=0) / dt[:, None], dt


def _pointings(time_s: Array, path: Array, pixel_rad: float) -> Indices:
    """Return the number of the pointing of each frame.

    Between two pointings the rate changes by more than the apparent motion of an object can. The
    frame at which it does belongs to the slower side: a slew is between two frames, and the first
    frame after it is of what the sensor looks at then.
    """
    rate, dt = _rates(time_s, path)
    change = np.linalg.norm(np.diff(rate, axis=0, prepend=rate[:1]), axis=1)
    speed = np.linalg.norm(rate, axis=1)
    bound = np.array([acceleration(r) for r in speed])
    # A repointing affects two rates. The smaller one is the possible rate of an object.
    bound[1:] = np.minimum(bound[1:], bound[:-1])
    jumped = change * dt > REPOINTED_PX * pixel_rad + MOTION_BOUND * bound * dt * dt
    at = np.flatnonzero(jumped)
    begins = np.zeros(len(time_s), bool)
    begins[np.where(speed[at - 1] <= speed[at], at + 1, at)] = True
    return np.cumsum(begins, dtype=np.int64)


def _turns_fast(time_s: Array, path: Array) -> bool:
    """Return whether a path is faster and longer than that of any object in orbit."""
    rate, dt = _rates(time_s, path)
    speed = np.linalg.norm(rate, axis=1)
    fast = speed > FAST_TURN_RAD_S
    return bool(np.sum(speed[fast] * dt[fast]) > HALF_TURN_RAD and np.mean(fast) > MIN_SHARE)


def _find_positions(
    x_px: Array, y_px: Array, reach_px: float, size_px: tuple[int, int], n_frames: int
) -> list[Indices]:
    """Return the detections of each position with detections in many frames."""
    cell = max(2 * reach_px, 1.0)
    width, height = (int(s / cell) + 3 for s in size_px)
    out: list[Indices] = []
    taken = np.zeros(len(x_px), bool)
    # Four grids half a cell apart: in one of them, a position is away from the edges of its cell.
    for shift_x, shift_y in ((0.5, 0.5), (1.0, 0.5), (0.5, 1.0), (1.0, 1.0)):
        column = np.clip(x_px / cell + shift_x, 0, width - 1).astype(np.int64)
        row = np.clip(y_px / cell + shift_y, 0, height - 1).astype(np.int64)
        index = row * width + column
        order = np.argsort(index, kind="stable")
        ordered = index[order]
        cells, count = np.unique(index[~taken], return_counts=True)
        for full in cells[count >= max(MIN_SHARE * n_frames, MIN_FRAMES)].tolist():
            inside = _in_cells(order, ordered, full, full)
            inside = inside[~taken[inside]]
            if not len(inside):  # they belong to a position in a neighbouring cell
                continue
            middle_x, middle_y = np.median(x_px[inside]), np.median(y_px[inside])
            # A position is at most half a cell wide on each side of its middle.
            around = [full + step * width for step in (-1, 0, 1)]
            near = np.concatenate([_in_cells(order, ordered, c - 1, c + 1) for c in around])
            near = np.sort(near)
            distance = np.hypot(x_px[near] - middle_x, y_px[near] - middle_y)
            members = near[(distance < reach_px) & ~taken[near]]
            taken[members] = True
            out.append(members)
    return out


def _in_cells(order: Indices, ordered: Indices, first: int, last: int) -> Indices:
    """Return the detections in the cells from `first` to `last`, of sorted cells."""
    lo, hi = np.searchsorted(ordered, [first, last + 1])
    return order[lo:hi]
