"""A sensor's frames in order: followed from frame to frame, searched lost in space where that
fails."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.star_identification.following import (
    NO_MATCH,
    TOO_FEW,
    FrameArrays,
    Walk,
    follow,
    new_memory,
    remember,
)
from epipole.tasks.algorithms.star_identification.frames.frame import (
    Search,
    identify_lost,
    rule_of,
)
from epipole.tasks.algorithms.star_identification.frames.spots import (
    SensorCentroids,
    Solutions,
    unsolved,
)
from epipole.tasks.algorithms.star_identification.search.field import StarPlaces
from epipole.tasks.algorithms.star_identification.sky.camera_sky import Sky
from epipole.tasks.algorithms.star_identification.sky.pair_table import PairTable
from epipole.tasks.algorithms.star_identification.sky.sky_grid import SkyGrid

Array = npt.NDArray[np.float64]

MAX_SKIPPED = 32  # frames between two searches, where they keep failing; the way back tries them
TIME_LIMIT, NO_CENTROIDS = 3, 4
STATUS = {
    TOO_FEW: "too_few_stars",
    NO_MATCH: "no_match",
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
) -> tuple[Solutions, list[str | None]]:
    """Identify frames in order of time; frames that fail are tried again backward in time.

    `pairs` is called when the whole sky has to be searched. A sensor with good priors does not
    need them.

    Returns
    -------
    solutions
        Attitudes and stars.
    status : one per frame
        None where solved, else no_centroids, too_few_stars, no_match or time_limit.
    """
    n, n_stars = len(frames.beta), len(sky.catalogue.star_id)
    solutions, status = unsolved(frames.first), np.zeros(n, np.int8)
    arrays, rule = _arrays(t_s, frames), rule_of(how, sky)
    stars = StarPlaces(sky.catalogue.u_icrs, sky.catalogue.magnitude)
    memory, failures, k = new_memory(n_stars), 0, 0
    while True:
        walk = Walk(k, n, 1, True)
        k = int(follow(walk, arrays, priors, stars, rule, memory, solutions, status))
        if k == n:
            break
        solution, cut_short = identify_lost(frames.frame(k), sky, grid, pairs(), how)
        if solution is None:
            # Searches that keep failing (clouds, a night without stars) become rarer and rarer, so
            # that a dark log takes bounded time.
            failures += 1
            memory.held[2] = min(2 ** min(max(failures - 6, 0), 10) - 1, MAX_SKIPPED)
            status[k] = TIME_LIMIT if cut_short else NO_MATCH
        else:
            failures = 0
            solutions.enter(k, solution)
            remember(memory, t_s[k], solution.R_sensor_from_icrs, solution.cov_rad2)
        k += 1
    if solutions.solved.any() and not solutions.solved.all():
        # Backward, without priors: those were tried on the way forward.
        walk, memory = Walk(n - 1, -1, -1, False), new_memory(n_stars)
        follow(walk, arrays, no_priors(n), stars, rule, memory, solutions, status)
    status[np.diff(frames.first) == 0] = NO_CENTROIDS
    return solutions, [STATUS.get(code) for code in status.tolist()]


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
