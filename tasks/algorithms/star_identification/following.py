"""A sensor followed from frame to frame: the last attitudes predict the next, many frames a
call."""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.geometry.attitude import copy_matrix, turn
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.star_identification.search.field import (
    aberrated,
    solve_predicted,
    stars_in_cone,
)

Array = npt.NDArray[np.float64]

RATE_SIGMA = 1e-3  # rad/s, of a sensor whose rate is not known yet
ACCELERATION_SIGMA = 3e-5  # rad/s^2, how unevenly a sensor turns
WIDEST_PREDICTION = 0.02  # rad; wider ones are no better than being lost
MOST_TURNED = 0.5  # rad, between two frames of a tracked sensor
# Stars are kept this far around a field, to be looked through again while the sensor turns [rad].
MARGIN = 0.03
TOO_FEW, NO_MATCH = 1, 2  # status codes


class Memory(NamedTuple):
    """What is known of a sensor on its way through the frames.

    t_s, R, P : (2,), (2, 3, 3), (2, 3, 3): times, attitudes and covariances of the last two
        identified frames, the later last
    held : (3,) int64: how many of these there are; whether a prior was borne out; how many
        more frames are not to be searched
    near, cone : (stars,) int64 and (5,): the stars around a field, how many, around where and
        how far [rad]
    """

    t_s: Array
    R: Array
    P: Array
    held: npt.NDArray[np.int64]
    near: npt.NDArray[np.int64]
    cone: Array


def new_memory(n_stars: int) -> Memory:
    """Return the memory of a sensor of which nothing is known."""
    return Memory(
        np.zeros(2),
        np.zeros((2, 3, 3)),
        np.zeros((2, 3, 3)),
        np.zeros(3, np.int64),
        np.empty(n_stars, np.int64),
        np.zeros(5),
    )


@kernel
def remember(t_s, R, P, t_fix, R_fix, P_fix, held):
    """Enter an identified attitude (compiled)."""
    t_fix[0], t_fix[1] = t_fix[1], t_s
    copy_matrix(R_fix[1], R_fix[0])
    copy_matrix(P_fix[1], P_fix[0])
    copy_matrix(R, R_fix[1])
    copy_matrix(P, P_fix[1])
    held[0] = min(held[0] + 1, 2)


@kernel
def predict(t_s, t_fix, R_fix, P_fix, held, R, P):
    """Write attitude and covariance at t_s as the last one or two tell; return whether they
    are of use (compiled)."""
    if held[0] == 0:
        return False
    dt = t_s - t_fix[1]
    copy_matrix(R_fix[1], R)
    copy_matrix(P_fix[1], P)
    if held[0] == 1:
        more = (RATE_SIGMA * dt) ** 2
    else:
        step = t_fix[1] - t_fix[0]
        share = dt / step
        x, y, z = _rotation_between(R_fix[0], R_fix[1])
        if x * x + y * y + z * z > MOST_TURNED * MOST_TURNED:
            return False
        turn(R, share * x, share * y, share * z)
        uneven = 0.5 * ACCELERATION_SIGMA * abs(dt) * (abs(dt) + abs(step))
        more = uneven * uneven
        for i in range(3):
            for j in range(3):
                P[i, j] = (1 + share) ** 2 * P_fix[1, i, j] + share**2 * P_fix[0, i, j]
    for i in range(3):
        P[i, i] += more
    return P[0, 0] + P[1, 1] <= 2 * WIDEST_PREDICTION**2


@kernel
def _rotation_between(A, B):
    """Return the rotation vector of B A', shorter than pi."""
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
    if sine <= 1e-12 and trace < 0.0:  # half a turn about an axis that is not worth finding
        return math.pi, 0.0, 0.0
    return f * v[0], f * v[1], f * v[2]


@kernel
def _field_stars(R, reach, beta, star_u, star_mag, near, cone, a, magnitude, row):
    """Write the apparent directions, magnitudes and rows of the stars within `reach` of the
    boresight; return how many."""
    dx, dy, dz = R[2, 0] - cone[1], R[2, 1] - cone[2], R[2, 2] - cone[3]
    # A chord is shorter than its angle, by 4 % at a radian.
    if 1.05 * math.sqrt(dx * dx + dy * dy + dz * dz) + reach > cone[4]:
        cone[0] = stars_in_cone(star_u, len(star_u), R, min(reach + MARGIN, 3.0), near)
        cone[1], cone[2], cone[3] = R[2, 0], R[2, 1], R[2, 2]
        cone[4] = reach + MARGIN
    c, n = math.cos(reach), 0
    for m in range(int(cone[0])):
        s = near[m]
        if R[2, 0] * star_u[s, 0] + R[2, 1] * star_u[s, 1] + R[2, 2] * star_u[s, 2] > c:
            aberrated(star_u[s, 0], star_u[s, 1], star_u[s, 2], beta, a[n])
            magnitude[n], row[n] = star_mag[s], s
            n += 1
    return n


@kernel
def follow(
    k,
    stop,
    step,
    searches,
    t_s,
    first,
    u,
    sigma,
    instrumental,
    beta,
    box,
    half_diagonal,
    optics_of,
    prior_R,
    prior_sigma,
    star_u,
    star_mag,
    gate,
    log_density,
    zero_point,
    spread,
    threshold,
    enough,
    t_fix,
    R_fix,
    P_fix,
    held,
    near,
    cone,
    solved,
    R_of,
    P_of,
    star_of,
    chi2_of,
    evidence_of,
    status,
):
    """Identify frames k, k + step, ... from the attitudes before them; return the first whose
    sky has to be searched, or `stop` (compiled).

    Parameters
    ----------
    k, stop, step, searches
        Frames to go through, and whether one that is lost is to be searched.
    t_s, first, u, sigma, instrumental, beta, box, half_diagonal, optics_of
        As `Frames` has them; the optics' numbers a row a camera.
    prior_R, prior_sigma : (F, 3, 3), (F,)
        Attitudes that came with the log, and their errors an axis [rad]; NaN: none.
    star_u, star_mag
        The sky's stars.
    gate, log_density, zero_point, spread, threshold, enough
        As in `field.solve_predicted`; the least log evidence that is believed.
    t_fix, R_fix, P_fix, held, near, cone
        `Memory`, kept up to date.
    solved, R_of, P_of, star_of, chi2_of, evidence_of : out
        As in `Solutions`. Frames that are solved already are not changed.
    status : (F,) int8, out
        TOO_FEW centroids, NO_MATCH; 0 where solved.
    """
    R0, P0 = np.empty((3, 3)), np.empty((3, 3))
    a, magnitude = np.empty((len(star_u), 3)), np.empty(len(star_u))
    row = np.empty(len(star_u), np.int64)
    while k != stop:
        lo, hi = first[k], first[k + 1]
        if solved[k]:
            remember(t_s[k], R_of[k], P_of[k], t_fix, R_fix, P_fix, held)
        elif hi - lo < 3:
            status[k] = TOO_FEW
        else:
            has_prior = prior_sigma[k] == prior_sigma[k]
            for way in range(2):
                if way == 0 and not predict(t_s[k], t_fix, R_fix, P_fix, held, R0, P0):
                    continue
                if way == 1:
                    if not has_prior:
                        break
                    copy_matrix(prior_R[k], R0)
                    P0[:] = 0.0
                    for i in range(3):
                        P0[i, i] = prior_sigma[k] * prior_sigma[k]
                reach = half_diagonal[optics_of[k]] + 1e-4
                reach += 4.0 * math.sqrt(max(P0[0, 0], P0[1, 1]))
                n = _field_stars(
                    R0, min(reach, 1.5), beta[k], star_u, star_mag, near, cone, a, magnitude, row
                )
                if n < 3:
                    continue
                evidence = solve_predicted(
                    R0, P0, False, u[lo:hi], sigma[lo:hi], instrumental[lo:hi], a[:n],
                    magnitude[:n], box[optics_of[k]], gate, log_density, zero_point, spread,
                    enough, R_of[k], P_of[k], star_of[lo:hi], chi2_of[lo:hi],
                )  # fmt: skip
                if evidence > threshold:
                    solved[k], evidence_of[k], status[k] = True, evidence, 0
                    for m in range(lo, hi):
                        if star_of[m] >= 0:
                            star_of[m] = row[star_of[m]]
                    remember(t_s[k], R_of[k], P_of[k], t_fix, R_fix, P_fix, held)
                    if way == 1:
                        held[1] = 1
                    held[2] = 0
                    break
            if not solved[k]:
                R_of[k], P_of[k] = np.nan, np.nan
                star_of[lo:hi] = -1
                chi2_of[lo:hi] = 0.0
                # Where priors were borne out, a frame that fails has too few stars, not a
                # wrong prior.
                if searches and not (has_prior and held[1] == 1):
                    if held[2] == 0:
                        return k
                    held[2] -= 1
                if status[k] == 0:
                    status[k] = NO_MATCH
        k += step
    return k
