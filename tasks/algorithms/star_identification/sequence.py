"""A sensor's frames in order: tracked from frame to frame, lost in space where that fails."""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.rotations import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)
from epipole.tasks.algorithms.star_identification.frame import (
    Frame,
    Search,
    Solution,
    identify_lost,
    identify_predicted,
)
from epipole.tasks.algorithms.star_identification.pair_table import PairTable
from epipole.tasks.algorithms.star_identification.sky import Sky
from epipole.tasks.algorithms.star_identification.sky_grid import SkyGrid

Array = npt.NDArray[np.float64]

RATE_SIGMA = 1e-3  # rad/s, of a sensor whose rate is not known yet
ACCELERATION_SIGMA = 3e-5  # rad/s^2, how unevenly a sensor turns
WIDEST_PREDICTION = 0.02  # rad; wider ones are no better than being lost
MAX_SKIPPED = 32  # frames left to the way back between two searches that keep failing


class Prior(NamedTuple):
    """An attitude that came with the log: (3, 3) sensor from ICRS, sigma an axis [rad]."""

    R_sensor_from_icrs: Array
    sigma_rad: float


class Fix(NamedTuple):
    """An identified attitude at a time [s]."""

    t_s: float
    R: Array
    P: Array


def predict(fixes: list[Fix], t_s: float) -> tuple[Array, Array] | None:
    """Return attitude and covariance at t_s from the last one or two; None if of no use."""
    if not fixes:
        return None
    last = fixes[-1]
    dt = t_s - last.t_s
    if len(fixes) == 1:
        R, P = last.R, last.P + np.eye(3) * (RATE_SIGMA * dt) ** 2
    else:
        before = fixes[-2]
        step = last.t_s - before.t_s
        share = dt / step
        turned = rotation_vector_from_quaternion(quaternion_from_matrix(last.R @ before.R.T))
        if np.linalg.norm(turned) > 0.5:  # more than a tracked sensor turns between frames
            return None
        R = matrix_from_quaternion(quaternion_from_rotation_vector(turned * share)) @ last.R
        uneven = 0.5 * ACCELERATION_SIGMA * abs(dt) * (abs(dt) + abs(step))
        P = (1 + share) ** 2 * last.P + share**2 * before.P + np.eye(3) * uneven**2
    if P[0, 0] + P[1, 1] > 2 * WIDEST_PREDICTION**2:
        return None
    return R, P


class Tracker:
    """Follows one sensor through its frames, forward or backward in time."""

    def __init__(
        self, sky: Sky, grid: SkyGrid, pairs: Callable[[], PairTable] | None, how: Search
    ) -> None:
        """`pairs` is called when first needed: a sensor with good priors needs none. None: no
        searches of the whole sky."""
        self.sky, self.grid, self.pairs, self.how = sky, grid, pairs, how
        self.fixes: list[Fix] = []
        self.failures = self.skip = 0
        self.prior_holds = False

    def step(self, t_s: float, frame: Frame, prior: Prior | None) -> tuple[Solution | None, str]:
        """Return the frame's solution, or None and why: no_match, time_limit."""
        solution, why = self._predicted(t_s, frame, prior), "no_match"
        # Where priors were borne out, a frame that fails has too few stars, not a wrong prior.
        if solution is None and self.pairs is not None and not (prior and self.prior_holds):
            solution, why = self._lost(frame, self.pairs)
        if solution is not None:
            self.fixes = [
                *self.fixes[-1:],
                Fix(t_s, solution.R_sensor_from_icrs, solution.cov_rad2),
            ]
            self.failures = self.skip = 0
        return solution, why

    def _predicted(self, t_s: float, frame: Frame, prior: Prior | None) -> Solution | None:
        prediction = predict(self.fixes, t_s)
        if prediction is not None:
            solution = identify_predicted(frame, self.sky, *prediction, self.how)
            if solution is not None:
                return solution
        if prior is None:
            return None
        P = np.eye(3) * prior.sigma_rad**2
        solution = identify_predicted(frame, self.sky, prior.R_sensor_from_icrs, P, self.how)
        self.prior_holds |= solution is not None
        return solution

    def _lost(self, frame: Frame, pairs: Callable[[], PairTable]) -> tuple[Solution | None, str]:
        """Search the whole sky; ever more rarely while that keeps failing (clouds, a night
        without stars), so that a dark log takes bounded time."""
        if self.skip > 0:
            self.skip -= 1
            return None, "no_match"
        solution, cut_short = identify_lost(frame, self.sky, self.grid, pairs(), self.how)
        if solution is None:
            self.failures += 1
            self.skip = min(2 ** max(self.failures - 6, 0) - 1, MAX_SKIPPED)
            return None, "time_limit" if cut_short else "no_match"
        return solution, ""


def identify_sequence(
    t_s: Array,
    frames: list[Frame],
    priors: list[Prior | None],
    sky: Sky,
    grid: SkyGrid,
    pairs: Callable[[], PairTable],
    how: Search,
) -> tuple[list[Solution | None], list[str | None]]:
    """Identify frames in order of time; what that misses, from the frame after it.

    Returns
    -------
    solutions : one a frame, None where the stars give no attitude
    status : None where they do, else no_centroids, too_few_stars, no_match or
        time_limit
    """
    solutions: list[Solution | None] = [None] * len(frames)
    status: list[str | None] = [None] * len(frames)

    def run(tracker: Tracker, order: Iterable[int]) -> None:
        for k in order:
            found = solutions[k]
            if found is not None:
                fix = Fix(t_s[k], found.R_sensor_from_icrs, found.cov_rad2)
                tracker.fixes = [*tracker.fixes[-1:], fix]
            elif len(frames[k].u) < 3:
                status[k] = "too_few_stars" if len(frames[k].u) else "no_centroids"
            else:
                solutions[k], why = tracker.step(t_s[k], frames[k], priors[k])
                status[k] = None if solutions[k] is not None else status[k] or why

    run(Tracker(sky, grid, pairs, how), range(len(frames)))
    if any(s is not None for s in solutions) and not all(s is not None for s in solutions):
        no_priors: list[Prior | None] = [None] * len(frames)
        priors = no_priors  # they were tried on the way there
        run(Tracker(sky, grid, None, how), range(len(frames) - 1, -1, -1))
    return solutions, status
