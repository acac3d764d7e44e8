"""Contests: tracklets that another object explains as well as the one that has them.

What grew first took what fitted best while the others were not known. Now that all are, each
looks once more: a tracklet goes to the object that it clearly speaks for, and to none where two
explain it about equally well.
"""

import numpy as np

from epipole.tasks.algorithms.association.evidence.visibility import near_fields
from epipole.tasks.algorithms.association.hypotheses.candidates import best_of_sensor, odds_of_view
from epipole.tasks.algorithms.association.hypotheses.growth import CONTESTED, SPEAKS
from epipole.tasks.algorithms.association.hypotheses.instant_points import solve
from epipole.tasks.algorithms.kernels import kernel


@kernel
def settle_contests(views, chance, group, n_groups, gate_sigma):
    """Write to `group` who has the tracklets that two objects explain; FREE (-1): nobody.

    Only objects of three tracklets or more take part, and none falls below three.
    """
    k, n_sensors = len(views.time_s), views.camera.shape[0]
    X, N = np.zeros((n_groups, k, 3)), np.zeros((k, 3, 3))
    P, seen_by = np.zeros((n_groups, k, 3, 3)), np.zeros((n_groups, k), np.int64)
    part, predicted = np.empty(11), np.empty((k, 7))
    near = np.zeros((n_groups, n_sensors), np.bool_)
    size = np.zeros(n_groups, np.int64)
    has = np.zeros((n_groups, n_sensors), np.bool_)
    members, first = _by_group(group, n_groups)
    for g in range(n_groups):
        own = members[first[g] : first[g + 1]]
        size[g] = len(own)
        for i in own:
            has[g, views.sensor[i]] = True
        if size[g] >= 3:
            chi2, _ = solve(views, own, len(own), (X[g], N, P[g], seen_by[g]), part)
            if np.isnan(chi2):
                size[g] = 0
            else:
                near_fields(views, X[g], P[g], seen_by[g], near[g])
    nobody = np.zeros(len(group), np.bool_)
    for s in range(n_sensors):  # one sensor's tracklets fit into a processor's cache
        for g in range(n_groups):
            if size[g] < 3 or not near[g, s]:
                continue
            points = (X[g], N, P[g], seen_by[g])
            c, gain, _ = best_of_sensor(
                views, chance, s, members, 0, nobody, points, predicted, gate_sigma, SPEAKS
            )
            if c < 0 or group[c] < 0 or group[c] == g:
                continue
            o = group[c]
            if size[o] <= 3:
                continue
            theirs = odds_of_view(views, chance, s, c, (X[o], N, P[o], seen_by[o]), predicted)
            if theirs - gain < CONTESTED:
                size[o] -= 1
                group[c] = -1
                if gain - theirs >= CONTESTED and not has[g, s]:
                    group[c], has[g, s] = g, True
                    size[g] += 1


@kernel
def _by_group(group, n_groups):
    """Return the tracklets group after group, and where each group begins."""
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
