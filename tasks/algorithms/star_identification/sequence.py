"""A sensor's frames in order: followed from frame to frame, searched where that fails.

`identify_sample` identifies some or all frames with a sensor's model. It prepares the sky and calls
`identify_sequence`, which goes forward in time, then backward for the frames that failed.
`identify_again` matches frames near the solutions that they have, for example with other errors.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.schemas.arrays import Array, Integers
from epipole.tasks.algorithms.star_identification.centroids import (
    RawCentroids,
    SensorCentroids,
    Solutions,
    unsolved,
)
from epipole.tasks.algorithms.star_identification.evidence import MatchRule
from epipole.tasks.algorithms.star_identification.following import (
    NO_MATCH,
    NOT_SEARCHED,
    PRIOR_CONFIRMED,
    SEARCH_LIMIT,
    TIME_LIMIT,
    TO_SKIP,
    TOO_FEW,
    FrameArrays,
    FrameRange,
    follow,
    new_memory,
    remember,
)
from epipole.tasks.algorithms.star_identification.frame import (
    MatchSettings,
    Searched,
    Solution,
    rule_of,
    search_frame,
)
from epipole.tasks.algorithms.star_identification.search.match_stars import StarDirections
from epipole.tasks.algorithms.star_identification.search_budget import (
    TOO_LITTLE_S,
    Allowance,
    SearchBudget,
)
from epipole.tasks.algorithms.star_identification.sensor_model import SensorModel, Skies
from epipole.tasks.algorithms.star_identification.star_grid import Sky, SkyGrid
from epipole.tasks.algorithms.star_identification.star_pairs import PairTable

# Where searches keep failing: after PATIENCE of them, back off exponentially to at most
# max(MAX_SKIPPED, n SKIPPED_SHARE) skipped frames of the n since the last success. The backward
# pass retries them. With a hopeless sensor, the first failure counts as PATIENCE + 2 failures.
PATIENCE, MAX_SKIPPED, SKIPPED_SHARE = 6, 32, 1 / 32
MAX_BACKOFF_LOG2 = 20  # limit of the exponent: the power stays a small integer
# Factor on the error of an earlier solution that serves as a prior: it was found with other errors
# or another sky.
PRIOR_SIGMAS = 3.0
NO_CENTROIDS = 5
STATUS = {
    TOO_FEW: "too_few_stars",
    NO_MATCH: "no_match",
    NOT_SEARCHED: "not_searched",
    TIME_LIMIT: "time_limit",
    SEARCH_LIMIT: "search_limit",
    NO_CENTROIDS: "no_centroids",
}


class Priors(NamedTuple):
    """Attitudes that came with the log.

    R_sensor_from_icrs, sigma_rad : (F, 3, 3), (F,) float, attitude and its error per axis; NaN
        where missing
    """

    R_sensor_from_icrs: Array
    sigma_rad: Array


def no_priors(n: int) -> Priors:
    """Return the priors of n frames without any: all NaN."""
    return Priors(np.full((n, 3, 3), np.nan), np.full(n, np.nan))


class SensorSky(NamedTuple):
    """The sky of a sensor: its stars, their grid, and a source of their pairs."""

    sky: Sky
    grid: SkyGrid
    pairs: Callable[[], PairTable]


class FrameSample(NamedTuple):
    """Some or all of a sensor's frames.

    t_s : (F,) float, times [s], ascending
    centroids, priors : of the F frames
    anchors : some priors are earlier solutions
    budget, rows : what searches of the sensor may cost, and (F,) int64, which of its frames these
        are; None: searches have no budget
    """

    t_s: Array
    centroids: RawCentroids
    priors: Priors
    anchors: bool = False
    budget: SearchBudget | None = None
    rows: Integers | None = None

    def take(self, rows: Integers) -> "FrameSample":
        """Return the frames of these rows."""
        priors = Priors(self.priors.R_sensor_from_icrs[rows], self.priors.sigma_rad[rows])
        of_sensor = None if self.rows is None else self.rows[rows]
        return FrameSample(
            self.t_s[rows], self.centroids.take(rows), priors, self.anchors, self.budget, of_sensor
        )

    def allowance(self, share: float, one_will_do: bool = False) -> Allowance | None:
        """Return what a pass over these frames may cost: a share of what is left."""
        if self.budget is None or self.rows is None:
            return None
        return self.budget.allow(self.rows, share, one_will_do)

    def scaled(self, model: SensorModel) -> SensorCentroids:
        """Return the centroids with the errors of the sensor's model."""
        return self.centroids.frames(model.scale, model.use_flux)

    def anchored(self, rows: Integers, solutions: list[Solution | None]) -> "FrameSample":
        """Return the frames with these solutions as priors, where the log gives none."""
        R, sigma = self.priors.R_sensor_from_icrs.copy(), self.priors.sigma_rad.copy()
        for row, solution in zip(rows, solutions, strict=True):
            if solution is not None and np.isnan(self.priors.sigma_rad[row]):
                R[row] = solution.R_sensor_from_icrs
                sigma[row] = PRIOR_SIGMAS * np.sqrt(np.trace(solution.cov_rad2) / 3.0)
        return self._replace(priors=Priors(R, sigma), anchors=True)

    def of_quality(self, quality: Array) -> "FrameSample":
        """Return the frames with these factors on their errors."""
        centroids = self.centroids
        stated = np.where(np.isnan(centroids.sigma_px), 1.0, centroids.sigma_px)
        scaled = centroids._replace(sigma_px=stated * np.repeat(quality, centroids.counts))
        return self._replace(centroids=scaled)


def identify_sample(
    sample: FrameSample,
    skies: Skies,
    model: SensorModel,
    hopeless: bool = False,
    share: float = 1.0,
    one_will_do: bool = False,
) -> tuple[Solutions, list[str | None]]:
    """Return the frames' solutions and status, identified with a sensor's model.

    Parameters
    ----------
    hopeless
        Searches of this sensor have failed before, see `identify_sequence`.
    share
        Of what is left of the sensor's budget, what this pass may cost.
    one_will_do
        One identified frame is enough: the first frames may cost all of the share.
    """
    if not len(sample.t_s):
        return unsolved(sample.centroids.first), []
    return identify_sequence(
        sample.t_s, sample.scaled(model), sample.priors, *sky_of(sample.centroids, skies, model),
        model.matching, sample.anchors, hopeless, sample.allowance(share, one_will_do),
    )  # fmt: skip


def sky_of(centroids: RawCentroids, skies: Skies, model: SensorModel) -> SensorSky:
    """Return the sky to the faintest star of the sensor's model, as searches take it."""
    radius = _grid_radius(centroids.frames(model.scale), model.matching)
    pairs = partial(skies.pairs, model.limit, centroids.optics[0])
    return SensorSky(skies.sky(model.limit), skies.grid(model.limit, radius), pairs)


def _grid_radius(frames: SensorCentroids, matching: MatchSettings) -> float:
    """Return the widest look-up [rad], in powers of sqrt(2) so that sensors share grids."""
    sigma = frames.sigma_rad
    widest = 2.5 * matching.gate_sigma * float(np.median(sigma)) if len(sigma) else 1e-3
    return float(min(2.0 ** (np.ceil(2 * np.log2(widest)) / 2), 0.1))


def identify_sequence(
    t_s: Array,
    frames: SensorCentroids,
    priors: Priors,
    sky: Sky,
    grid: SkyGrid,
    pairs: Callable[[], PairTable],
    matching: MatchSettings,
    anchored: bool = False,
    hopeless: bool = False,
    allowance: Allowance | None = None,
) -> tuple[Solutions, list[str | None]]:
    """Identify frames in order of time; frames that fail are tried again backward in time.

    `pairs` is called when the whole sky has to be searched. A sensor with good priors does not
    need them.

    Parameters
    ----------
    anchored
        Some priors are earlier solutions: the other frames are followed from these, both ways,
        before any search.
    hopeless
        Searches have failed before: frames are skipped from the first failure on.
    allowance
        What the searches may cost; None: they are not limited together.

    Returns
    -------
    solutions
        Attitudes and stars.
    status : one per frame
        None where solved, else a name of `STATUS`.
    """
    n = len(frames.beta)
    solutions, status = unsolved(frames.first), np.zeros(n, np.int8)
    stars = StarDirections(sky.catalogue.u_icrs, sky.catalogue.magnitude)
    arrays, rule = _arrays(t_s, frames), rule_of(matching, sky)
    sequence = _Sequence(frames, arrays, stars, rule, solutions, status)
    search = _SkySearch(sequence, sky, grid, pairs, matching, allowance)
    forward, backward = FrameRange(0, n, 1, False), FrameRange(n - 1, -1, -1, False)
    none = no_priors(n)
    if anchored:
        sequence.follow(forward, priors)
        sequence.follow(backward, none)
    if not solutions.solved.all():
        hopeless &= n > MAX_SKIPPED
        sequence.follow_and_search(forward, priors, search, PATIENCE + 1 if hopeless else 0)
    if solutions.solved.any() and not solutions.solved.all():
        # Backward, without priors, which were tried forward. Frames that were skipped beyond a slew
        # are searched now.
        before = solutions.solved.sum()
        sequence.follow_and_search(backward, none, search, 0)
        if solutions.solved.sum() > before:
            sequence.follow(forward, none)
    status[np.diff(frames.first) == 0] = NO_CENTROIDS
    return solutions, [STATUS.get(code) for code in status.tolist()]


def identify_again(
    t_s: Array, frames: SensorCentroids, solutions: Solutions, sky: Sky, matching: MatchSettings
) -> Solutions:
    """Return the frames identified again near their solutions, for example with other errors.

    The sky is not searched. Unsolved frames are followed from solved ones.
    """
    n = len(frames.beta)
    again, status = unsolved(frames.first), np.zeros(n, np.int8)
    stars = StarDirections(sky.catalogue.u_icrs, sky.catalogue.magnitude)
    sequence = _Sequence(frames, _arrays(t_s, frames), stars, rule_of(matching, sky), again, status)
    sigma = PRIOR_SIGMAS * np.sqrt(np.trace(solutions.cov_rad2, axis1=1, axis2=2) / 3.0)
    sequence.follow(FrameRange(0, n, 1, False), Priors(solutions.R_sensor_from_icrs, sigma))
    return again


class _Sequence(NamedTuple):
    """A sensor's frames with their solutions and status, which its methods change."""

    frames: SensorCentroids
    arrays: FrameArrays
    stars: StarDirections
    rule: MatchRule
    solutions: Solutions
    status: npt.NDArray[np.int8]

    def follow(self, frame_range: FrameRange, priors: Priors) -> None:
        """Identify frames from those before them, without a search."""
        memory = new_memory(len(self.stars.u))
        follow(frame_range, self.arrays, priors, self.stars, self.rule, memory, self.solutions,
               self.status)  # fmt: skip

    def follow_and_search(
        self,
        frame_range: FrameRange,
        priors: Priors,
        search: Callable[[int, int, int], Searched | None],
        failures: int,
    ) -> None:
        """Identify frames from those before them; frames that fail are searched.

        `search` returns None where the budget leaves too little. `failures` is the number of
        searches that have failed before.
        """
        memory, k = new_memory(len(self.stars.u)), frame_range.start
        while True:
            k = int(follow(frame_range._replace(start=k, searches=True), self.arrays, priors,
                           self.stars, self.rule, memory, self.solutions, self.status))  # fmt: skip
            if k == frame_range.stop:
                return
            found = search(k, failures, frame_range.step)
            if found is None:
                self.status[k] = SEARCH_LIMIT
                k += frame_range.step
                continue
            solution = found.solution
            trusted = bool(memory.counters[PRIOR_CONFIRMED]) and not np.isnan(priors.sigma_rad[k])
            if solution is None:
                # Where priors were confirmed, most frames fail because they show few stars.
                failures = max(failures + 1, PATIENCE + 1 if trusted else 0)
                memory.counters[TO_SKIP] = _skipped(failures, self._refused(k, frame_range.step))
                stopped = SEARCH_LIMIT if found.over_budget else TIME_LIMIT
                self.status[k] = stopped if found.exhausted else NO_MATCH
            else:
                failures = 0
                memory.counters[PRIOR_CONFIRMED] = 0  # the frame's prior, if any, was wrong
                self.status[k] = 0
                self.solutions.enter(k, solution)
                remember(memory, self.arrays.t_s[k], solution.R_sensor_from_icrs, solution.cov_rad2)
            k += frame_range.step

    def starlit(self, k: int, step: int) -> float:
        """Return the prior odds (ln) that frame k shows stars, from those before it in this pass.

        With them, the false alarm probability holds over all frames together.
        """
        before = slice(0, k) if step > 0 else slice(k + 1, None)
        status, solved = self.status[before], self.solutions.solved[before]
        refused = (status == NO_MATCH) | (status == TIME_LIMIT) | (status == SEARCH_LIMIT)
        refused &= ~solved
        return float(np.log((solved.sum() + 1) / (refused.sum() + 1)))

    def _refused(self, k: int, step: int) -> int:
        """Return the number of frames between k and the last solved one before it in this pass."""
        before = self.solutions.solved[:k][::-1] if step > 0 else self.solutions.solved[k + 1 :]
        solved = np.flatnonzero(before)
        return int(solved[0]) if len(solved) else len(before)


@dataclass
class _SkySearch:
    """Searches single frames over the whole sky; see `identify_sequence` for its fields."""

    sequence: _Sequence
    sky: Sky
    grid: SkyGrid
    pairs: Callable[[], PairTable]
    matching: MatchSettings
    allowance: Allowance | None
    crowd_first: bool = False  # the frame that was found last was a crowd

    def __call__(self, k: int, failures: int, step: int) -> Searched | None:
        """Return the result for frame k; None where the budget leaves too little."""
        frames, matching = self.sequence.frames, self.matching
        # A search in a crowd takes long. Without a known brightness of the stars, it is tried only
        # after 0, 1, 2, 4, 8 ... failures.
        has_zero_point = not np.isnan(matching.zero_point_mag)
        tried = matching._replace(
            crowded=matching.crowded and (has_zero_point or failures.bit_count() <= 1),
            starlit=self.sequence.starlit(k, step),
            crowd_first=self.crowd_first,
        )
        if self.allowance is not None:
            n = len(frames.beta)
            share_done = (k + 1 if step > 0 else n - k) / n
            tried = tried._replace(budget_s=self.allowance.left_s(k, share_done))
            if tried.budget_s < TOO_LITTLE_S:
                return None
        found = search_frame(frames.frame(k), self.sky, self.grid, self.pairs(), tried)
        if self.allowance is not None:
            self.allowance.spend(k, found.cost_s)
        if found.solution is not None:
            self.crowd_first = found.as_crowd
        return found


def _skipped(failures: int, frames: int) -> int:
    """Return the number of frames to skip after this many failed searches over this many frames.

    A sensor without stars then takes a bounded time, and stars that return are found, however long
    they were missing. The number varies, because stars may return periodically.
    """
    if failures <= PATIENCE:
        return 0
    most = max(MAX_SKIPPED, int(SKIPPED_SHARE * frames))
    return min(2 ** min(failures - PATIENCE, MAX_BACKOFF_LOG2), most - failures % 3)


def _arrays(t_s: Array, frames: SensorCentroids) -> FrameArrays:
    return FrameArrays(
        t_s,
        frames.first,
        frames.u,
        frames.sigma_rad,
        frames.instrumental_mag,
        frames.beta,
        frames.optics_of,
        np.array([optics.box for optics in frames.optics]),
        np.array([optics.half_diagonal_rad for optics in frames.optics]),
    )
