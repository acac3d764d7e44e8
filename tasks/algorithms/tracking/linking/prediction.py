"""Links by prediction forward and backward, weighted by speed [published].

Cheng, Wang, Li et al. (2021), patent: image-plane track fragment association by forward and
backward prediction with velocity weighting. The old fragment is filtered forward, the new one
backward, both with constant acceleration. Across the gap both are predicted with constant
velocity, and they must agree about a time that follows from their speeds. The printed source lacks
its formulas: process noise, window and test quantity are reconstructed.

Directions stand in for the image plane: the filters run on the three components of the unit
vector, which share one covariance, and the comparison is made on the plane of the sky.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from epipole.schemas.arrays import Array
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.tracking.linking.chains import (
    Fragments,
    LinkRule,
    Links,
    choose_links,
)

MAX_GAP_S = 90.0  # maximum gap unless one is given: the process noise does not suit longer ones
DEGREES_OF_FREEDOM = 4  # of one time: those of the window are almost fully correlated
HALF_WINDOW = 5  # times on each side of the middle one
RATE_SIGMA_RAD_S = 0.1  # 1-sigma of a rate not yet measured
ACCELERATION_SIGMA_RAD_S2 = 1e-3  # 1-sigma of an acceleration not yet measured


class _EndStates(NamedTuple):
    """Filtered states at one end of each fragment.

    at : (g,) float, times [s]
    x, P : (g, 3, 3), (g, 3, 3) float, as in `_filter`
    """

    at: Array
    x: Array
    P: Array


@kernel
def _filter(fragments, first, last, step, q, x, P):
    """Run the constant-acceleration filter over the detections first, first + step .. last.

    x (3, 3) receives value, rate and acceleration of the three components at the last one, P (3, 3)
    the covariance that the components share; q [rad^2/s^5] is the process noise. Backward, time
    steps are negative and the process noise is -Q(T), which turns the sign of its odd terms only.
    """
    time_s, u, sigma = fragments.time_s, fragments.u_icrs, fragments.sigma_rad
    x[:] = 0.0
    x[0] = u[first]
    P[:] = 0.0
    P[0, 0], P[1, 1], P[2, 2] = sigma[first] ** 2, RATE_SIGMA_RAD_S**2, ACCELERATION_SIGMA_RAD_S2**2
    phi, Q, gain = np.eye(3), np.empty((3, 3)), np.empty(3)
    k = first
    while k != last:
        T = time_s[k + step] - time_s[k]
        k += step
        phi[0, 1] = phi[1, 2] = T
        phi[0, 2] = 0.5 * T * T
        sign = 1.0 if T >= 0 else -1.0
        Q[0, 0], Q[0, 1], Q[0, 2] = T**5 / 20, T**4 / 8, T**3 / 6
        Q[1, 0], Q[1, 1], Q[1, 2] = T**4 / 8, T**3 / 3, T**2 / 2
        Q[2, 0], Q[2, 1], Q[2, 2] = T**3 / 6, T**2 / 2, T
        x[:] = phi @ x
        P[:] = phi @ P @ phi.T + (sign * q) * Q
        s = P[0, 0] + sigma[k] ** 2
        for a in range(3):
            gain[a] = P[a, 0] / s
        for a in range(3):
            innovation = u[k, a] - x[0, a]
            for m in range(3):
                x[m, a] += gain[m] * innovation
        row = P[0].copy()
        for m in range(3):
            for j in range(3):
                P[m, j] -= gain[m] * row[j]


@kernel
def _filter_all(fragments, backward, q):
    """Return the states at the last detection of each fragment, or backward at the first.

    They are `_EndStates`; q [rad^2/s^5] is the process noise.
    """
    offsets = fragments.offsets
    n = len(offsets) - 1
    states = _EndStates(np.empty(n), np.zeros((n, 3, 3)), np.zeros((n, 3, 3)))
    for f in range(n):
        first, last, step = offsets[f], offsets[f + 1] - 1, 1
        if backward:
            first, last, step = last, first, -1
        _filter(fragments, first, last, step, q, states.x[f], states.P[f])
        states.at[f] = fragments.time_s[last]
    return states


@kernel
def _covariance_at(P, T, q):
    """Return the entries of the constant-velocity covariance predicted over T [s].

    They are of the value, of value and rate, and of the rate [rad^2, rad^2/s, rad^2/s^2]. P (3, 3)
    is as in `_filter`; q [rad^2/s^3] is the process noise.
    """
    noise = q if T >= 0 else -q
    p00 = P[0, 0] + 2 * T * P[0, 1] + T * T * P[1, 1] + noise * T**3 / 3
    p01 = P[0, 1] + T * P[1, 1] + noise * T**2 / 2
    return p00, p01, P[1, 1] + noise * T


@kernel
def _distance(x_1, P_1, t_1, x_2, P_2, t_2, interval_s, q):
    """Return the mean over the window of the two predictions' squared Mahalanobis distance.

    x_1, x_2, P_1, P_2 (3, 3) are as in `_filter`, at the times t_1 before t_2 [s]; q [rad^2/s^3] is
    the process noise.
    """
    speed_1, speed_2, norm = 0.0, 0.0, 0.0
    middle = np.empty(3)
    for a in range(3):
        speed_1 += x_1[1, a] ** 2
        speed_2 += x_2[1, a] ** 2
        middle[a] = x_1[0, a] + x_2[0, a]
        norm += middle[a] ** 2
    middle /= np.sqrt(norm)
    speed_1, speed_2 = np.sqrt(speed_1), np.sqrt(speed_2)
    both = speed_1 + speed_2
    share = speed_1 / both if both > 0 else 0.5
    centre = share * t_1 + (1 - share) * t_2
    total, count = 0.0, 0
    for k in range(-HALF_WINDOW, HALF_WINDOW + 1):
        t = centre + k * interval_s
        if k != 0 and not t_1 <= t <= t_2:
            continue
        T_1, T_2 = t - t_1, t - t_2
        a00, a01, a11 = _covariance_at(P_1, T_1, q)
        b00, b01, b11 = _covariance_at(P_2, T_2, q)
        c00, c01, c11 = a00 + b00, a01 + b01, a11 + b11
        # Only the displacement across the line of sight counts.
        pp, pv, vv, p_along, v_along = 0.0, 0.0, 0.0, 0.0, 0.0
        for a in range(3):
            p = x_1[0, a] + T_1 * x_1[1, a] - x_2[0, a] - T_2 * x_2[1, a]
            v = x_1[1, a] - x_2[1, a]
            pp += p * p
            pv += p * v
            vv += v * v
            p_along += p * middle[a]
            v_along += v * middle[a]
        pp -= p_along * p_along
        pv -= p_along * v_along
        vv -= v_along * v_along
        total += (c11 * pp - 2 * c01 * pv + c00 * vv) / (c00 * c11 - c01 * c01)
        count += 1
    return total / count


@kernel
def _compare_all(tail, head, by_start, rule, limit):
    """Return the pairs (earlier, later) within the limit and their test quantity, (p,) each.

    by_start (g,) int has the fragments in order of `head.at`; `tail` and `head` are `_EndStates`.
    """
    capacity, count, q = 1024, 0, rule.noise_rad2_s3
    first, second = np.empty(capacity, np.int64), np.empty(capacity, np.int64)
    distance = np.empty(capacity)
    start, end = head.at, tail.at
    sorted_start = start[by_start]
    for i in range(len(start)):
        for k in range(np.searchsorted(sorted_start, end[i], side="right"), len(start)):
            j = by_start[k]
            if start[j] - end[i] > rule.gap_s:
                break
            D = _distance(
                tail.x[i], tail.P[i], end[i], head.x[j], head.P[j], start[j], rule.interval_s, q
            )
            if not limit > D:
                continue
            if count == capacity:
                capacity *= 2
                first = np.concatenate((first, np.empty(count, np.int64)))
                second = np.concatenate((second, np.empty(count, np.int64)))
                distance = np.concatenate((distance, np.empty(count)))
            first[count], second[count], distance[count] = i, j, D
            count += 1
    return first[:count], second[:count], distance[:count]


def link_by_prediction(fragments: Fragments, rule: LinkRule) -> Links:
    """Return which fragment continues which, by predictions that meet in the gap.

    Parameters
    ----------
    rule
        ``noise_rad2_s3`` is the process noise of both models: white acceleration [rad^2/s^3]
        across the gap, and the same number of white jerk [rad^2/s^5] in the fragments. It
        decides what is linked. The times compared are ``interval_s`` apart.

    References
    ----------
    Cheng, Wang, Li et al. (2021); see the module.
    """
    rule = rule._replace(gap_s=rule.gap_s if np.isfinite(rule.gap_s) else MAX_GAP_S)
    tail = _filter_all(fragments, False, rule.noise_rad2_s3)
    head = _filter_all(fragments, True, rule.noise_rad2_s3)
    limit = float(chdtri(DEGREES_OF_FREEDOM, 1.0 - rule.confidence))
    by_start = np.argsort(head.at, kind="stable")
    earlier, later, D = _compare_all(tail, head, by_start, rule, limit)
    return choose_links(earlier, later, limit - D, D, len(head.at))
