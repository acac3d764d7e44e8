"""A sensor followed from frame to frame: its last attitudes predict the next one.

A call of `follow` goes through many frames, until one has to be searched lost in space.
"""

import math
from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Indices
from epipole.tasks.algorithms.geometry.attitude import copy_matrix, turn
from epipole.tasks.algorithms.kernels import borrowing_kernel, inlined_kernel, kernel
from epipole.tasks.algorithms.star_identification.search.match_stars import (
    Attitude,
    Centroids,
    Matches,
    StarDirections,
    aberrated,
    solve_predicted,
    stars_in_cone,
)

RATE_SIGMA = 1e-3  # [rad/s] of a sensor whose rate is unknown so far; the Earth turns it by 7e-5
ACCELERATION_SIGMA = 3e-5  # [rad/s^2] how unevenly a sensor turns
MAX_PREDICTION_SIGMA = 0.02  # [rad] a frame with a wider prediction is searched
MAX_TURNED = 0.5  # [rad] between two frames of a followed sensor
# Stars this far around a field are listed once and serve while the sensor turns [rad].
MARGIN = 0.03
# Status codes; 5 is that of a frame without centroids.
TOO_FEW, NO_MATCH, NOT_SEARCHED, TIME_LIMIT, SEARCH_LIMIT = 1, 2, 3, 4, 6
# Of `Memory.counters`.
N_FIXES, PRIOR_CONFIRMED, TO_SKIP = 0, 1, 2


class Memory(NamedTuple):
    """What is known of a sensor while its frames are followed; the kernels change it.

    t_s, R, P : (2,), (2, 3, 3), (2, 3, 3): times [s], attitudes, sensor from ICRS, and covariances
        about the sensor axes [rad^2] of the last two identified frames, the later one last
    counters : (3,) int64: `N_FIXES`, number of these frames, 0 to 2; `PRIOR_CONFIRMED`, 1 after a
        frame was identified by its prior, 0 after one by a search; `TO_SKIP`, number of further
        frames that are not searched
    near, cone : (stars,) int64 and (5,): the stars around a field; how many, the direction
        (3 numbers) and the radius [rad] of the cone that holds them
    """

    t_s: Array
    R: Array
    P: Array
    counters: Indices
    near: Indices
    cone: Array


def new_memory(n_stars: int) -> Memory:
    """Return the memory of a sensor about which nothing is known."""
    return Memory(
        np.zeros(2),
        np.zeros((2, 3, 3)),
        np.zeros((2, 3, 3)),
        np.zeros(3, np.int64),
        np.empty(n_stars, np.int64),
        np.zeros(5),
    )


class FrameArrays(NamedTuple):
    """A sensor's frames as the kernels take them; F frames, N centroids, C cameras.

    t_s : (F,) float, times [s]
    first, u, sigma, instrumental, beta : as in `SensorCentroids`
    camera : (F,) int64, row of the camera that took the frame
    box, half_diagonal : (C, 4), (C,) float, as in `FieldOfView`
    """

    t_s: Array
    first: Indices
    u: Array
    sigma: Array
    instrumental: Array
    beta: Array
    camera: Indices
    box: Array
    half_diagonal: Array


class FrameRange(NamedTuple):
    """The frames start, start + step, ... before stop, in this order.

    searches : frames that cannot be followed are to be searched
    """

    start: int
    stop: int
    step: int
    searches: bool


class _FieldScratch(NamedTuple):
    """Work space of one frame: predicted attitude and covariance, stars of its field.

    R, P : (3, 3), (3, 3)
    u, magnitude, row : (stars, 3), (stars,), (stars,) int64; apparent directions, magnitudes
        and rows of the catalogue
    """

    R: Array
    P: Array
    u: Array
    magnitude: Array
    row: Indices


@borrowing_kernel
def remember(memory, t_s, R, P):
    """Enter an identified attitude at t_s [s]; R and P (3, 3) as in `Attitude` (compiled)."""
    memory.t_s[0], memory.t_s[1] = memory.t_s[1], t_s
    copy_matrix(memory.R[1], memory.R[0])
    copy_matrix(memory.P[1], memory.P[0])
    copy_matrix(R, memory.R[1])
    copy_matrix(P, memory.P[1])
    memory.counters[N_FIXES] = min(memory.counters[N_FIXES] + 1, 2)


@borrowing_kernel
def predict(memory, t_s, R, P):
    """Write attitude and covariance at t_s [s], extrapolated from the last one or two; return
    whether the prediction is precise enough to be used (compiled).

    R (3, 3), sensor from ICRS, and P (3, 3), about the sensor axes [rad^2], are written.
    """
    t_fix, R_fix, P_fix, n_fixes = memory.t_s, memory.R, memory.P, memory.counters[N_FIXES]
    if n_fixes == 0:
        return False
    dt = t_s - t_fix[1]
    copy_matrix(R_fix[1], R)
    copy_matrix(P_fix[1], P)
    if n_fixes == 1:
        more = (RATE_SIGMA * dt) ** 2
    else:
        step = t_fix[1] - t_fix[0]
        share = dt / step
        x, y, z = _rotation_between(R_fix[0], R_fix[1])
        if x * x + y * y + z * z > MAX_TURNED * MAX_TURNED:
            return False
        turn(R, share * x, share * y, share * z)
        uneven = 0.5 * ACCELERATION_SIGMA * abs(dt) * (abs(dt) + abs(step))
        more = uneven * uneven
        for i in range(3):
            for j in range(3):
                P[i, j] = (1 + share) ** 2 * P_fix[1, i, j] + share**2 * P_fix[0, i, j]
    for i in range(3):
        P[i, i] += more
    return P[0, 0] + P[1, 1] <= 2 * MAX_PREDICTION_SIGMA**2


@kernel
def _rotation_between(A, B):
    """Return the rotation vector of B A', three numbers [rad] about the sensor axes.

    A and B (3, 3) are attitudes, sensor from ICRS. The vector is not longer than pi. Of half a
    turn, its direction is not computed.
    """
    v = np.empty(3)
    trace = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        kj = B[k, 0] * A[j, 0] + B[k, 1] * A[j, 1] + B[k, 2] * A[j, 2]
        jk = B[j, 0] * A[k, 0] + B[j, 1] * A[k, 1] + B[j, 2] * A[k, 2]
        v[i] = 0.5 * (kj - jk)
        trace += B[i, 0] * A[i, 0] + B[i, 1] * A[i, 1] + B[i, 2] * A[i, 2]
    sine = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    angle = math.atan2(sine, 0.5 * (trace - 1.0))
    f = angle / sine if sine > 1e-12 else 1.0
    if sine <= 1e-12 and trace < 0.0:  # half a turn: its axis is not needed
        return math.pi, 0.0, 0.0
    return f * v[0], f * v[1], f * v[2]


@borrowing_kernel
def _field_stars(R, reach, beta, stars, memory, scratch):
    """Write the apparent directions, magnitudes and rows of the stars within `reach` [rad] of the
    boresight to the scratch; return how many.

    R (3, 3) is sensor from ICRS, `beta` (3,) the sensor's velocity over that of light, ICRS axes.
    `stars` are those of the whole sky. Where those that the memory lists do not suffice, its `near`
    and `cone` are written.
    """
    near, cone = memory.near, memory.cone
    dx, dy, dz = R[2, 0] - cone[1], R[2, 1] - cone[2], R[2, 2] - cone[3]
    # A chord is shorter than its angle, by 4 % at a radian.
    if 1.05 * math.sqrt(dx * dx + dy * dy + dz * dz) + reach > cone[4]:
        cone[0] = stars_in_cone(stars.u, len(stars.u), R, min(reach + MARGIN, 3.0), near)
        cone[1], cone[2], cone[3] = R[2, 0], R[2, 1], R[2, 2]
        cone[4] = reach + MARGIN
    c, n = math.cos(reach), 0
    for m in range(int(cone[0])):
        s = near[m]
        x, y, z = stars.u[s, 0], stars.u[s, 1], stars.u[s, 2]
        if R[2, 0] * x + R[2, 1] * y + R[2, 2] * z > c:
            aberrated(x, y, z, beta, scratch.u[n])
            scratch.magnitude[n], scratch.row[n] = stars.magnitude[s], s
            n += 1
    return n


@inlined_kernel
def _solve_near(k, frames, stars, rule, memory, scratch, solutions):
    """Identify frame k near the attitude in `scratch`; return whether its stars confirm it.

    Arguments as in `follow`; `scratch` is a `_FieldScratch`. Frame k of `solutions` may be written
    in any case, the attitudes of `memory` only where the stars confirm it.
    """
    camera = frames.camera[k]
    reach = frames.half_diagonal[camera] + 1e-4
    reach += 4.0 * math.sqrt(max(scratch.P[0, 0], scratch.P[1, 1]))
    n = _field_stars(scratch.R, min(reach, 1.5), frames.beta[k], stars, memory, scratch)
    if n < 3:
        return False
    lo, hi = frames.first[k], frames.first[k + 1]
    solution = Attitude(solutions.R_sensor_from_icrs[k], solutions.cov_rad2[k])
    matches = Matches(solutions.star[lo:hi], solutions.chi2[lo:hi])
    evidence = solve_predicted(
        Attitude(scratch.R, scratch.P),
        False,
        Centroids(frames.u[lo:hi], frames.sigma[lo:hi], frames.instrumental[lo:hi], frames.beta[k]),
        StarDirections(scratch.u[:n], scratch.magnitude[:n]),
        frames.box[camera],
        rule,
        solution,
        matches,
    )
    if not evidence > rule.min_evidence:
        return False
    solutions.solved[k], solutions.evidence[k] = True, evidence
    for m in range(hi - lo):
        if matches.star[m] >= 0:
            matches.star[m] = scratch.row[matches.star[m]]
    remember(memory, frames.t_s[k], solution.R, solution.P)
    memory.counters[TO_SKIP] = 0
    return True


@inlined_kernel
def _identify_next(k, frames, priors, stars, rule, memory, scratch, solutions):
    """Identify frame k from the frames before it, or from its prior; return whether it was.

    Arguments as in `follow`; `scratch` is a `_FieldScratch`. Writes as `_solve_near` does.
    """
    for attempt in range(2):
        if attempt == 0:
            if not predict(memory, frames.t_s[k], scratch.R, scratch.P):
                continue
        else:
            sigma = priors.sigma_rad[k]
            if math.isnan(sigma):
                break
            copy_matrix(priors.R_sensor_from_icrs[k], scratch.R)
            scratch.P[:] = 0.0
            for i in range(3):
                scratch.P[i, i] = sigma * sigma
        if _solve_near(k, frames, stars, rule, memory, scratch, solutions):
            if attempt == 1:
                memory.counters[PRIOR_CONFIRMED] = 1
            return True
    return False


@borrowing_kernel
def _clear(k, first, solutions):
    """Erase what attempts left in the solution of frame k; `first` (F + 1,) as in `FrameArrays`."""
    solutions.R_sensor_from_icrs[k], solutions.cov_rad2[k] = np.nan, np.nan
    solutions.star[first[k] : first[k + 1]] = -1
    solutions.chi2[first[k] : first[k + 1]] = 0.0


@kernel
def follow(frame_range, frames, priors, stars, rule, memory, solutions, status):
    """Identify frames from the attitudes before them; return the first frame whose sky has to
    be searched, or `frame_range.stop` (compiled).

    Parameters
    ----------
    frame_range, frames : FrameRange, FrameArrays
        Which frames, in which order; and the frames.
    priors : Priors
        Attitudes that came with the log.
    stars : StarDirections
        The sky's stars.
    rule : MatchRule
        How matches are weighed.
    memory : Memory
        Kept up to date.
    solutions : Solutions, out
        Frames that are solved already are not changed.
    status : (F,) int8, out
        TOO_FEW centroids, NO_MATCH, NOT_SEARCHED; 0 where solved. Frames with NO_MATCH or
        TIME_LIMIT are not searched again, those with SEARCH_LIMIT are.
    """
    n = len(stars.u)
    scratch = _FieldScratch(
        np.empty((3, 3)), np.empty((3, 3)), np.empty((n, 3)), np.empty(n), np.empty(n, np.int64)
    )
    k = frame_range.start
    while k != frame_range.stop:
        if solutions.solved[k]:
            R, P = solutions.R_sensor_from_icrs[k], solutions.cov_rad2[k]
            remember(memory, frames.t_s[k], R, P)
        elif frames.first[k + 1] - frames.first[k] < 3:
            status[k] = TOO_FEW
        elif _identify_next(k, frames, priors, stars, rule, memory, scratch, solutions):
            status[k] = 0
        else:
            _clear(k, frames.first, solutions)
            if status[k] != NO_MATCH and status[k] != TIME_LIMIT:
                if frame_range.searches and memory.counters[TO_SKIP] == 0:
                    return k
                memory.counters[TO_SKIP] = max(memory.counters[TO_SKIP] - 1, 0)
                if status[k] != SEARCH_LIMIT:
                    status[k] = NOT_SEARCHED
        k += frame_range.step
    return k
