"""Conflicts: tracklets that another object explains as well as the one that they belong to.

Hypotheses that grew first took the tracklets that fitted best, before the others were known. Once
all groups are known, each tracklet is weighed again. It goes to the object that clearly explains it
best. If two explain it about equally well, it goes to neither.
"""

import numpy as np

from epipole.tasks.algorithms.association.search.candidates import (
    best_of_sensor,
    odds_of_view,
    other_group_near,
)
from epipole.tasks.algorithms.association.search.field_index import near_points
from epipole.tasks.algorithms.association.search.growth import MIN_GAIN, MIN_LEAD
from epipole.tasks.algorithms.association.search.instant_points import solve
from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel

MIN_TRACKLETS = 3  # of an object, before it gains one and after it loses one


@kernel
def resolve_conflicts(space, work, group, x_km):
    """Correct `group` (t,), -1 for no object, for tracklets that two objects explain.

    Only objects of three tracklets or more take part, and none falls below three. `space.taken`
    must be all false. `x_km` (g, 3) are the objects' points at their first instant.
    """
    views, n_groups = space.views, len(x_km)
    k, n_sensors = len(views.time_s), views.camera.shape[0]
    X, P = np.zeros((n_groups, k, 3)), np.zeros((n_groups, k, 3, 3))
    seen_by = np.zeros((n_groups, k), np.int64)
    size = np.zeros(n_groups, np.int64)
    members, first = _by_group(group, n_groups)
    near, first_near = np.empty((4 * len(group), 2), np.int64), np.zeros(n_sensors + 1, np.int64)
    n_near = 0
    for g in range(n_groups):
        of_group = members[first[g] : first[g + 1]]
        if len(of_group) < MIN_TRACKLETS:
            continue
        work.points.seen_by[:] = 0
        if k == 1:  # a good initial point
            work.points.x_km[0], work.points.seen_by[0] = x_km[g], 2
        chi2, _ = solve(views, of_group, work.points, work.part)
        if np.isnan(chi2):
            continue
        X[g], P[g], seen_by[g] = work.points.x_km, work.points.cov_km2, work.points.seen_by
        size[g] = len(of_group)
        n = near_points(space, work, *_two_sensors(views, of_group))
        while n_near + n > len(near):
            longer = np.empty((2 * len(near), 2), np.int64)
            longer[:n_near] = near[:n_near]
            near = longer
        for s in work.near[:n]:
            near[n_near, 0], near[n_near, 1] = s, g
            first_near[s + 1] += 1
            n_near += 1
    groups_near = np.empty(n_near, np.int64)
    first_near = np.cumsum(first_near)
    filled = first_near.copy()
    for q in range(n_near):
        s = near[q, 0]
        groups_near[filled[s]] = near[q, 1]
        filled[s] += 1
    for s in range(n_sensors):  # by sensor: its tracklets fit into a processor's cache
        for g in groups_near[first_near[s] : first_near[s + 1]]:
            if size[g] < MIN_TRACKLETS:
                continue
            _enter_points(work.points, g, X, P, seen_by)
            if not other_group_near(space, work, s, group, g):
                continue
            c, gain, _ = best_of_sensor(space, work, s, members[:0], MIN_GAIN)
            if c < 0 or group[c] < 0 or group[c] == g:
                continue
            o = group[c]
            if size[o] <= MIN_TRACKLETS:
                continue
            _enter_points(work.points, o, X, P, seen_by)
            present_gain = odds_of_view(space, work, s, c)
            if present_gain - gain < MIN_LEAD:
                size[o] -= 1
                group[c] = -1
                if gain - present_gain >= MIN_LEAD and not _has(views, group, s, g):
                    group[c] = g
                    size[g] += 1


@borrowing_kernel
def _enter_points(points, g, X, P, seen_by):
    """Enter the points of group g in `points`, `InstantPoints`.

    Of n groups: `X` (n, k, 3) [km] and `P` (n, k, 3, 3) [km^2], GCRF, and `seen_by` (n, k).
    """
    for m in range(len(points.seen_by)):
        points.seen_by[m] = seen_by[g, m]
        for a in range(3):
            points.x_km[m, a] = X[g, m, a]
            for b in range(3):
                points.cov_km2[m, a, b] = P[g, m, a, b]


@borrowing_kernel
def _two_sensors(views, members):
    """Return two sensors of a group's members (n,); the same one twice if all are of one sensor."""
    a = b = views.sensor[members[0]]
    for i in members:
        b = views.sensor[i] if views.sensor[i] != a else b
    return a, b


@borrowing_kernel
def _has(views, group, s, g):
    """Return whether sensor s has a tracklet in group g; `group` (t,) is that of each tracklet."""
    has = False
    for i in range(views.first[s], views.first[s + 1]):
        has |= group[i] == g
    return has


@kernel
def _by_group(group, n_groups):
    """Return the tracklets sorted by group, and where each group begins.

    `group` (t,) is -1 for no group. Tracklets of group g are ``members[first[g]:first[g + 1]]`` of
    the arrays returned, members (n,) and first (n_groups + 1,).
    """
    first = np.zeros(n_groups + 1, np.int64)
    for g in group:
        if g >= 0:
            first[g + 1] += 1
    for g in range(n_groups):
        first[g + 1] += first[g]
    members, filled = np.zeros(first[n_groups], np.int64), first.copy()
    for i in range(len(group)):
        if group[i] >= 0:
            members[filled[group[i]]] = i
            filled[group[i]] += 1
    return members, first
