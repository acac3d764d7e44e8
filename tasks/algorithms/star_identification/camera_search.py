"""Camera search: the focal length of a camera, and which way its rows count, from single frames.

For a sensor that identifies nothing with the calibration it came with. Focal lengths are tried in
steps, those nearest to the told one first, each with rows that count down and up. Every trial is a
search lost in space, with errors that allow for half a step; the verdict pays for the number of
trials. The focal length then follows from the separations of the stars found.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.geometry.boresight import focal_length_from_separations
from epipole.tasks.algorithms.geometry.camera import Camera, mirrored, pixel_angle, unproject
from epipole.tasks.algorithms.star_identification.frames.field_of_view import field_of_view
from epipole.tasks.algorithms.star_identification.frames.frame import (
    FieldOfView,
    FrameCentroids,
    Search,
    Solution,
    aberrate_all,
    identify_lost,
    identify_predicted,
)
from epipole.tasks.algorithms.star_identification.sensor import Skies
from epipole.tasks.algorithms.star_identification.sky.camera_sky import Sky
from epipole.tasks.algorithms.star_identification.sky.pair_table import PairTable
from epipole.tasks.algorithms.star_identification.sky.sky_grid import SkyGrid

Array = npt.NDArray[np.float64]

STEP = 0.01  # of the logarithm of the focal length
BLOCK = 0.2  # trials within this share a sky: its depth and its pairs hardly depend on them
BRIGHTEST = 40  # centroids of a frame that take part
FEWEST = 6  # of a frame that is tried, and fewest stars of one that counts
UNKNOWN_SIGMA_PX = 0.5
SEARCH_S = 0.1  # of one trial, as in `Search.time_limit_s`
AROUND = 8  # steps on both sides of a trial that shows stars
REFINED = 4  # times: better focal lengths let more stars match


class ImageFrame(NamedTuple):
    """Centroids of one frame, brightest first.

    x_px, y_px, sigma_px, instrumental_mag : (n,) float; the last two are NaN where unknown
    beta : (3,) float, the sensor's barycentric velocity over that of light, ICRS axes
    """

    x_px: Array
    y_px: Array
    sigma_px: Array
    instrumental_mag: Array
    beta: Array


class FoundCamera(NamedTuple):
    """A camera with which a frame shows stars.

    camera : the told one with another focal length, or mirrored
    n_stars : identified in the frame
    frame : which one, a row of those that were given
    """

    camera: Camera
    n_stars: int
    frame: int


class _Sky(NamedTuple):
    """What trials of a block share."""

    sky: Sky
    grid: SkyGrid
    pairs: PairTable


def find_camera(
    frames: Sequence[ImageFrame],
    told: Camera,
    reach: float,
    skies_of: Callable[[float], Skies],
    how: Search,
) -> FoundCamera | None:
    """Return the camera with which the first frame of all that can be identified shows stars.

    Parameters
    ----------
    frames
        Tried one after the other.
    told
        Its focal lengths are scaled together; the rest is taken as it is.
    reach : float
        Largest factor, and the inverse of the smallest, by which focal lengths are tried.
    skies_of
        Skies for a pixel of this angle [rad].
    how
        Its false alarm probability is that of the whole call.
    """
    blocks = [list(block) for block in _blocks(np.log(reach))]
    n_trials = 2 * sum(map(len, blocks)) * max(len(frames), 1)
    how = how._replace(
        threshold=how.threshold + np.log(n_trials), time_limit_s=SEARCH_S, crowded=False
    )
    for k, frame in enumerate(frames):
        kept = _brightest(frame)
        if len(kept.x_px) < FEWEST:
            continue
        for block in blocks:
            shared = _shared_sky(kept, told, block, skies_of)
            for ratio in block:
                for camera in (_scaled(told, ratio), mirrored(_scaled(told, ratio))):
                    found = _try(kept, camera, shared, how)
                    if found is not None:
                        return FoundCamera(*found, k)
    return None


def agrees(
    frame: ImageFrame, camera: Camera, skies_of: Callable[[float], Skies], how: Search
) -> FoundCamera | None:
    """Return the camera as this frame shows it, within a step of `camera`, or None."""
    how = how._replace(time_limit_s=SEARCH_S, crowded=False)
    kept = _brightest(frame)
    if len(kept.x_px) < FEWEST:
        return None
    found = _try(kept, camera, _shared_sky(kept, camera, [1.0], skies_of), how)
    return None if found is None else FoundCamera(*found, 0)


def _blocks(reach: float) -> Iterator[Iterator[float]]:
    """Yield the ratios to try, in blocks; the nearest to 1 comes first."""
    steps = np.arange(-round(reach / STEP), round(reach / STEP) + 1) * STEP
    block = np.round(steps / BLOCK).astype(int)
    for number in sorted(set(block.tolist()), key=lambda b: (abs(b), b)):
        logs = steps[block == number]
        yield (float(np.exp(s)) for s in logs[np.argsort(np.abs(logs), kind="stable")])


def _scaled(camera: Camera, ratio: float) -> Camera:
    return camera._replace(fx_px=camera.fx_px * ratio, fy_px=camera.fy_px * ratio)


def _brightest(frame: ImageFrame) -> ImageFrame:
    at = np.flatnonzero(np.isfinite(frame.x_px) & np.isfinite(frame.y_px))[:BRIGHTEST]
    return ImageFrame(
        frame.x_px[at], frame.y_px[at], frame.sigma_px[at], frame.instrumental_mag[at], frame.beta
    )


def _shared_sky(
    frame: ImageFrame, told: Camera, ratios: Sequence[float],
    skies_of: Callable[[float], Skies],
) -> _Sky:  # fmt: skip
    """Return the sky, its grid and its pairs for all of these focal lengths."""
    wide, narrow = (field_of_view(_scaled(told, end(ratios))) for end in (min, max))
    middle = _scaled(told, float(np.median(ratios)))
    skies = skies_of(middle.pixel_rad)
    limit = skies.limit_for(1.2 * len(frame.x_px) / field_of_view(middle).solid_angle_sr)
    optics = FieldOfView(wide.half_diagonal_rad, narrow.box, middle.pixel_rad)
    radius = 9.0 * float(np.median(_sigma_px(frame, middle))) * wide.pixel_rad
    return _Sky(skies.sky(limit), skies.grid(limit, radius), skies.pairs(limit, optics))


def _sigma_px(frame: ImageFrame, camera: Camera) -> Array:
    """Return the errors of centroids where the focal length is off by up to half a step."""
    r = np.hypot(frame.x_px - camera.cx_px, frame.y_px - camera.cy_px)
    sigma = np.where(np.isnan(frame.sigma_px), UNKNOWN_SIGMA_PX, frame.sigma_px)
    return np.hypot(sigma, STEP / np.sqrt(12.0) * r)


def _try(frame: ImageFrame, camera: Camera, shared: _Sky, how: Search) -> tuple[Camera, int] | None:
    """Return the camera with a better focal length, and how many stars the frame shows."""
    solution = identify_lost(_seen_by(frame, camera), *shared, how)[0]
    if solution is None:
        return None
    # In dense fields, the middle of the image may fit with a focal length that is steps off.
    around = [_scaled(camera, float(np.exp(k * STEP))) for k in range(-AROUND, AROUND + 1)]
    near = [(c, _near(frame, c, solution, shared, how)) for c in around]
    camera, solution = max(near, key=lambda pair: -np.inf if pair[1] is None else pair[1].evidence)
    for _ in range(REFINED):
        if solution is None or np.sum(solution.star >= 0) < FEWEST:
            return None
        f, before = _focal_length(frame, camera, solution, shared.sky), solution.star
        if not np.isfinite(f):
            return None
        camera = _scaled(camera, f / camera.fx_px)
        solution = _near(frame, camera, solution, shared, how)
        if solution is not None and np.array_equal(solution.star, before):
            break
    return None if solution is None else (camera, int(np.sum(solution.star >= 0)))


def _near(
    frame: ImageFrame, camera: Camera, known: Solution, shared: _Sky, how: Search
) -> Solution | None:
    """Return the solution with this camera near one that is known."""
    centroids = _seen_by(frame, camera)
    near = np.eye(3) * (2.0 * float(np.median(centroids.sigma_rad))) ** 2
    return identify_predicted(centroids, shared.sky, known.R_sensor_from_icrs, near, how, lost=True)


def _seen_by(frame: ImageFrame, camera: Camera) -> FrameCentroids:
    u = unproject(camera, frame.x_px, frame.y_px)
    sigma = _sigma_px(frame, camera) * pixel_angle(camera, u)
    return FrameCentroids(u, sigma, frame.instrumental_mag, frame.beta, field_of_view(camera))


def _focal_length(frame: ImageFrame, camera: Camera, solution: Solution, sky: Sky) -> float:
    """Return the focal length with which the stars are as far apart as on the sky."""
    seen = solution.star >= 0
    u = unproject(camera, frame.x_px[seen], frame.y_px[seen])
    places = camera.fx_px * u[:, :2] / u[:, 2:]
    stars = aberrate_all(sky.catalogue.u_icrs[solution.star[seen]], frame.beta)
    return focal_length_from_separations(places, stars, camera.fx_px)
