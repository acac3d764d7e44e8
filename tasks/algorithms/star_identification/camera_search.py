"""Camera search: focal length, direction of rows and distortion of a camera, from single frames.

For a sensor that identifies nothing with its nominal calibration.

1. Focal lengths are tried in steps, the nearest to the nominal one first, each with rows that count
   down and up. A trial is a search lost in space with errors that allow for half a step; its
   threshold pays for the number of trials.
2. The focal length then follows from the separations of the matched stars.
3. With strong distortion, another focal length fits a ring of the image, or a cluster of stars fits
   alone. So where many centroids stay unmatched, k1 is fitted to the matched stars, then other
   values of k1 are tried, and the camera that matches most stars is taken.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array
from epipole.tasks.algorithms.geometry.boresight import focal_length_from_separations
from epipole.tasks.algorithms.geometry.camera import Camera, mirrored, pixel_angle, unproject
from epipole.tasks.algorithms.geometry.optics_calibration import fit_radial
from epipole.tasks.algorithms.star_identification.frame import (
    FieldOfView,
    FrameCentroids,
    MatchSettings,
    Solution,
    aberrate_all,
    field_of_view,
    identify_predicted,
    search_frame,
)
from epipole.tasks.algorithms.star_identification.sensor_model import Skies
from epipole.tasks.algorithms.star_identification.star_grid import Sky, SkyGrid
from epipole.tasks.algorithms.star_identification.star_pairs import PairTable

STEP = 0.01  # of the natural logarithm of the focal length, from trial to trial
BLOCK = 0.2  # of the same: trials of a block share a sky, whose depth and pairs hardly change
BRIGHTEST = 40  # centroids of a frame that take part
MIN_CENTROIDS = 6  # of a frame that is tried; also the minimum of matched stars
UNKNOWN_SIGMA_PX = 0.5  # error of centroids whose log states none
# Changes of k1 that are tried: relative change of the image's diagonal.
DISTORTIONS = (0.04, -0.04, 0.08, -0.08, 0.12, -0.12)
ENOUGH_MATCHED = 0.8  # share of the centroids; with more matched, no distortion is tried
MORE_STARS = 1.5  # stars matched by a better camera over those identified with the nominal one
DISTORTED_REACH = 0.08  # largest change of the logarithm in trials with distortion
STARS_PER_CENTROID = 1.2  # as a first guess, see `sensor`
TRIAL_TIME_LIMIT_S = 0.1  # of one trial, as `MatchSettings.time_limit_s`
# What the search may cost in a first frame, whatever the budget (CPU time by counted work). Cameras
# that are found cost at most 0.5 s; all trials of a frame of 40 points without stars cost 8 s, of
# one with centroid errors of 50 px a minute.
FIRST_FRAME_S = 5.0
STEPS_AROUND = 8  # on both sides of the focal length of a trial that matches stars
MAX_REFINEMENTS = 4  # of a focal length: with a better one, more stars match, which improve it


class ImageFrame(NamedTuple):
    """Centroids of one frame, brightest first.

    x_px, y_px, sigma_px, instrumental_mag : (n,) float; the last two are NaN where unknown
    beta : (3,) float, the sensor's barycentric velocity over that of light, ICRS axes
    n_stars : number identified with the nominal camera
    """

    x_px: Array
    y_px: Array
    sigma_px: Array
    instrumental_mag: Array
    beta: Array
    n_stars: int = 0


class FoundCamera(NamedTuple):
    """A camera with which stars of a frame are matched.

    camera : the nominal one with another focal length or k1, or mirrored
    n_stars : number of matched stars
    frame : row of the frame among those that were given
    """

    camera: Camera
    n_stars: int
    frame: int


class _BlockSky(NamedTuple):
    """The sky of a block of trials."""

    sky: Sky
    grid: SkyGrid
    pairs: PairTable


@dataclass
class _Trials:
    """What all trials share.

    skies_of : the skies for a pixel of this angle [rad]
    limit_s, cost_s : what the searches may cost, and have cost (CPU time by counted work)
    """

    skies_of: Callable[[float], Skies]
    matching: MatchSettings
    limit_s: float = math.inf
    cost_s: float = 0.0

    def is_spent(self) -> bool:
        return self.cost_s > self.limit_s


class _Match(NamedTuple):
    """A camera, and the stars of a frame that are matched with it."""

    camera: Camera
    solution: Solution
    sky: _BlockSky

    @property
    def n_stars(self) -> int:
        return int(np.sum(self.solution.star >= 0))


def find_cameras(
    frames: Sequence[ImageFrame],
    nominal: Camera,
    reach: float,
    skies_of: Callable[[float], Skies],
    matching: MatchSettings,
    budget_s: float = math.inf,
) -> Iterator[FoundCamera]:
    """Yield the camera that matches most stars of a frame, for each frame with one.

    It must match clearly more stars than are identified with the nominal camera.

    Parameters
    ----------
    frames
        Searched one after the other.
    nominal
        Its focal lengths are scaled together, and its k1 is changed; the rest is kept.
    reach : float
        Largest factor on the focal lengths that is tried; the smallest is its inverse.
    skies_of
        Skies for a pixel of this angle [rad].
    matching
        Its false alarm probability is that of all frames together.
    budget_s
        No further frame is searched once the searches have cost this (CPU time by counted work).
        The first one is always searched, until it has cost this and `FIRST_FRAME_S`.
    """
    log_reach = float(np.log(reach))
    n_distorted = len(DISTORTIONS) * _n_trials(min(log_reach, DISTORTED_REACH))
    n_trials = 2 * (_n_trials(log_reach) + n_distorted)  # rows count down and up
    matching = matching._replace(
        threshold=matching.threshold + np.log(n_trials * max(len(frames), 1)),
        time_limit_s=TRIAL_TIME_LIMIT_S,
        crowded=False,
    )
    trials = _Trials(skies_of, matching, max(budget_s, FIRST_FRAME_S))
    for k, frame in enumerate(frames):
        kept = _brightest(frame)
        if len(kept.x_px) < MIN_CENTROIDS:
            continue
        if trials.cost_s > budget_s:
            return
        found = _best_match(kept, nominal, log_reach, trials)
        if found is not None and found.n_stars >= MORE_STARS * frame.n_stars:
            yield FoundCamera(found.camera, found.n_stars, k)


def _best_match(
    frame: ImageFrame, nominal: Camera, log_reach: float, trials: _Trials
) -> _Match | None:
    """Return the camera that matches most stars; of equal ones the one with least changes.

    `log_reach` is the largest change of the logarithm of the focal length.
    """
    found, orientations = [], [nominal, mirrored(nominal)]
    plain = _first_match(frame, orientations, log_reach, trials)
    if plain is not None:
        found = [plain, _with_fitted_k1(frame, plain, trials.matching)]
        orientations = [plain.camera]
        if any(match.n_stars > ENOUGH_MATCHED * len(frame.x_px) for match in found):
            return max(found, key=attrgetter("n_stars"))
    for share in DISTORTIONS:
        distorted = [_distorted(camera, share) for camera in orientations]
        match = _first_match(frame, distorted, min(log_reach, DISTORTED_REACH), trials)
        if match is not None:
            found.append(_with_fitted_k1(frame, match, trials.matching))
    return max(found, key=attrgetter("n_stars"), default=None)


def _first_match(
    frame: ImageFrame, orientations: Sequence[Camera], log_reach: float, trials: _Trials
) -> _Match | None:
    """Return the camera with the first focal length that matches stars.

    None if no trial does, or if the trials have cost too much before. `orientations` are the camera
    with rows that count down and up, or only the right one.
    """
    for block in _blocks(log_reach):
        if trials.is_spent():
            return None
        ratios = list(block)
        shared = _shared_sky(frame, orientations[0], ratios, trials.skies_of)
        for ratio in ratios:
            for camera in orientations:
                if trials.is_spent():
                    return None
                found = _try(frame, _scaled(camera, ratio), shared, trials)
                if found is not None:
                    return found
    return None


def _with_fitted_k1(frame: ImageFrame, match: _Match, matching: MatchSettings) -> _Match:
    """Return the match with k1 and focal length fitted to its stars; the same if stars are lost."""
    best = match
    for _ in range(MAX_REFINEMENTS):
        seen = match.solution.star >= 0
        stars = match.sky.sky.catalogue.u_icrs[match.solution.star[seen]]
        u = aberrate_all(stars, frame.beta) @ match.solution.R_sensor_from_icrs.T
        camera = fit_radial(match.camera, frame.x_px[seen], frame.y_px[seen], u)
        solution = _near(frame, camera, match.solution, match.sky, matching)
        if solution is None:
            break
        match = match._replace(camera=camera, solution=solution)
        best = max(match, best, key=attrgetter("n_stars"))
    return best


def agreeing_camera(
    frame: ImageFrame, camera: Camera, skies_of: Callable[[float], Skies], matching: MatchSettings
) -> FoundCamera | None:
    """Return the camera that matches this frame, from one trial with `camera`; None if that fails.

    Its focal length may be some steps off.
    """
    matching = matching._replace(time_limit_s=TRIAL_TIME_LIMIT_S, crowded=False)
    kept = _brightest(frame)
    if len(kept.x_px) < MIN_CENTROIDS:
        return None
    shared = _shared_sky(kept, camera, [1.0], skies_of)
    found = _try(kept, camera, shared, _Trials(skies_of, matching))
    return None if found is None else FoundCamera(found.camera, found.n_stars, 0)


def _blocks(log_reach: float) -> Iterator[Iterator[float]]:
    """Yield the factors on the focal length to try, in blocks; the nearest to 1 comes first."""
    steps = np.arange(-round(log_reach / STEP), round(log_reach / STEP) + 1) * STEP
    block = np.round(steps / BLOCK).astype(int)
    for number in sorted(set(block.tolist()), key=lambda b: (abs(b), b)):
        logs = steps[block == number]
        yield (float(np.exp(s)) for s in logs[np.argsort(np.abs(logs), kind="stable")])


def _n_trials(log_reach: float) -> int:
    """Return how many focal lengths `_blocks` yields."""
    return 2 * round(log_reach / STEP) + 1


def _distorted(camera: Camera, share: float) -> Camera:
    """Return the camera with another k1: its image's diagonal grows by this share."""
    return camera._replace(k1=camera.k1 + share / camera.corner_distance**2)


def _scaled(camera: Camera, ratio: float) -> Camera:
    return camera._replace(fx_px=camera.fx_px * ratio, fy_px=camera.fy_px * ratio)


def _brightest(frame: ImageFrame) -> ImageFrame:
    at = np.flatnonzero(np.isfinite(frame.x_px) & np.isfinite(frame.y_px))[:BRIGHTEST]
    return frame._replace(
        x_px=frame.x_px[at], y_px=frame.y_px[at], sigma_px=frame.sigma_px[at],
        instrumental_mag=frame.instrumental_mag[at],
    )  # fmt: skip


def _shared_sky(
    frame: ImageFrame, nominal: Camera, ratios: Sequence[float],
    skies_of: Callable[[float], Skies],
) -> _BlockSky:  # fmt: skip
    """Return the sky, its grid and its pairs for the nominal focal length times any of `ratios`."""
    wide, narrow = (field_of_view(_scaled(nominal, end(ratios))) for end in (min, max))
    middle = _scaled(nominal, float(np.median(ratios)))
    skies = skies_of(middle.pixel_rad)
    n_stars = STARS_PER_CENTROID * len(frame.x_px)
    limit = skies.limit_for(n_stars / field_of_view(middle).solid_angle_sr)
    optics = FieldOfView(wide.half_diagonal_rad, narrow.box, middle.pixel_rad)
    radius = 9.0 * float(np.median(_sigma_px(frame, middle))) * wide.pixel_rad
    return _BlockSky(skies.sky(limit), skies.grid(limit, radius), skies.pairs(limit, optics))


def _sigma_px(frame: ImageFrame, camera: Camera) -> Array:
    """Return the errors of centroids [px] where the focal length is off by up to half a step."""
    r = np.hypot(frame.x_px - camera.cx_px, frame.y_px - camera.cy_px)
    sigma = np.where(np.isnan(frame.sigma_px), UNKNOWN_SIGMA_PX, frame.sigma_px)
    return np.hypot(sigma, STEP / np.sqrt(12.0) * r)  # sigma of a uniform error of that width


def _try(frame: ImageFrame, camera: Camera, shared: _BlockSky, trials: _Trials) -> _Match | None:
    """Return the camera with a refined focal length, and its match; None without one."""
    matching = trials.matching
    searched = search_frame(_seen_by(frame, camera), *shared, matching)
    trials.cost_s += searched.cost_s
    solution = searched.solution
    if solution is None:
        return None
    # In dense fields, the middle of the image may fit with a focal length that is steps off.
    around = [
        _scaled(camera, float(np.exp(k * STEP))) for k in range(-STEPS_AROUND, STEPS_AROUND + 1)
    ]
    near = [(c, _near(frame, c, solution, shared, matching)) for c in around]
    camera, solution = max(near, key=lambda pair: -np.inf if pair[1] is None else pair[1].evidence)
    for _ in range(MAX_REFINEMENTS):
        if solution is None or np.sum(solution.star >= 0) < MIN_CENTROIDS:
            return None
        f, before = _focal_length(frame, camera, solution, shared.sky), solution.star
        if not np.isfinite(f):
            return None
        camera = _scaled(camera, f / camera.fx_px)
        solution = _near(frame, camera, solution, shared, matching)
        if solution is not None and np.array_equal(solution.star, before):
            break
    return None if solution is None else _Match(camera, solution, shared)


def _near(
    frame: ImageFrame, camera: Camera, known: Solution, shared: _BlockSky, matching: MatchSettings
) -> Solution | None:
    """Return the solution with this camera near a known solution."""
    centroids = _seen_by(frame, camera)
    near = np.eye(3) * (2.0 * float(np.median(centroids.sigma_rad))) ** 2
    return identify_predicted(
        centroids, shared.sky, known.R_sensor_from_icrs, near, matching, lost=True
    )


def _seen_by(frame: ImageFrame, camera: Camera) -> FrameCentroids:
    """Return the frame as directions, if this is the camera."""
    u = unproject(camera, frame.x_px, frame.y_px)
    sigma = _sigma_px(frame, camera) * np.nan_to_num(pixel_angle(camera, u), nan=camera.pixel_rad)
    return FrameCentroids(u, sigma, frame.instrumental_mag, frame.beta, field_of_view(camera))


def _focal_length(frame: ImageFrame, camera: Camera, solution: Solution, sky: Sky) -> float:
    """Return the focal length [px] with which the stars are as far apart as on the sky."""
    seen = solution.star >= 0
    u = unproject(camera, frame.x_px[seen], frame.y_px[seen])
    positions = camera.fx_px * u[:, :2] / u[:, 2:]
    stars = aberrate_all(sky.catalogue.u_icrs[solution.star[seen]], frame.beta)
    return focal_length_from_separations(positions, stars, camera.fx_px)
