"""Links by prediction forward and backward, weighted by speed: the published method.

Cheng, Wang, Li et al. (2021), patent: image-plane track fragment association by forward and
backward prediction with velocity weighting. The old fragment is filtered forward, the new one
backward, both with constant acceleration; across the gap both are predicted with constant
velocity; about an instant that their speeds choose they must agree. The printed source lacks
its formulas; process noise, window and test quantity are reconstructed.

Directions stand in for the image plane: the filters run on the three components of the unit
vector, which share one covariance, and the comparison is made on the plane of the sky.
"""

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.tracking.linking.chains import Links, choose_links

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

DEGREES_OF_FREEDOM = 4  # the window's instants are almost fully correlated: they count as one
HALF_WINDOW = 5  # instants on each side of the middle one
FASTEST_RAD_S = 0.1  # 1-sigma of a rate not yet measured
HARDEST_RAD_S2 = 1e-3  # 1-sigma of an acceleration not yet measured


@kernel
def _filter(time_s, u, sigma, first, last, step, q, x, P):
    """Run the constant-acceleration filter over the detections first, first + step .. last.

    x (3, 3) receives place, rate and acceleration of the three components at the last one,
    P (3, 3) the covariance that the components share. Backward, time steps are negative and
    the process noise is -Q(T), which turns the sign of its odd terms only.
    """
    x[:] = 0.0
    x[0] = u[first]
    P[:] = 0.0
    P[0, 0], P[1, 1], P[2, 2] = sigma[first] ** 2, FASTEST_RAD_S**2, HARDEST_RAD_S2**2
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
            miss = u[k, a] - x[0, a]
            for m in range(3):
                x[m, a] += gain[m] * miss
        row = P[0].copy()
        for m in range(3):
            for j in range(3):
                P[m, j] -= gain[m] * row[j]


@kernel
def _filter_all(offsets, time_s, u, sigma, backward, q, X, P):
    for f in range(len(offsets) - 1):
        lo, hi = offsets[f], offsets[f + 1] - 1
        if backward:
            _filter(time_s, u, sigma, hi, lo, -1, q, X[f], P[f])
        else:
            _filter(time_s, u, sigma, lo, hi, 1, q, X[f], P[f])


@kernel
def _covariance_at(P, T, q):
    """Return the entries of the constant-velocity covariance predicted over T."""
    noise = q if T >= 0 else -q
    p00 = P[0, 0] + 2 * T * P[0, 1] + T * T * P[1, 1] + noise * T**3 / 3
    p01 = P[0, 1] + T * P[1, 1] + noise * T**2 / 2
    return p00, p01, P[1, 1] + noise * T


@kernel
def _distance(x_1, P_1, t_1, x_2, P_2, t_2, interval_s, q):
    """Return the mean over the window of the two predictions' squared Mahalanobis distance."""
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
        # What lies along the line of sight is no displacement on the sky.
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
def _compare_all(by_start, start, end, gap_s, X_1, P_1, X_2, P_2, interval_s, q, limit):
    """Return the pairs (earlier, later) within the limit and their test quantity."""
    room, count = 1024, 0
    first, second = np.empty(room, np.int64), np.empty(room, np.int64)
    found = np.empty(room)
    sorted_start = start[by_start]
    for i in range(len(start)):
        for k in range(np.searchsorted(sorted_start, end[i], side="right"), len(start)):
            j = by_start[k]
            if start[j] - end[i] > gap_s:
                break
            D = _distance(X_1[i], P_1[i], end[i], X_2[j], P_2[j], start[j], interval_s, q)
            if not limit > D:
                continue
            if count == room:
                room *= 2
                first = np.concatenate((first, np.empty(count, np.int64)))
                second = np.concatenate((second, np.empty(count, np.int64)))
                found = np.concatenate((found, np.empty(count)))
            first[count], second[count], found[count] = i, j, D
            count += 1
    return first[:count], second[:count], found[:count]


def link_by_prediction(
    offsets: Indices,
    time_s: Array,
    u_icrs: Array,
    sigma_rad: Array,
    *,
    gap_s: float,
    kept: float,
    interval_s: float,
    q_rad2_s3: float,
) -> Links:
    """Return which fragment continues which, by predictions that meet in the gap.

    Parameters
    ----------
    offsets : (g + 1,) int
        Fragment k has the detections ``offsets[k]:offsets[k + 1]``, in time order, at least one.
    time_s, u_icrs, sigma_rad : (n,), (n, 3), (n,) float
        Times [s], unit vectors, and their 1-sigma errors an axis [rad].
    gap_s
        Longest gap bridged.
    kept
        Share of true links that the chi-square test lets pass, were the models exact.
    interval_s
        Between the instants compared: the sensor's frame interval.
    q_rad2_s3
        Process noise of both models: white acceleration [rad^2/s^3] across the gap, and the
        same number of white jerk [rad^2/s^5] in the fragments. It decides what is linked.

    References
    ----------
    Cheng, Wang, Li et al. (2021); see the module.
    """
    n = len(offsets) - 1
    X_1, P_1, X_2, P_2 = (np.zeros((n, 3, 3)) for _ in range(4))
    _filter_all(offsets, time_s, u_icrs, sigma_rad, False, float(q_rad2_s3), X_1, P_1)
    _filter_all(offsets, time_s, u_icrs, sigma_rad, True, float(q_rad2_s3), X_2, P_2)
    start, end = time_s[offsets[:-1]], time_s[offsets[1:] - 1]
    limit = float(chdtri(DEGREES_OF_FREEDOM, 1.0 - kept))
    earlier, later, D = _compare_all(
        np.argsort(start, kind="stable"), start, end, float(gap_s), X_1, P_1, X_2, P_2,
        float(interval_s), float(q_rad2_s3), limit,
    )  # fmt: skip
    return choose_links(earlier, later, limit - D, D, n)
