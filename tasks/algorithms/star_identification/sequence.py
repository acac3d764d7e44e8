"""A sensor's frames in order: tracked from frame to frame, lost in space where that fails."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.star_identification.following import (
    NO_MATCH,
    TOO_FEW,
    Memory,
    follow,
    new_memory,
    remember,
)
from epipole.tasks.algorithms.star_identification.frames.frame import (
    CLEAR_LEAD,
    Search,
    identify_lost,
)
from epipole.tasks.algorithms.star_identification.frames.spots import Frames, Solutions, unsolved
from epipole.tasks.algorithms.star_identification.sky.camera_sky import Sky
from epipole.tasks.algorithms.star_identification.sky.pair_table import PairTable
from epipole.tasks.algorithms.star_identification.sky.sky_grid import SkyGrid

Array = npt.NDArray[np.float64]

MAX_SKIPPED = 32  # frames left to the way back between two searches that keep failing
TIME_LIMIT, NO_CENTROIDS = 3, 4
STATUS = {
    TOO_FEW: "too_few_stars",
    NO_MATCH: "no_match",
    TIME_LIMIT: "time_limit",
    NO_CENTROIDS: "no_centroids",
}


class Priors(NamedTuple):
    """Attitudes that came with the log.

    R_sensor_from_icrs, sigma_rad : (F, 3, 3), (F,) float, error an axis; NaN where there is none
    """

    R_sensor_from_icrs: Array
    sigma_rad: Array


def no_priors(n: int) -> Priors:
    """Return the priors of n frames that have none."""
    return Priors(np.full((n, 3, 3), np.nan), np.full(n, np.nan))


def identify_sequence(
    t_s: Array,
    frames: Frames,
    priors: Priors,
    sky: Sky,
    grid: SkyGrid,
    pairs: Callable[[], PairTable],
    how: Search,
) -> tuple[Solutions, list[str | None]]:
    """Identify frames in order of time; what that misses, from the frame after it.

    `pairs` is called when the whole sky is to be searched: a sensor with good priors needs
    none.

    Returns
    -------
    solutions
        What the stars tell.
    status : one a frame
        None where solved, else no_centroids, too_few_stars, no_match or time_limit.
    """
    n = len(frames.beta)
    found, status = unsolved(frames.first), np.zeros(n, np.int8)
    memory = new_memory(len(sky.catalogue.star_id))
    failures, k = 0, 0
    while True:
        k = _follow(k, n, 1, True, t_s, frames, priors, sky, how, memory, found, status)
        if k == n:
            break
        solution, cut_short = identify_lost(frames.one(k), sky, grid, pairs(), how)
        if solution is None:
            # Ever more rarely while that keeps failing (clouds, a night without stars), so that
            # a dark log takes bounded time.
            failures += 1
            memory.held[2] = min(2 ** min(max(failures - 6, 0), 10) - 1, MAX_SKIPPED)
            status[k] = TIME_LIMIT if cut_short else NO_MATCH
        else:
            failures = 0
            found.enter(k, solution)
            remember(
                t_s[k], solution.R_sensor_from_icrs, solution.cov_rad2, memory.t_s, memory.R,
                memory.P, memory.held,
            )  # fmt: skip
        k += 1
    if found.solved.any() and not found.solved.all():
        memory = new_memory(len(sky.catalogue.star_id))
        # Priors were tried on the way there.
        _follow(n - 1, -1, -1, False, t_s, frames, no_priors(n), sky, how, memory, found, status)
    status[np.diff(frames.first) == 0] = NO_CENTROIDS
    return found, [STATUS.get(code) for code in status.tolist()]


def _follow(
    start: int,
    stop: int,
    step: int,
    searches: bool,
    t_s: Array,
    frames: Frames,
    priors: Priors,
    sky: Sky,
    how: Search,
    memory: Memory,
    found: Solutions,
    status: npt.NDArray[np.int8],
) -> int:
    box = np.array([o.box for o in frames.optics])
    half_diagonal = np.array([o.half_diagonal_rad for o in frames.optics])
    return int(
        follow(
            start, stop, step, searches, t_s, frames.first, frames.u, frames.sigma_rad,
            frames.instrumental_mag, frames.beta, box, half_diagonal, frames.optics_of, *priors,
            sky.catalogue.u_icrs, sky.catalogue.magnitude, how.gate_sigma, sky.log_density,
            how.zero_point_mag, how.spread_mag, how.threshold, how.threshold + CLEAR_LEAD,
            *memory, found.solved, found.R_sensor_from_icrs, found.cov_rad2, found.star,
            found.chi2, found.evidence, status,
        )
    )  # fmt: skip
