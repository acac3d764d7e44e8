"""Camera search: the focal length of a camera, which way its rows count, and its distortion, from
single frames.

For a sensor that identifies nothing with the calibration it came with. Focal lengths are tried in
steps, those nearest to the told one first, each with rows that count down and up. Every trial is a
search lost in space, with errors that allow for half a step; the verdict pays for the number of
trials. The focal length then follows from the separations of the stars found.

With strong distortion, another focal length fits a ring of the image, or a cluster of stars fits
alone. So where many centroids are left over, k1 is fitted to the stars that were found, then other
values of k1 are tried, and the camera that shows most stars is taken.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.geometry.boresight import focal_length_from_separations
from epipole.tasks.algorithms.geometry.camera import Camera, mirrored, pixel_angle, unproject
from epipole.tasks.algorithms.geometry.optics_calibration import fit_radial
from epipole.tasks.algorithms.star_identification.frame import (
    FieldOfView,
    FrameCentroids,
    Search,
    Solution,
    aberrate_all,
    field_of_view,
    identify_lost,
    identify_predicted,
)
from epipole.tasks.algorithms.star_identification.reidentify_poor_frames import Skies
from epipole.tasks.algorithms.star_identification.star_grid import Sky, SkyGrid
from epipole.tasks.algorithms.star_identification.star_pairs import PairTable

Array = npt.NDArray[np.float64]

STEP = 0.01  # of the logarithm of the focal length
BLOCK = 0.2  # trials within this share a sky: its depth and its pairs hardly depend on them
BRIGHTEST = 40  # centroids of a frame that take part
FEWEST = 6  # of a frame that is tried, and fewest stars of one that counts
UNKNOWN_SIGMA_PX = 0.5
# Tried changes of k1: how much longer or shorter they make the image's diagonal.
DISTORTIONS = (0.04, -0.04, 0.08, -0.08, 0.12, -0.12)
MAX_SHOWN = 0.8  # share of the centroids that are stars: no distortion is tried
MORE_STARS = 1.5  # times as many as with the told camera are shown by a better one
DISTORTED_REACH = 0.08  # of the logarithm of the focal length, with distortion
SEARCH_S = 0.1  # of one trial, as in `Search.time_limit_s`
AROUND = 8  # steps on both sides of a trial that shows stars
REFINED = 4  # times: better focal lengths let more stars match


class ImageFrame(NamedTuple):
    """Centroids of one frame, brightest first.

    x_px, y_px, sigma_px, instrumental_mag : (n,) float; the last two are NaN where unknown
    beta : (3,) float, the sensor's barycentric velocity over that of light, ICRS axes
    n_stars : identified with the told camera
    """

    x_px: Array
    y_px: Array
    sigma_px: Array
    instrumental_mag: Array
    beta: Array
    n_stars: int = 0


class FoundCamera(NamedTuple):
    """A camera with which a frame shows stars.

    camera : the told one with another focal length or k1, or mirrored
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


class _Trials(NamedTuple):
    """What all trials share."""

    skies_of: Callable[[float], Skies]
    how: Search


class _Shown(NamedTuple):
    """A camera, and the stars that a frame shows with it."""

    camera: Camera
    solution: Solution
    sky: _Sky

    @property
    def n_stars(self) -> int:
        return int(np.sum(self.solution.star >= 0))


def _n_stars(shown: _Shown) -> int:
    return shown.n_stars


def find_cameras(
    frames: Sequence[ImageFrame],
    told: Camera,
    reach: float,
    skies_of: Callable[[float], Skies],
    how: Search,
) -> Iterator[FoundCamera]:
    """Yield the camera with which each frame shows most stars, for the frames that show some.

    A frame's stars must be more than those that are identified with the told camera.

    Parameters
    ----------
    frames
        Tried one after the other.
    told
        Its focal lengths are scaled together, and its k1 is changed; the rest is taken as it is.
    reach : float
        Largest factor, and the inverse of the smallest, by which focal lengths are tried.
    skies_of
        Skies for a pixel of this angle [rad].
    how
        Its false alarm probability is that of all frames together.
    """
    reach = float(np.log(reach))
    n_trials = 2 * (_n_trials(reach) + len(DISTORTIONS) * _n_trials(min(reach, DISTORTED_REACH)))
    how = how._replace(
        threshold=how.threshold + np.log(n_trials * max(len(frames), 1)),
        time_limit_s=SEARCH_S,
        crowded=False,
    )
    for k, frame in enumerate(frames):
        kept = _brightest(frame)
        if len(kept.x_px) < FEWEST:
            continue
        found = _most_shown(kept, told, reach, _Trials(skies_of, how))
        if found is not None and found.n_stars >= MORE_STARS * frame.n_stars:
            yield FoundCamera(found.camera, found.n_stars, k)


def _most_shown(frame: ImageFrame, told: Camera, reach: float, trials: _Trials) -> _Shown | None:
    """Return the camera that shows most stars, the one with fewest changes of these."""
    found, sides = [], [told, mirrored(told)]
    plain = _first_shown(frame, sides, reach, trials)
    if plain is not None:
        found, sides = [plain, _with_fitted_k1(frame, plain, trials.how)], [plain.camera]
        if any(shown.n_stars > MAX_SHOWN * len(frame.x_px) for shown in found):
            return max(found, key=_n_stars)
    for share in DISTORTIONS:
        distorted = [_distorted(side, share) for side in sides]
        shown = _first_shown(frame, distorted, min(reach, DISTORTED_REACH), trials)
        if shown is not None:
            found.append(_with_fitted_k1(frame, shown, trials.how))
    return max(found, key=_n_stars, default=None)


def _first_shown(
    frame: ImageFrame, sides: Sequence[Camera], reach: float, trials: _Trials
) -> _Shown | None:
    """Return the camera with the first focal length that shows stars.

    `sides` are cameras whose rows count down or up.
    """
    for block in _blocks(reach):
        ratios = list(block)
        shared = _shared_sky(frame, sides[0], ratios, trials.skies_of)
        for ratio in ratios:
            for side in sides:
                found = _try(frame, _scaled(side, ratio), shared, trials.how)
                if found is not None:
                    return found
    return None


def _with_fitted_k1(frame: ImageFrame, shown: _Shown, how: Search) -> _Shown:
    """Return the camera with k1 and focal length fitted to the stars, if it shows no fewer then."""
    best = shown
    for _ in range(REFINED):
        seen = shown.solution.star >= 0
        stars = shown.sky.sky.catalogue.u_icrs[shown.solution.star[seen]]
        u = aberrate_all(stars, frame.beta) @ shown.solution.R_sensor_from_icrs.T
        camera = fit_radial(shown.camera, frame.x_px[seen], frame.y_px[seen], u)
        solution = _near(frame, camera, shown.solution, shown.sky, how)
        if solution is None:
            break
        shown = shown._replace(camera=camera, solution=solution)
        best = max(shown, best, key=_n_stars)
    return best


def agrees(
    frame: ImageFrame, camera: Camera, skies_of: Callable[[float], Skies], how: Search
) -> FoundCamera | None:
    """Return the camera as this frame shows it, within a step of `camera`, or None."""
    how = how._replace(time_limit_s=SEARCH_S, crowded=False)
    kept = _brightest(frame)
    if len(kept.x_px) < FEWEST:
        return None
    found = _try(kept, camera, _shared_sky(kept, camera, [1.0], skies_of), how)
    return None if found is None else FoundCamera(found.camera, found.n_stars, 0)


def _blocks(reach: float) -> Iterator[Iterator[float]]:
    """Yield the ratios to try, in blocks; the nearest to 1 comes first."""
    steps = np.arange(-round(reach / STEP), round(reach / STEP) + 1) * STEP
    block = np.round(steps / BLOCK).astype(int)
    for number in sorted(set(block.tolist()), key=lambda b: (abs(b), b)):
        logs = steps[block == number]
        yield (float(np.exp(s)) for s in logs[np.argsort(np.abs(logs), kind="stable")])


def _n_trials(reach: float) -> int:
    return 2 * round(reach / STEP) + 1


def _distorted(camera: Camera, share: float) -> Camera:
    """Return the camera with another k1: its image's diagonal grows by this share."""
    return camera._replace(k1=camera.k1 + share / float(np.tan(camera.half_diagonal_rad)) ** 2)


def _scaled(camera: Camera, ratio: float) -> Camera:
    return camera._replace(fx_px=camera.fx_px * ratio, fy_px=camera.fy_px * ratio)


def _brightest(frame: ImageFrame) -> ImageFrame:
    at = np.flatnonzero(np.isfinite(frame.x_px) & np.isfinite(frame.y_px))[:BRIGHTEST]
    return frame._replace(
        x_px=frame.x_px[at], y_px=frame.y_px[at], sigma_px=frame.sigma_px[at],
        instrumental_mag=frame.instrumental_mag[at],
    )  # fmt: skip


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


def _try(frame: ImageFrame, camera: Camera, shared: _Sky, how: Search) -> _Shown | None:
    """Return the camera with a better focal length, and the stars that the frame shows."""
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
    return None if solution is None else _Shown(camera, solution, shared)


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
