"""A sensor's frames in order: followed from frame to frame, searched lost in space where that
fails."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.star_identification.centroids import (
    SensorCentroids,
    Solutions,
    unsolved,
)
from epipole.tasks.algorithms.star_identification.evidence import MatchRule
from epipole.tasks.algorithms.star_identification.following import (
    NO_MATCH,
    NOT_SEARCHED,
    TIME_LIMIT,
    TOO_FEW,
    FrameArrays,
    FrameRange,
    follow,
    new_memory,
    remember,
)
from epipole.tasks.algorithms.star_identification.frame import (
    Search,
    Solution,
    identify_lost,
    rule_of,
)
from epipole.tasks.algorithms.star_identification.search.match_stars import StarPlaces
from epipole.tasks.algorithms.star_identification.star_grid import Sky, SkyGrid
from epipole.tasks.algorithms.star_identification.star_pairs import PairTable

Array = npt.NDArray[np.float64]

# Where searches keep failing: after PATIENCE of them, back off exponentially to at most
# max(32, n / 32) skipped frames of the n since the last success. The backward pass retries them.
PATIENCE, HOPELESS = 6, 1  # `HOPELESS` more than patience, where searches have failed before
MAX_SKIPPED, SKIPPED_SHARE = 32, 1 / 32
NO_CENTROIDS = 5
STATUS = {
    TOO_FEW: "too_few_stars",
    NO_MATCH: "no_match",
    NOT_SEARCHED: "not_searched",
    TIME_LIMIT: "time_limit",
    NO_CENTROIDS: "no_centroids",
}


class Priors(NamedTuple):
    """Attitudes that came with the log.

    R_sensor_from_icrs, sigma_rad : (F, 3, 3), (F,) float, attitude and its error an axis; NaN
        where missing
    """

    R_sensor_from_icrs: Array
    sigma_rad: Array


def no_priors(n: int) -> Priors:
    """Return priors of n frames that have none: all NaN."""
    return Priors(np.full((n, 3, 3), np.nan), np.full(n, np.nan))


def identify_sequence(
    t_s: Array,
    frames: SensorCentroids,
    priors: Priors,
    sky: Sky,
    grid: SkyGrid,
    pairs: Callable[[], PairTable],
    how: Search,
    anchored: bool = False,
    hopeless: bool = False,
) -> tuple[Solutions, list[str | None]]:
    """Identify frames in order of time; frames that fail are tried again backward in time.

    `pairs` is called when the whole sky has to be searched. A sensor with good priors does not
    need them.

    Parameters
    ----------
    anchored
        Some priors are solutions: the others are followed from these, both ways, before any search.
    hopeless
        Searches have failed before: frames are skipped from the first failure on.

    Returns
    -------
    solutions
        Attitudes and stars.
    status : one per frame
        None where solved, else no_centroids, too_few_stars, no_match, not_searched or time_limit.
    """
    n = len(frames.beta)
    solutions, status = unsolved(frames.first), np.zeros(n, np.int8)
    arrays, rule = _arrays(t_s, frames), rule_of(how, sky)
    stars = StarPlaces(sky.catalogue.u_icrs, sky.catalogue.magnitude)
    sequence = _Sequence(frames, arrays, stars, rule, solutions, status)
    forth, back, none = FrameRange(0, n, 1, False), FrameRange(n - 1, -1, -1, False), no_priors(n)

    def search(k: int, failures: int, step: int) -> tuple[Solution | None, bool]:
        # Crowded frames take long: where the stars' brightness is unknown, ever fewer are tried.
        often = not np.isnan(how.zero_point_mag)
        tried = how._replace(
            crowded=how.crowded and (often or failures.bit_count() <= 1),
            starlit=sequence.starlit(k, step),
        )
        return identify_lost(frames.frame(k), sky, grid, pairs(), tried)

    if anchored:
        sequence.follow(forth, priors)
        sequence.follow(back, none)
    if not solutions.solved.all():
        hopeless &= n > MAX_SKIPPED
        sequence.go(forth, priors, search, PATIENCE + HOPELESS if hopeless else 0)
    if solutions.solved.any() and not solutions.solved.all():
        # Backward, without priors: those were tried on the way forward. What lies behind a slew
        # and was skipped is searched.
        before = solutions.solved.sum()
        sequence.go(back, none, search, 0)
        if solutions.solved.sum() > before:
            sequence.follow(forth, none)
    status[np.diff(frames.first) == 0] = NO_CENTROIDS
    return solutions, [STATUS.get(code) for code in status.tolist()]


def identify_again(
    t_s: Array, frames: SensorCentroids, solutions: Solutions, sky: Sky, how: Search
) -> Solutions:
    """Return the frames identified again near their solutions, as with other errors.

    No sky is searched. Frames that are not solved are tried from the others.
    """
    n = len(frames.beta)
    again, status = unsolved(frames.first), np.zeros(n, np.int8)
    stars = StarPlaces(sky.catalogue.u_icrs, sky.catalogue.magnitude)
    sequence = _Sequence(frames, _arrays(t_s, frames), stars, rule_of(how, sky), again, status)
    # Errors were other ones: an attitude may be off by more than its covariance says.
    sigma = 3.0 * np.sqrt(np.trace(solutions.cov_rad2, axis1=1, axis2=2) / 3.0)
    sequence.follow(FrameRange(0, n, 1, False), Priors(solutions.R_sensor_from_icrs, sigma))
    return again


class _Sequence(NamedTuple):
    """Frames on the way through them; solutions and status are changed."""

    frames: SensorCentroids
    arrays: FrameArrays
    stars: StarPlaces
    rule: MatchRule
    solutions: Solutions
    status: npt.NDArray[np.int8]

    def follow(self, walk: FrameRange, priors: Priors) -> None:
        """Identify frames from those before them, on one walk, without a search."""
        memory = new_memory(len(self.stars.u))
        follow(walk, self.arrays, priors, self.stars, self.rule, memory, self.solutions,
               self.status)  # fmt: skip

    def go(
        self,
        walk: FrameRange,
        priors: Priors,
        search: Callable[[int, int, int], tuple[Solution | None, bool]],
        failures: int,
    ) -> None:
        """The same, but frames that fail are searched; so many searches have failed before."""
        memory, k = new_memory(len(self.stars.u)), walk.start
        while True:
            k = int(follow(walk._replace(start=k, searches=True), self.arrays, priors, self.stars,
                           self.rule, memory, self.solutions, self.status))  # fmt: skip
            if k == walk.stop:
                return
            solution, cut_short = search(k, failures, walk.step)
            trusted = bool(memory.held[1]) and not np.isnan(priors.sigma_rad[k])
            if solution is None:
                # Where priors were confirmed, a frame mostly fails because it shows few stars.
                failures = max(failures + 1, PATIENCE + 1 if trusted else 0)
                memory.held[2] = _skipped(failures, self._refused(k, walk.step))
                self.status[k] = TIME_LIMIT if cut_short else NO_MATCH
            else:
                failures, memory.held[1] = 0, 0  # it contradicts a prior that the frame has
                self.status[k] = 0
                self.solutions.enter(k, solution)
                remember(memory, self.arrays.t_s[k], solution.R_sensor_from_icrs, solution.cov_rad2)
            k += walk.step

    def starlit(self, k: int, step: int) -> float:
        """Return the odds (ln) that frame k shows stars, from those before it on this walk.

        With them, chance identifies the stated share of all frames, more of those without stars.
        """
        before = slice(0, k) if step > 0 else slice(k + 1, None)
        status, solved = self.status[before], self.solutions.solved[before]
        refused = ((status == NO_MATCH) | (status == TIME_LIMIT)) & ~solved
        return float(np.log((solved.sum() + 1) / (refused.sum() + 1)))

    def _refused(self, k: int, step: int) -> int:
        """Return how many frames before k, on this walk, are not solved."""
        before = self.solutions.solved[:k][::-1] if step > 0 else self.solutions.solved[k + 1 :]
        solved = np.flatnonzero(before)
        return int(solved[0]) if len(solved) else len(before)


def _skipped(failures: int, frames: int) -> int:
    """Return how many frames are not searched after so many failures over so many frames.

    A sensor without stars takes bounded time. One that can be identified again is, however
    long it could not: from some frame on, or for a while that is longer than this. The number
    changes all the time: what shows stars may come back in a period.
    """
    if failures <= PATIENCE:
        return 0
    most = max(MAX_SKIPPED, int(SKIPPED_SHARE * frames))
    return min(2 ** min(failures - PATIENCE, 20), most - failures % 3)


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
