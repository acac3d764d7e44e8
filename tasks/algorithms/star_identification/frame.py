"""One frame: its centroids, its solution near a predicted attitude, and its search lost in space.

`identify_predicted` matches the stars of the field that a prediction gives. `search_frame` first
searches the whole sky for the attitude: of a dense frame with its few brightest centroids, then
without clusters of centroids, then with more of the brightest, and where that fails with all, as a
frame of which most centroids are no stars.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Indices, Integers
from epipole.tasks.algorithms.geometry.camera import Camera, ends_of_fold, undistort
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.star_identification.evidence import (
    TYPICAL_SCATTER_MAG,
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

# Maximum that is taken off the threshold of a search lost in space, by `chance_margin`.
LOST_MARGIN = 6.0
CLEAR_LEAD = 7.0  # log evidence by which the best attitude must exceed any other
MAX_STARLIT = 4.6  # prior odds (ln) that a frame has enough stars: at most 99 in 100 frames do
# Numbers of brightest centroids that are used in a search of the whole sky, that are paired, and
# that each hypothesis is tried on; and the share of them that are stars, a prior.
N_SEARCHED, N_PATTERN, N_TRIED, STAR_SHARE = 200, 40, 64, 0.5
# The same for frames of which most centroids are no stars: all are paired; prior number of stars.
N_CROWDED, MIN_STARS = 1024, 8.0
# Centroids without clusters are searched first where they are fewer than this share of all.
CLUSTERED = 0.75
CROWDED_TIMES = 10.0  # the time limit of a search of a crowd over that of another one
# Units of work in a second of CPU time, measured: of a search; of a search of a crowd, where
# brightness is unknown and where it is known. Only a budget counts with them; a time limit has the
# nominal rate.
TRUE_WORK_PER_S, CROWD_WORK_PER_S, BRIGHT_CROWD_WORK_PER_S = 1.3e8, 3.5e7, 4.7e7
# A dense frame has more centroids than are searched: first this number of its brightest ones is.
BRIGHTEST_FIRST = (30, 100)
# What a search of a dense frame's brightest centroids may cost, and one that comes before that of a
# crowd [s]: where they succeed, they take a few milliseconds. Of another frame, it is a share of
# the frame's budget.
BRIGHT_S, BEFORE_CROWD_S, PLAIN_SHARE = 0.012, 0.015, 0.4


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
    sigma_rad : (n,) float, error per axis
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
    star: Integers
    chi2: Array
    evidence: float


class MatchSettings(NamedTuple):
    """How stars are matched in a frame, and how its attitude is judged.

    gate_sigma : a centroid is within this of its star's predicted position [sigma]
    threshold : minimum log evidence, ln(1 / false alarm probability)
    time_limit_s : CPU time of one search lost in space
    zero_point_mag : star minus instrumental magnitude; NaN while unknown
    scatter_mag : 1-sigma scatter of that
    starlit : prior odds (ln) that a frame has enough stars to be identified, from the sensor's
        other frames; 0 for an unknown sensor
    budget_s : CPU time of all searches of a frame, see `search_budget`
    budget_share : of a sensor's budget, what an identification of all its frames may cost
    crowd_first : of the sensor's frames, the last one was identified as a crowd
    crowded : where a search fails, the frame is searched again as one with few stars among many
        other centroids
    """

    gate_sigma: float
    threshold: float
    time_limit_s: float
    zero_point_mag: float
    scatter_mag: float = TYPICAL_SCATTER_MAG
    crowded: bool = True
    starlit: float = 0.0
    budget_s: float = math.inf
    budget_share: float = 1.0
    crowd_first: bool = False

    @property
    def min_evidence_lost(self) -> float:
        """Minimum log evidence of an attitude that was searched lost in space."""
        return self.threshold - LOST_MARGIN - min(max(self.starlit, 0.0), MAX_STARLIT)


class Verdict(NamedTuple):
    """The result of a search of the whole sky.

    is_clear : the attitude is beyond doubt
    R_sensor_from_icrs : (3, 3), of the best hypothesis
    evidence, runner_up : log evidence of the best and of the best different attitude
    exhausted : the search ended because it reached its time limit
    cost_s : what it cost, CPU time by counted work
    crowded : it was the search of a crowd
    """

    is_clear: bool
    R_sensor_from_icrs: Array
    evidence: float
    runner_up: float
    exhausted: bool
    cost_s: float = 0.0
    crowded: bool = False


class Searched(NamedTuple):
    """A frame that was searched: its solution, whether a limit or the budget stopped the search,
    whether it was the budget, what it cost (CPU time by counted work), and whether it was
    identified as a crowd."""

    solution: Solution | None
    exhausted: bool
    over_budget: bool
    cost_s: float
    as_crowd: bool = False


def rule_of(matching: MatchSettings, sky: Sky) -> MatchRule:
    """Return the rule for matches as the kernels take it."""
    return MatchRule(
        matching.gate_sigma, sky.log_density, matching.zero_point_mag, matching.scatter_mag,
        matching.threshold, matching.threshold + CLEAR_LEAD,
    )  # fmt: skip


def identify_predicted(
    frame: FrameCentroids,
    sky: Sky,
    R0: Array,
    P0: Array,
    matching: MatchSettings,
    lost: bool = False,
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
        Attitude(R0, P0), lost, Centroids(*frame[:4]), seen, frame.optics.box,
        rule_of(matching, sky), Attitude(R, P), Matches(star, chi2),
    )  # fmt: skip
    in_view = sky.rho * frame.optics.solid_angle_sr
    if not evidence > (
        _least_of_lost(star, evidence, in_view, matching) if lost else matching.threshold
    ):
        return None
    return Solution(R, P, np.where(star >= 0, row[star], -1), chi2, evidence)


def _least_of_lost(
    star: Integers, evidence: float, in_view: float, matching: MatchSettings
) -> float:
    """Return the minimum log evidence of an attitude with these matches that was searched lost in
    space."""
    if not evidence > matching.min_evidence_lost:
        return matching.threshold
    margin = chance_margin(np.count_nonzero(star >= 0), len(star), in_view)
    return float(matching.min_evidence_lost + LOST_MARGIN - min(margin, LOST_MARGIN))


def aberrate_all(u_icrs: Array, beta: Array) -> Array:
    """Return the directions that an observer at beta (v / c) sees; see `directions.aberrate`."""
    p, g = u_icrs @ beta, np.sqrt(1.0 - beta @ beta)
    seen = g * u_icrs + (1.0 + p / (1.0 + g))[:, None] * beta
    return np.asarray(seen / np.linalg.norm(seen, axis=1, keepdims=True))


def search_lost(
    frame: FrameCentroids, sky: Sky, grid: SkyGrid, pairs: PairTable, matching: MatchSettings
) -> Verdict:
    """Search the whole sky for the frame's attitude; see `lost_in_space.search`."""
    # Centroids far outside any image have no direction.
    at = np.flatnonzero(np.isfinite(frame.u[:, 0]))
    cost_s, verdict = 0.0, NO_VERDICT
    before_crowd = matching.crowded and len(at) > N_SEARCHED and math.isfinite(matching.budget_s)
    before_crowd = before_crowd and not matching.crowd_first
    for part, crowded in _parts(frame, at, matching):
        left_s = matching.budget_s - cost_s
        if not crowded:
            left_s = min(PLAIN_SHARE * left_s, BEFORE_CROWD_S if before_crowd else math.inf)
        tried = matching._replace(budget_s=left_s)
        verdict = _search(some_centroids(frame, part), sky, grid, pairs, tried, crowded)
        cost_s += verdict.cost_s
        if verdict.is_clear:
            break
    return verdict._replace(cost_s=cost_s)


def _parts(
    frame: FrameCentroids, at: Indices, matching: MatchSettings
) -> Iterator[tuple[Indices, bool]]:
    """Yield which centroids are searched, one try after the other, and whether as a crowd."""
    as_crowd = matching.crowded and len(at) > N_PATTERN
    if as_crowd and matching.crowd_first:
        yield at[:N_CROWDED], True
    if len(at) > N_PATTERN:
        unclustered = at[without_clusters(frame.u[at], frame.optics.box)]
        if len(unclustered) < CLUSTERED * len(at):
            yield unclustered[:N_SEARCHED], False
    yield at[:N_SEARCHED], False
    if as_crowd and not matching.crowd_first:
        yield at[:N_CROWDED], True


def some_centroids(frame: FrameCentroids, at: Integers) -> FrameCentroids:
    """Return the frame with these of its centroids."""
    return frame._replace(
        u=frame.u[at], sigma_rad=frame.sigma_rad[at], instrumental_mag=frame.instrumental_mag[at]
    )


def _search(
    frame: FrameCentroids,
    sky: Sky,
    grid: SkyGrid,
    pairs: PairTable,
    matching: MatchSettings,
    crowded: bool,
) -> Verdict:
    if len(frame.u) < 3:
        return NO_VERDICT
    R, least = np.zeros((3, 3)), matching.min_evidence_lost
    problem = problem_of(frame, sky, grid, pairs, matching, crowded)
    best, runner_up, work = search_crowded(problem, R) if crowded else search(problem, R)
    is_clear = best > least and best - runner_up > CLEAR_LEAD
    rate = _work_per_s(crowded, matching)
    return Verdict(is_clear, R, best, runner_up, work > problem.limits.budget, work / rate, crowded)


def _work_per_s(crowded: bool, matching: MatchSettings) -> float:
    if not crowded:
        return TRUE_WORK_PER_S
    unknown = math.isnan(matching.zero_point_mag)
    return CROWD_WORK_PER_S if unknown else BRIGHT_CROWD_WORK_PER_S


NO_VERDICT = Verdict(False, np.eye(3), -np.inf, -np.inf, False)


def problem_of(
    frame: FrameCentroids,
    sky: Sky,
    grid: SkyGrid,
    pairs: PairTable,
    matching: MatchSettings,
    crowded: bool,
) -> Problem:
    """Return a frame whose attitude is searched for over the whole sky, as the kernels take it."""
    n, least, area = len(frame.u), matching.min_evidence_lost, frame.optics.solid_angle_sr
    min_chord = max(0.05 * frame.optics.half_diagonal_rad, 6.0 * _middle(frame.sigma_rad))
    budget = matching.time_limit_s * WORK_PER_S
    most = matching.budget_s * _work_per_s(crowded, matching)
    if crowded:
        share = min(MIN_STARS / n, STAR_SHARE)
        limits = SearchLimits(min_chord, n, n, share, min(CROWDED_TIMES * budget, most))
    else:
        limits = SearchLimits(min_chord, N_PATTERN, N_TRIED, STAR_SHARE, min(budget, most))
    return Problem(
        Centroids(*frame[:4]),
        Stars(sky.catalogue.u_icrs, sky.catalogue.magnitude, grid, sky.bands),
        pairs,
        Image(frame.optics.box, area, sky.rho * area),
        rule_of(matching, sky)._replace(
            min_evidence=least, clear_evidence=least + CLEAR_LEAD + 2.0
        ),
        limits,
    )


def _middle(values: Array) -> float:
    """Return the upper median: `np.median` takes longer than all else around the kernels."""
    return float(np.sort(values)[len(values) // 2])


@kernel
def _search_and_solve(problem, reach, R_found, solution, matches):
    """Search a frame and match all its stars, in one call: each takes as long to call as to run.

    `reach` [rad] is from the boresight to a corner of the image. R_found (3, 3), sensor from ICRS,
    receives the attitude of the search. Returns evidence, runner-up's evidence and work of the
    search, and the evidence of the solution, which is written as by `solve_predicted` (compiled).
    """
    best, runner_up, work = search(problem, R_found)
    if not (best > problem.rule.min_evidence and best - runner_up > CLEAR_LEAD):
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
    frame: FrameCentroids, sky: Sky, grid: SkyGrid, pairs: PairTable, matching: MatchSettings
) -> Searched:
    """Return the same as `search_frame` for a frame that is neither crowded nor dense."""
    problem = problem_of(frame, sky, grid, pairs, matching, crowded=False)
    n = len(frame.u)
    R, P = np.empty((3, 3)), np.empty((3, 3))
    star, chi2 = np.full(n, -1, np.int64), np.zeros(n)
    reach = frame.optics.half_diagonal_rad + 1e-4
    best, runner_up, work, evidence = _search_and_solve(
        problem, reach, np.zeros((3, 3)), Attitude(R, P), Matches(star, chi2)
    )
    cost_s, exhausted = work / TRUE_WORK_PER_S, bool(work > problem.limits.budget)
    if not (best > matching.min_evidence_lost and best - runner_up > CLEAR_LEAD):
        return Searched(None, exhausted, exhausted and cost_s >= matching.budget_s, cost_s)
    if not evidence > _least_of_lost(star, evidence, problem.image.in_view, matching):
        return Searched(None, False, False, cost_s)
    return Searched(Solution(R, P, star, chi2, evidence), False, False, cost_s)


def _identify_bright(
    frame: FrameCentroids, sky: Sky, grid: SkyGrid, pairs: PairTable, matching: MatchSettings
) -> Searched:
    """Return the solution of a dense frame by its few brightest centroids, and what it cost.

    Where all its centroids hide these stars, the others are left without one.
    """
    cost_s, n = 0.0, len(frame.u)
    # Each number of centroids is one more chance of a false alarm.
    pays = matching.threshold + math.log(len(BRIGHTEST_FIRST) + 1)
    for bright in BRIGHTEST_FIRST:
        part = some_centroids(frame, np.arange(bright))
        left_s = PLAIN_SHARE * (matching.budget_s - cost_s)
        tried = matching._replace(threshold=pays, budget_s=min(BRIGHT_S, left_s))
        verdict = _search(part, sky, grid, pairs, tried, crowded=False)
        cost_s += verdict.cost_s
        if not verdict.is_clear:
            continue
        found = _near_verdict(part, sky, verdict, tried)
        if found is None:
            continue
        full = _near_verdict(frame, sky, verdict, matching)
        if full is None:
            star, chi2 = np.full(n, -1, np.int64), np.zeros(n)
            star[:bright], chi2[:bright] = found.star, found.chi2
            full = found._replace(star=star, chi2=chi2)
        return Searched(full, False, False, cost_s)
    return Searched(None, False, False, cost_s)


def _near_verdict(
    frame: FrameCentroids, sky: Sky, verdict: Verdict, matching: MatchSettings
) -> Solution | None:
    near = np.eye(3) * (2.0 * _middle(frame.sigma_rad)) ** 2
    return identify_predicted(frame, sky, verdict.R_sensor_from_icrs, near, matching, lost=True)


def search_frame(
    frame: FrameCentroids, sky: Sky, grid: SkyGrid, pairs: PairTable, matching: MatchSettings
) -> Searched:
    """Return the solution without a prior, None where no attitude is beyond doubt."""
    finite = bool(np.isfinite(frame.u).all())
    if 3 <= len(frame.u) <= N_PATTERN and finite:
        return _identify_few(frame, sky, grid, pairs, matching)
    cost_s = 0.0
    by_flux = len(frame.u) > N_SEARCHED and finite and np.isfinite(frame.instrumental_mag[0])
    if by_flux and not (matching.crowd_first and matching.crowded):
        bright = _identify_bright(frame, sky, grid, pairs, matching)
        if bright.solution is not None:
            return bright
        cost_s = bright.cost_s
        matching = matching._replace(
            threshold=matching.threshold + math.log(len(BRIGHTEST_FIRST) + 1),
            budget_s=matching.budget_s - cost_s,
        )
    verdict = search_lost(frame, sky, grid, pairs, matching)
    cost_s += verdict.cost_s
    if not verdict.is_clear:
        over = verdict.exhausted and verdict.cost_s >= PLAIN_SHARE * matching.budget_s
        return Searched(None, verdict.exhausted, over, cost_s)
    found = _near_verdict(frame, sky, verdict, matching)
    return Searched(found, False, False, cost_s, verdict.crowded and found is not None)


# Clusters of false centroids: a reflection, a bright object's halo, a damaged part of the chip.

CLUSTER_CELLS = 8  # along each side of the image
# A cell keeps this number of centroids, or this many times the number in the median cell.
MIN_PER_CELL, TIMES_MEDIAN = 4, 3


def without_clusters(u: Array, box: Array) -> Indices:
    """Return the rows of centroids without most of those in crowded cells of the image.

    Parameters
    ----------
    u : (n, 3) float
        Directions in the sensor frame, brightest first: the brightest of a cell are kept.
    box : (4,) float
        x0, x1, y0, y1 of the image in normalised coordinates.
    """
    at = (u[:, :2] / u[:, 2:] - box[[0, 2]]) / (box[[1, 3]] - box[[0, 2]])
    row, column = np.clip(CLUSTER_CELLS * at, 0, CLUSTER_CELLS - 1).astype(np.int64).T
    cell = row * CLUSTER_CELLS + column
    count = np.bincount(cell, minlength=CLUSTER_CELLS * CLUSTER_CELLS)
    order = np.argsort(cell, kind="stable")
    rank = np.empty(len(cell), np.int64)
    rank[order] = np.arange(len(cell)) - (np.cumsum(count) - count)[cell[order]]
    return np.flatnonzero(rank < max(MIN_PER_CELL, TIMES_MEDIAN * np.median(count)))


# The field of view of a camera.

# Points of each edge of the image, at which the distortion is taken, and of the circle at which it
# folds.
EDGE_POINTS, FOLD_POINTS = 9, 360


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
    # Corners that a wide lens does not reach have no direction: its field ends at the fold.
    if np.isnan(x).any():
        x, y = map(np.concatenate, zip((x, y), ends_of_fold(camera, FOLD_POINTS), strict=True))
    half_diagonal = float(np.arctan(np.nanmax(np.hypot(x, y))))
    box = np.array([np.nanmin(x), np.nanmax(x), np.nanmin(y), np.nanmax(y)])
    return FieldOfView(half_diagonal, box, camera.pixel_rad)
