"""Candidates: the tracklet of a sensor that the points of a hypothesis explain best.

`best_of_sensor` is the inner loop of the search:

1. The points are projected onto the sensor's plane, with their covariance (`_predict`).
2. Only grid cells within the gate are searched (`_gate`, `cells_near`).
3. Each free tracklet there is weighed: what it adds to the log-odds (`_fit`).
4. Tracklets that overlap in time with a member of the same sensor are skipped.
"""

import numpy as np

from epipole.tasks.algorithms.association.search.sight_lines import quantile
from epipole.tasks.algorithms.association.views import (
    DX,
    DY,
    HAS_RATE,
    MAX_RATE,
    MAX_SIGMA_KM,
    MAX_VARIANCE,
    PLANE,
    SIGMA_KM,
    V_KM_S,
    XX,
    XY,
    YY,
    X,
    Y,
    cells_near,
    extra_light_s,
)
from epipole.tasks.algorithms.kernels import borrowing_kernel, inlined_kernel

# Columns of `WorkSpace.predicted`: coordinates and covariance on the sensor's plane, depth [km],
# stretch of the plane (the squared distance of a point on it, over that of its middle), the delay
# of `extra_light_s` [s], and the shift of the coordinates by the motion of the sensor in that time.
A0, A1, H00, H01, H11, DEPTH, STRETCH, EXTRA_LIGHT, MOTION0, MOTION1 = range(10)


@inlined_kernel
def best_of_sensor(space, work, s, same_sensor, min_gain):
    """Return the free tracklet of sensor s that adds most to the log-odds.

    Only grid cells within the gate are searched. A tracklet is weighed once, at the first instant
    that it shares with the points. The points are those of `work`; writes `work.predicted`.

    Parameters
    ----------
    space, work
        `SearchSpace` and `WorkSpace`.
    same_sensor : (n,) int
        Members of the hypothesis that are of this sensor.
    min_gain : float
        Minimum log-odds that the tracklet must add.

    Returns
    -------
    int
        The tracklet; -1 if no tracklet adds enough.
    float, float
        Log-odds that it adds, and that the second best adds; `min_gain` where there is no such
        tracklet.
    """
    views, chance, taken, gate_sigma = space.views, space.chance, space.taken, space.gate_sigma
    predicted, seen_by = work.predicted, work.points.seen_by
    best, best_gain, second = -1, min_gain, min_gain
    _predict(views, s, work.points, predicted)
    for m in range(len(views.time_s)):
        if seen_by[m] < 2 or views.grid[s, m, 1] == 0 or not predicted[m, DEPTH] > 0.0:
            continue
        reach0, reach1 = _gate(views, s, m, predicted, gate_sigma)
        lo0, hi0, lo1, hi1 = cells_near(
            views, s, m, predicted[m, A0], predicted[m, A1], reach0, reach1
        )
        for g0 in range(lo0, hi0 + 1):
            row = views.grid[s, m, 0] + g0 * views.grid[s, m, 1]
            for k in range(views.cell_start[row + lo1], views.cell_start[row + hi1 + 1]):
                c = views.cell_item[k]
                if taken[c] or _shared_before(views, c, m, seen_by):
                    continue
                gain = _fit(views, chance, s, c, seen_by, predicted, gate_sigma)
                if gain > second and not _overlaps(views, c, same_sensor):
                    if gain > best_gain:
                        best, best_gain, second = c, gain, best_gain
                    else:
                        second = gain
    return best, best_gain, second


@borrowing_kernel
def _predict(views, s, points, predicted):
    """Write to `predicted` (k, 10) the coordinates of the points for sensor s, with covariance.

    Coordinates are on the sensor's plane. DEPTH is 0 or less for a point behind the sensor.
    """
    x, _, P, seen_by = points
    cam = views.camera  # element by element, see `views.residual`
    for m in range(len(views.time_s)):
        if seen_by[m] < 2:
            continue
        d0, d1, d2 = x[m, 0] - cam[s, m, 0], x[m, 1] - cam[s, m, 1], x[m, 2] - cam[s, m, 2]
        n0, n1, n2 = cam[s, m, PLANE + 6], cam[s, m, PLANE + 7], cam[s, m, PLANE + 8]
        depth = n0 * d0 + n1 * d1 + n2 * d2
        predicted[m, DEPTH] = depth
        if not depth > 0.0:
            continue
        p0, p1, p2 = cam[s, m, PLANE], cam[s, m, PLANE + 1], cam[s, m, PLANE + 2]
        q0, q1, q2 = cam[s, m, PLANE + 3], cam[s, m, PLANE + 4], cam[s, m, PLANE + 5]
        a0 = (p0 * d0 + p1 * d1 + p2 * d2) / depth
        a1 = (q0 * d0 + q1 * d1 + q2 * d2) / depth
        # From here on, derivatives of the coordinates by the position of the point [1/km].
        p0, p1, p2 = (p0 - a0 * n0) / depth, (p1 - a0 * n1) / depth, (p2 - a0 * n2) / depth
        q0, q1, q2 = (q0 - a1 * n0) / depth, (q1 - a1 * n1) / depth, (q2 - a1 * n2) / depth
        t0 = P[m, 0, 0] * p0 + P[m, 0, 1] * p1 + P[m, 0, 2] * p2
        t1 = P[m, 1, 0] * p0 + P[m, 1, 1] * p1 + P[m, 1, 2] * p2
        t2 = P[m, 2, 0] * p0 + P[m, 2, 1] * p1 + P[m, 2, 2] * p2
        predicted[m, A0], predicted[m, A1] = a0, a1
        predicted[m, H00] = p0 * t0 + p1 * t1 + p2 * t2
        predicted[m, H01] = q0 * t0 + q1 * t1 + q2 * t2
        t0 = P[m, 0, 0] * q0 + P[m, 0, 1] * q1 + P[m, 0, 2] * q2
        t1 = P[m, 1, 0] * q0 + P[m, 1, 1] * q1 + P[m, 1, 2] * q2
        t2 = P[m, 2, 0] * q0 + P[m, 2, 1] * q1 + P[m, 2, 2] * q2
        predicted[m, H11] = q0 * t0 + q1 * t1 + q2 * t2
        predicted[m, STRETCH] = 1.0 + a0 * a0 + a1 * a1
        later = extra_light_s(d0, d1, d2, x[m])
        v0, v1, v2 = cam[s, m, V_KM_S], cam[s, m, V_KM_S + 1], cam[s, m, V_KM_S + 2]
        predicted[m, EXTRA_LIGHT] = later
        predicted[m, MOTION0] = later * (p0 * v0 + p1 * v1 + p2 * v2)
        predicted[m, MOTION1] = later * (q0 * v0 + q1 * v1 + q2 * v2)


@borrowing_kernel
def _gate(views, s, m, predicted, gate_sigma):
    """Return the maximum distance of a tracklet from the prediction, along both coordinates.

    They are those of the plane of sensor s at instant m; `predicted` (k, 10) is of `_predict`. The
    errors of direction and position are the largest of the sensor's tracklets there.
    """
    cam = views.camera
    gate = np.sqrt(quantile(2, gate_sigma))
    position_error = cam[s, m, MAX_SIGMA_KM] / predicted[m, DEPTH]
    errors = (cam[s, m, MAX_VARIANCE] + position_error * position_error) * predicted[m, STRETCH]
    drift = abs(predicted[m, EXTRA_LIGHT]) * cam[s, m, MAX_RATE]
    reach0 = gate * np.sqrt(predicted[m, H00] + errors) + abs(predicted[m, MOTION0]) + drift
    reach1 = gate * np.sqrt(predicted[m, H11] + errors) + abs(predicted[m, MOTION1]) + drift
    return reach0, reach1


@borrowing_kernel
def _fit(views, chance, s, c, seen_by, predicted, gate_sigma):
    """Return the log-odds that tracklet c adds; -inf if it does not fit the points.

    This is the log-likelihood of its directions as views of the points, minus the one as an
    unrelated tracklet. At the first instant that they share, an unrelated tracklet may be anywhere
    in the field. From there on, it is uncertain only by the spread of the sensor's rates.
    `seen_by` (k,) is of the points, `predicted` (k, 10) is what `_predict` wrote for sensor s.
    """
    gain, total, n, first_s, see = 0.0, 0.0, 0, 0.0, views.sight
    largest = quantile(2 * len(views.time_s), gate_sigma)  # if it is seen at all instants
    for m in range(len(views.time_s)):
        if seen_by[m] < 2 or not views.seen[c, m]:
            continue
        depth = predicted[m, DEPTH]
        if not depth > 0.0:
            return -np.inf
        x0, x1 = see[c, m, X], see[c, m, Y]
        later, moves = predicted[m, EXTRA_LIGHT], see[c, m, HAS_RATE]
        e0 = predicted[m, A0] - x0 - moves * predicted[m, MOTION0] - later * see[c, m, DX]
        e1 = predicted[m, A1] - x1 - moves * predicted[m, MOTION1] - later * see[c, m, DY]
        extra = (see[c, m, SIGMA_KM] / depth) ** 2
        c00 = see[c, m, XX] + extra * (1.0 + x0 * x0) + predicted[m, H00]
        c01 = see[c, m, XY] + extra * x0 * x1 + predicted[m, H01]
        c11 = see[c, m, YY] + extra * (1.0 + x1 * x1) + predicted[m, H11]
        det = c00 * c11 - c01 * c01
        chi2 = (e0 * e0 * c11 - 2 * e0 * e1 * c01 + e1 * e1 * c00) / det
        total += chi2
        if total > largest:  # most candidates end here, before any logarithm is taken
            return -np.inf
        stretch = predicted[m, STRETCH]
        area_sr = 2 * np.pi * np.sqrt(det / (stretch * stretch * stretch))
        if n == 0:
            gain += np.log(chance.detected[s] / (chance.density[s] * area_sr)) - 0.5 * chi2
            first_s = views.time_s[m]
        else:
            spread_sr = np.pi * (chance.spread[s] * (views.time_s[m] - first_s)) ** 2
            gain += np.log1p(spread_sr / area_sr) - 0.5 * chi2
        n += 1
    return gain if n > 0 and total <= quantile(2 * n, gate_sigma) else -np.inf


@borrowing_kernel
def _shared_before(views, c, m, seen_by):
    """Return whether tracklet c shares an instant before m with the points, by `seen_by` (k,)."""
    shared = False
    for earlier in range(m):
        shared |= seen_by[earlier] >= 2 and views.seen[c, earlier]
    return shared


@borrowing_kernel
def _overlaps(views, c, same_sensor):
    """Return whether c overlaps in time with one of these tracklets of its sensor, or is one.

    `same_sensor` (n,) are the tracklets.
    """
    for o in same_sensor:
        if o == c or (views.start_s[c] <= views.end_s[o] and views.start_s[o] <= views.end_s[c]):
            return True
    return False


@borrowing_kernel
def lasts_throughout(views, c, seen_by):
    """Return whether c lasts from the first solved instant to the last.

    Then no other tracklet of its sensor can be the same object at these instants. `seen_by` (k,) as
    in `InstantPoints`.
    """
    first, last = -1, -1
    for m in range(len(seen_by)):
        if seen_by[m] >= 2:
            first = m if first < 0 else first
            last = m
    if first < 0 or not views.bounded[views.sensor[c]]:
        return False
    return views.seen[c, first] and views.seen[c, last]


@borrowing_kernel
def other_group_near(space, work, s, group, g):
    """Return whether sensor s has a tracklet of another group than g within the gate.

    `group` (t,) are the groups of the tracklets, -1 for no group; these do not count. A fast first
    test: a tracklet within the gate may still not fit. Writes `work.predicted`.
    """
    views, seen_by, predicted = space.views, work.points.seen_by, work.predicted
    _predict(views, s, work.points, predicted)
    for m in range(len(views.time_s)):
        if seen_by[m] < 2 or views.grid[s, m, 1] == 0 or not predicted[m, DEPTH] > 0.0:
            continue
        reach0, reach1 = _gate(views, s, m, predicted, space.gate_sigma)
        lo0, hi0, lo1, hi1 = cells_near(
            views, s, m, predicted[m, A0], predicted[m, A1], reach0, reach1
        )
        for g0 in range(lo0, hi0 + 1):
            row = views.grid[s, m, 0] + g0 * views.grid[s, m, 1]
            for k in range(views.cell_start[row + lo1], views.cell_start[row + hi1 + 1]):
                c = views.cell_item[k]
                if group[c] < 0 or group[c] == g:
                    continue
                off0 = abs(views.sight[c, m, X] - predicted[m, A0])
                if off0 <= reach0 and abs(views.sight[c, m, Y] - predicted[m, A1]) <= reach1:
                    return True
    return False


@borrowing_kernel
def odds_of_view(space, work, s, c):
    """Return the log-odds that tracklet c of sensor s adds to the points, without a gate.

    The points are those of `work`; writes `work.predicted`.
    """
    _predict(space.views, s, work.points, work.predicted)
    seen_by = work.points.seen_by
    return _fit(space.views, space.chance, s, c, seen_by, work.predicted, np.inf)
