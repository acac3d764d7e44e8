"""Conflicts: tracklets that another object explains as well as the one that they belong to.

Hypotheses that grew first took the tracklets that fitted best, before the others were known. Once
all groups are known, each tracklet is weighed again. It goes to the object that clearly explains it
best. If two explain it about equally well, it goes to neither.
"""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Indices
from epipole.tasks.algorithms.association.search.candidates import (
    best_of_sensor,
    odds_of_view,
    other_group_near,
)
from epipole.tasks.algorithms.association.search.field_index import near_points
from epipole.tasks.algorithms.association.search.growth import MIN_GAIN, MIN_LEAD
from epipole.tasks.algorithms.association.search.instant_points import solve
from epipole.tasks.algorithms.association.search.search_space import doubled
from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel

MIN_TRACKLETS = 3  # of an object, before it gains one and after it loses one


class _Groups(NamedTuple):
    """The points of n groups at k instants.

    x_km, cov_km2 : (n, k, 3), (n, k, 3, 3) float
        Points and their covariances, GCRF.
    seen_by : (n, k) int
        Views of each point; solved are those of two views or more.
    size : (n,) int
        Tracklets of each group; 0 where it does not take part.
    """

    x_km: Array
    cov_km2: Array
    seen_by: Indices
    size: Indices


@kernel
def resolve_conflicts(space, work, group, x_km):
    """Correct `group` (t,), -1 for no object, for tracklets that two objects explain.

    Only objects of three tracklets or more take part, and none falls below three. `space.taken`
    must be all false. `x_km` (g, 3) are the objects' points at their first instant.
    """
    n_sensors = space.views.camera.shape[0]
    groups, near_sensor, near_group = _solve_groups(space, work, group, x_km)
    meetings, first = _sorted_by(near_sensor, n_sensors)
    for s in range(n_sensors):  # by sensor: its tracklets fit into a processor's cache
        for q in meetings[first[s] : first[s + 1]]:
            _weigh_again(space, work, group, groups, s, near_group[q])


@kernel
def _solve_groups(space, work, group, x_km):
    """Return `_Groups`, and the sensors whose field may hold their points: (m,) sensor and group.

    Arguments as in `resolve_conflicts`. Groups with fewer than `MIN_TRACKLETS`, and those whose
    tracklets have no common points, do not take part.
    """
    views, n_groups = space.views, len(x_km)
    k = len(views.time_s)
    groups = _Groups(
        np.zeros((n_groups, k, 3)), np.zeros((n_groups, k, 3, 3)),
        np.zeros((n_groups, k), np.int64), np.zeros(n_groups, np.int64),
    )  # fmt: skip
    members, first = _sorted_by(group, n_groups)
    sensor, of_group, n = np.empty(64, np.int64), np.empty(64, np.int64), 0
    for g in range(n_groups):
        of_g = members[first[g] : first[g + 1]]
        if len(of_g) < MIN_TRACKLETS:
            continue
        work.points.seen_by[:] = 0
        if k == 1:  # a good initial point
            work.points.x_km[0], work.points.seen_by[0] = x_km[g], 2
        chi2, _ = solve(views, of_g, work.points, work.part)
        if np.isnan(chi2):
            continue
        groups.x_km[g], groups.cov_km2[g] = work.points.x_km, work.points.cov_km2
        groups.seen_by[g], groups.size[g] = work.points.seen_by, len(of_g)
        for s in work.near[: near_points(space, work, *_two_sensors(views, of_g))]:
            if n == len(sensor):
                sensor, of_group = doubled(sensor, n), doubled(of_group, n)
            sensor[n], of_group[n] = s, g
            n += 1
    return groups, sensor[:n], of_group[:n]


@borrowing_kernel
def _weigh_again(space, work, group, groups, s, g):
    """Weigh a tracklet of sensor s that group g explains best, but another group has.

    It changes to g if g explains it better by `MIN_LEAD`, and has no other of the sensor; it stays
    if it is better where it is by as much; else it is in no group. Changes `group` (t,) and
    `groups.size`.
    """
    if groups.size[g] < MIN_TRACKLETS:
        return
    _enter_points(work.points, groups, g)
    if not other_group_near(space, work, s, group, g):
        return
    c, gain, _ = best_of_sensor(space, work, s, work.same_sensor[:0], MIN_GAIN)
    if c < 0 or group[c] < 0 or group[c] == g:
        return
    present = group[c]
    if groups.size[present] <= MIN_TRACKLETS:
        return
    _enter_points(work.points, groups, present)
    lead = gain - odds_of_view(space, work, s, c)
    if not lead > -MIN_LEAD:
        return
    groups.size[present] -= 1
    group[c] = -1
    if lead >= MIN_LEAD and not _has(space.views, group, s, g):
        group[c] = g
        groups.size[g] += 1


@borrowing_kernel
def _enter_points(points, groups, g):
    """Enter the points of group g in `points`, `InstantPoints`."""
    for m in range(len(points.seen_by)):
        points.seen_by[m] = groups.seen_by[g, m]
        for a in range(3):
            points.x_km[m, a] = groups.x_km[g, m, a]
            for b in range(3):
                points.cov_km2[m, a, b] = groups.cov_km2[g, m, a, b]


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
def _sorted_by(number, n):
    """Return the rows in order of their number, and where those of each number begin.

    `number` (t,) is from 0 to n - 1, or -1 for rows that are left out. Rows of number k are
    ``rows[first[k]:first[k + 1]]`` of the arrays returned, rows (m,) and first (n + 1,).
    """
    first = np.zeros(n + 1, np.int64)
    for k in number:
        if k >= 0:
            first[k + 1] += 1
    for k in range(n):
        first[k + 1] += first[k]
    rows, filled = np.zeros(first[n], np.int64), first.copy()
    for i in range(len(number)):
        if number[i] >= 0:
            rows[filled[number[i]]] = i
            filled[number[i]] += 1
    return rows, first
