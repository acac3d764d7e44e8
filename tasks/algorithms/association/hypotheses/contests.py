"""Contests: tracklets that a second object explains as well as the object that has them.

Hypotheses that grew first took what fitted best, before the others were known. Once all are
known, every tracklet is judged again: it goes to the object that clearly explains it best, and
to no object where two explain it about equally well.
"""

import numpy as np

from epipole.tasks.algorithms.association.evidence.points import InstantPoints
from epipole.tasks.algorithms.association.evidence.visibility import near_fields
from epipole.tasks.algorithms.association.hypotheses.candidates import best_of_sensor, odds_of_view
from epipole.tasks.algorithms.association.hypotheses.growth import CONTESTED, SPEAKS
from epipole.tasks.algorithms.association.hypotheses.instant_points import solve
from epipole.tasks.algorithms.association.hypotheses.search_space import (
    PREDICTED_COLUMNS,
    RESIDUAL_PARTS,
    WorkSpace,
)
from epipole.tasks.algorithms.kernels import kernel

FEWEST = 3  # tracklets of an object that may gain or lose one


@kernel
def settle_contests(space, group, n_groups):
    """Correct `group` (-1: no object) for tracklets that two objects explain.

    Only objects of three tracklets or more take part, and none falls below three.
    `space.taken` must be all false.
    """
    views = space.views
    k, n_sensors = len(views.time_s), views.camera.shape[0]
    X, N = np.zeros((n_groups, k, 3)), np.zeros((k, 3, 3))
    P, seen_by = np.zeros((n_groups, k, 3, 3)), np.zeros((n_groups, k), np.int64)
    part, predicted = np.empty(RESIDUAL_PARTS), np.empty((k, PREDICTED_COLUMNS))
    near = np.zeros((n_groups, n_sensors), np.bool_)
    size = np.zeros(n_groups, np.int64)
    has = np.zeros((n_groups, n_sensors), np.bool_)
    members, first = _by_group(group, n_groups)
    for g in range(n_groups):
        of_group = members[first[g] : first[g + 1]]
        size[g] = len(of_group)
        for i in of_group:
            has[g, views.sensor[i]] = True
        if size[g] >= FEWEST:
            chi2, _ = solve(views, of_group, InstantPoints(X[g], N, P[g], seen_by[g]), part)
            if np.isnan(chi2):
                size[g] = 0
            else:
                near_fields(views, X[g], P[g], seen_by[g], near[g])
    for s in range(n_sensors):  # one sensor's tracklets fit into a processor's cache
        for g in range(n_groups):
            if size[g] < FEWEST or not near[g, s]:
                continue
            points = InstantPoints(X[g], N, P[g], seen_by[g])
            work = WorkSpace(points, part, predicted, near[g])
            c, gain, _ = best_of_sensor(space, work, s, members[:0], SPEAKS)
            if c < 0 or group[c] < 0 or group[c] == g:
                continue
            o = group[c]
            if size[o] <= FEWEST:
                continue
            points = InstantPoints(X[o], N, P[o], seen_by[o])
            theirs = odds_of_view(space, WorkSpace(points, part, predicted, near[o]), s, c)
            if theirs - gain < CONTESTED:
                size[o] -= 1
                group[c] = -1
                if gain - theirs >= CONTESTED and not has[g, s]:
                    group[c], has[g, s] = g, True
                    size[g] += 1


@kernel
def _by_group(group, n_groups):
    """Return the tracklets sorted by group, and where each group begins."""
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
