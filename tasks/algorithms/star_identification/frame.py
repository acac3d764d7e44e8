"""One frame: its centroids, its solution near a prediction, and its search lost in space."""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.geometry.camera import Camera, undistort
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.star_identification.evidence import (
    TYPICAL_SPREAD_MAG,
    MatchRule,
    chance_margin,
)
from epipole.tasks.algorithms.star_identification.search.crowded_frames import search_crowded
from epipole.tasks.algorithms.star_identification.search.lost_in_space import WORK_PER_S, search
from epipole.tasks.algorithms.star_identification.search.match_stars import (
    Attitude,
    Centroids,
    Matches,
    solve_predicted,
    stars_about,
)
from epipole.tasks.algorithms.star_identification.search.pair_hypotheses import (
    Image,
    Problem,
    SearchLimits,
    Stars,
)
from epipole.tasks.algorithms.star_identification.star_grid import Sky, SkyGrid
from epipole.tasks.algorithms.star_identification.star_pairs import PairTable

# -- Clusters of false centroids: a reflection, a bright object's halo, a damaged part of the chip.

Rows = npt.NDArray[np.int64]

CELLS = 8  # along each side of the image
# A cell may hold so many centroids, or so many times as many as the median cell.
FEW, TIMES = 4, 3


def thinned(u: npt.NDArray[np.float64], box: npt.NDArray[np.float64]) -> Rows:
    """Return the rows of centroids without most of those of crowded cells.

    Parameters
    ----------
    u : (n, 3) float
        Directions in the sensor frame, brightest first: the brightest of a cell are kept.
    box : (4,) float
        x0, x1, y0, y1 of the image in normalised coordinates.
    """
    at = (u[:, :2] / u[:, 2:] - box[[0, 2]]) / (box[[1, 3]] - box[[0, 2]])
    row, column = np.clip(CELLS * at, 0, CELLS - 1).astype(np.int64).T
    cell = row * CELLS + column
    count = np.bincount(cell, minlength=CELLS * CELLS)
    order = np.argsort(cell, kind="stable")
    rank = np.empty(len(cell), np.int64)
    rank[order] = np.arange(len(cell)) - (np.cumsum(count) - count)[cell[order]]
    return np.flatnonzero(rank < max(FEW, TIMES * np.median(count)))


# -- One frame: its centroids, its solution near a prediction, and its search lost in space.

Array = npt.NDArray[np.float64]

# Lost in space, this is taken off the threshold at most: see `chance_margin`.
LOST_MARGIN = 6.0
# The best attitude must be this much (in log) more probable than any other.
CLEAR_LEAD = 7.0
# Prior odds (ln) that a frame has enough stars to be identified: at most 99 in 100 frames do.
MAX_STARLIT = 4.6
# Brightest centroids that are used in a search of the whole sky, that are paired, and that each
# hypothesis is tried on; where half of them are stars.
N_SEARCHED, N_PATTERN, N_TRIED, STAR_SHARE = 200, 40, 64, 0.5
# The same where that fails, for frames of which most centroids are no stars: all are paired.
N_CROWDED, MIN_STARS = 1024, 8.0
CLUSTERED = 0.75  # of the centroids are left without clusters: then these are searched first
CROWDED_TIMES = 10.0  # as long as another search: hardly any pivot is a star


class FieldOfView(NamedTuple):
    """A camera's field.

    half_diagonal_rad : from the boresight to the farthest corner
    box : (4,) float, x0, x1, y0, y1 of the image in normalised coordinates
    pixel_rad : angle of a pixel at the boresight
    """

    half_diagonal_rad: float
    box: Array
    pixel_rad: float

    @property
    def solid_angle_sr(self) -> float:
        """Solid angle of the image, small-field."""
        return float((self.box[1] - self.box[0]) * (self.box[3] - self.box[2]))


class FrameCentroids(NamedTuple):
    """Centroids of one frame, brightest first.

    u : (n, 3) float, directions, sensor frame
    sigma_rad : (n,) float, error an axis
    instrumental_mag : (n,) float, -2.5 log10 flux; NaN where unknown
    beta : (3,) float, the sensor's barycentric velocity over that of light, ICRS axes
    optics : of the camera
    """

    u: Array
    sigma_rad: Array
    instrumental_mag: Array
    beta: Array
    optics: FieldOfView


class Solution(NamedTuple):
    """An identified frame.

    R_sensor_from_icrs, cov_rad2 : (3, 3), (3, 3); covariance about the sensor axes
    star : (n,) int64, row of the sky's catalogue for each centroid, -1 none
    chi2 : (n,) float, squared distance over sigma squared, where there is a star
    evidence : float, log evidence (see `evidence`)
    """

    R_sensor_from_icrs: Array
    cov_rad2: Array
    star: npt.NDArray[np.int64]
    chi2: Array
    evidence: float


class Search(NamedTuple):
    """How a frame is judged.

    gate_sigma : a centroid lies within this of its star's place
    threshold : least log evidence, ln(1 / false alarm probability)
    time_limit_s : CPU time of one search lost in space
    zero_point_mag : star minus instrumental magnitude; NaN while unknown
    spread_mag : its scatter, 1-sigma
    starlit : prior odds (ln) that a frame has enough stars to be identified, as the sensor's other
        frames show; of an unknown sensor even ones
    crowded : where a search fails, the frame is searched again as one that shows few stars among
        many other centroids
    """

    gate_sigma: float
    threshold: float
    time_limit_s: float
    zero_point_mag: float
    spread_mag: float = TYPICAL_SPREAD_MAG
    crowded: bool = True
    starlit: float = 0.0

    @property
    def least_lost(self) -> float:
        """Least log evidence of an attitude that was searched lost in space."""
        return self.threshold - LOST_MARGIN - min(max(self.starlit, 0.0), MAX_STARLIT)


class Verdict(NamedTuple):
    """The result of a search.

    is_clear : the attitude is beyond doubt
    R_sensor_from_icrs : (3, 3), of the best hypothesis
    evidence, runner_up : log evidence of the best and of the best different attitude
    exhausted : the search ended because its bound was reached
    """

    is_clear: bool
    R_sensor_from_icrs: Array
    evidence: float
    runner_up: float
    exhausted: bool


def rule_of(how: Search, sky: Sky) -> MatchRule:
    """Return the rule for matches as the kernels take it."""
    return MatchRule(
        how.gate_sigma, sky.log_density, how.zero_point_mag, how.spread_mag, how.threshold,
        how.threshold + CLEAR_LEAD,
    )  # fmt: skip


def identify_predicted(
    frame: FrameCentroids, sky: Sky, R0: Array, P0: Array, how: Search, lost: bool = False
) -> Solution | None:
    """Return the solution near a predicted attitude, None where the stars do not confirm one.

    Parameters
    ----------
    R0, P0 : (3, 3), (3, 3) float
        Prediction (sensor from ICRS) and its covariance about the sensor axes [rad^2].
    lost
        The prediction came from a search of the whole sky.
    """
    n = len(frame.u)
    if n < 3:
        return None
    stars = sky.catalogue
    reach = frame.optics.half_diagonal_rad + 4.0 * math.sqrt(max(P0[0, 0], P0[1, 1])) + 1e-4
    seen, row = stars_about(sky.bands, stars.magnitude, R0, min(reach, 1.5), frame.beta)
    if len(row) < 3:
        return None
    R, P = np.empty((3, 3)), np.empty((3, 3))
    star, chi2 = np.full(n, -1, np.int64), np.zeros(n)
    evidence = solve_predicted(
        Attitude(R0, P0), lost, Centroids(*frame[:4]), seen, frame.optics.box, rule_of(how, sky),
        Attitude(R, P), Matches(star, chi2),
    )  # fmt: skip
    in_view = sky.rho * frame.optics.solid_angle_sr
    if not evidence > (_least_of_lost(star, evidence, in_view, how) if lost else how.threshold):
        return None
    return Solution(R, P, np.where(star >= 0, row[star], -1), chi2, evidence)


def _least_of_lost(
    star: npt.NDArray[np.int64], evidence: float, in_view: float, how: Search
) -> float:
    """Return the least evidence of an attitude with these matches that was searched lost in
    space."""
    if not evidence > how.least_lost:
        return how.threshold
    margin = chance_margin(np.count_nonzero(star >= 0), len(star), in_view)
    return float(how.least_lost + LOST_MARGIN - min(margin, LOST_MARGIN))


def aberrate_all(u_icrs: Array, beta: Array) -> Array:
    """Return the directions an observer at beta (v / c) sees: `sky.aberrate` for one velocity."""
    out = np.empty_like(u_icrs)
    p = u_icrs @ beta
    g = np.sqrt(1.0 - beta @ beta)
    out[:] = g * u_icrs + (1.0 + p / (1.0 + g))[:, None] * beta
    return out / np.linalg.norm(out, axis=1, keepdims=True)


def search_lost(
    frame: FrameCentroids, sky: Sky, grid: SkyGrid, pairs: PairTable, how: Search
) -> Verdict:
    """Search the whole sky for the frame's attitude; see `lost_in_space.search`."""
    # Centroids far outside any image have no direction.
    at = np.flatnonzero(np.isfinite(frame.u[:, 0]))
    if len(at) > N_PATTERN:
        spread = at[thinned(frame.u[at], frame.optics.box)]
        if len(spread) < CLUSTERED * len(at):
            verdict = _search(
                some_centroids(frame, spread[:N_SEARCHED]), sky, grid, pairs, how, False
            )
            if verdict.is_clear:
                return verdict
    verdict = _search(some_centroids(frame, at[:N_SEARCHED]), sky, grid, pairs, how, crowded=False)
    if verdict.is_clear or not how.crowded or len(at) <= N_PATTERN:
        return verdict
    return _search(some_centroids(frame, at[:N_CROWDED]), sky, grid, pairs, how, crowded=True)


def some_centroids(frame: FrameCentroids, at: npt.NDArray[np.int64]) -> FrameCentroids:
    """Return the frame with these of its centroids."""
    return frame._replace(
        u=frame.u[at], sigma_rad=frame.sigma_rad[at], instrumental_mag=frame.instrumental_mag[at]
    )


def _search(
    frame: FrameCentroids, sky: Sky, grid: SkyGrid, pairs: PairTable, how: Search, crowded: bool
) -> Verdict:
    if len(frame.u) < 3:
        return Verdict(False, np.eye(3), -np.inf, -np.inf, False)
    R, least = np.zeros((3, 3)), how.least_lost
    problem = problem_of(frame, sky, grid, pairs, how, crowded)
    best, runner_up, work = search_crowded(problem, R) if crowded else search(problem, R)
    is_clear = best > least and best - runner_up > CLEAR_LEAD
    return Verdict(is_clear, R, best, runner_up, work > problem.limits.budget)


def problem_of(
    frame: FrameCentroids, sky: Sky, grid: SkyGrid, pairs: PairTable, how: Search, crowded: bool
) -> Problem:
    """Return a frame whose attitude is searched for over the whole sky, as the kernels take it."""
    n, least, area = len(frame.u), how.least_lost, frame.optics.solid_angle_sr
    min_chord = max(0.05 * frame.optics.half_diagonal_rad, 6.0 * _middle(frame.sigma_rad))
    budget = how.time_limit_s * WORK_PER_S
    if crowded:
        share = min(MIN_STARS / n, STAR_SHARE)
        limits = SearchLimits(min_chord, n, n, share, CROWDED_TIMES * budget)
    else:
        limits = SearchLimits(min_chord, N_PATTERN, N_TRIED, STAR_SHARE, budget)
    return Problem(
        Centroids(*frame[:4]),
        Stars(sky.catalogue.u_icrs, sky.catalogue.magnitude, grid, sky.bands),
        pairs,
        Image(frame.optics.box, area, sky.rho * area),
        rule_of(how, sky)._replace(least=least, enough=least + CLEAR_LEAD + 2.0),
        limits,
    )


def _middle(values: Array) -> float:
    """Return the upper median: `np.median` takes longer than all else around the kernels."""
    return float(np.sort(values)[len(values) // 2])


@kernel
def _search_and_solve(problem, reach, R_found, solution, matches):
    """Search a frame and match all its stars, in one call: each takes as long to call as to run.

    Returns evidence, runner-up's evidence and work of the search, and the evidence of the
    solution, which is written as by `solve_predicted` (compiled).
    """
    best, runner_up, work = search(problem, R_found)
    if not (best > problem.rule.least and best - runner_up > CLEAR_LEAD):
        return best, runner_up, work, -1e9
    centroids = problem.centroids
    sigma = 2.0 * np.sort(centroids.sigma)[len(centroids.sigma) // 2]
    near = Attitude(R_found, np.eye(3) * (sigma * sigma))
    stars, wide = problem.stars, min(reach + 4.0 * sigma, 1.5)
    seen, row = stars_about(stars.bands, stars.magnitude, R_found, wide, centroids.beta)
    if len(row) < 3:
        return best, runner_up, work, -1e9
    evidence = solve_predicted(
        near, True, centroids, seen, problem.image.box, problem.rule, solution, matches
    )
    for k in range(len(matches.star)):
        if matches.star[k] >= 0:
            matches.star[k] = row[matches.star[k]]
    return best, runner_up, work, evidence


def _identify_few(
    frame: FrameCentroids, sky: Sky, grid: SkyGrid, pairs: PairTable, how: Search
) -> tuple[Solution | None, bool]:
    """Return the same as `identify_lost` for a frame that is no crowd."""
    problem = problem_of(frame, sky, grid, pairs, how, crowded=False)
    n = len(frame.u)
    R, P = np.empty((3, 3)), np.empty((3, 3))
    star, chi2 = np.full(n, -1, np.int64), np.zeros(n)
    reach = frame.optics.half_diagonal_rad + 1e-4
    best, runner_up, work, evidence = _search_and_solve(
        problem, reach, np.zeros((3, 3)), Attitude(R, P), Matches(star, chi2)
    )
    if not (best > how.least_lost and best - runner_up > CLEAR_LEAD):
        return None, work > problem.limits.budget
    if not evidence > _least_of_lost(star, evidence, problem.image.in_view, how):
        return None, False
    return Solution(R, P, star, chi2, evidence), False


def identify_lost(
    frame: FrameCentroids, sky: Sky, grid: SkyGrid, pairs: PairTable, how: Search
) -> tuple[Solution | None, bool]:
    """Return the solution without a prior, None where no attitude is beyond doubt, and whether the
    search reached its time limit."""
    if 3 <= len(frame.u) <= N_PATTERN and np.isfinite(frame.u).all():
        return _identify_few(frame, sky, grid, pairs, how)
    verdict = search_lost(frame, sky, grid, pairs, how)
    if not verdict.is_clear:
        return None, verdict.exhausted
    near = np.eye(3) * (2.0 * _middle(frame.sigma_rad)) ** 2
    return identify_predicted(frame, sky, verdict.R_sensor_from_icrs, near, how, lost=True), False


# -- The field of view of a camera, with its distortion.

EDGE_POINTS = 9  # of each edge of the image


def field_of_view(camera: Camera) -> FieldOfView:
    """Return the half diagonal and the box of the image in normalised coordinates."""
    n = EDGE_POINTS
    side = np.linspace(-0.5, camera.width - 0.5, n)
    down = np.linspace(-0.5, camera.height - 0.5, n)
    x_px = np.concatenate([side, side, np.full(n, side[0]), np.full(n, side[-1])])
    y_px = np.concatenate([np.full(n, down[0]), np.full(n, down[-1]), down, down])
    x, y = undistort(
        camera, (x_px - camera.cx_px) / camera.fx_px, (y_px - camera.cy_px) / camera.fy_px
    )
    half_diagonal = float(np.arctan(np.max(np.hypot(x, y))))
    return FieldOfView(
        half_diagonal, np.array([x.min(), x.max(), y.min(), y.max()]), camera.pixel_rad
    )
