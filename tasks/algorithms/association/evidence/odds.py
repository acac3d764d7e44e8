"""Odds: how much more likely one object is than unrelated tracklets."""

import numpy as np

from epipole.tasks.algorithms.association.evidence.arcs import LN_2PI, arc_odds
from epipole.tasks.algorithms.association.evidence.visibility import (
    farthest_range2,
    should_detect,
)
from epipole.tasks.algorithms.association.sampling.views import SPOT_SR, misfit, residual
from epipole.tasks.algorithms.kernels import borrowing_kernel


@borrowing_kernel
def _det3(M):
    return (
        M[0, 0] * (M[1, 1] * M[2, 2] - M[1, 2] * M[2, 1])
        - M[0, 1] * (M[1, 0] * M[2, 2] - M[1, 2] * M[2, 0])
        + M[0, 2] * (M[1, 0] * M[2, 1] - M[1, 1] * M[2, 0])
    )


@borrowing_kernel
def score(space, work, members, near):
    """Return the log-odds of "one object" against "unrelated tracklets", and the number of misses.

    An unrelated tracklet may lie anywhere in its field (`chance.density`), an object anywhere in
    view (`chance.objects_km3`, weighted by altitude with `shells`). Several instants are tied
    together by one orbit, see `arcs`. A sensor that has the point in its field but no tracklet
    of it counts against the object: `work.missed` lists those.

    Parameters
    ----------
    space, work
        `SearchSpace`, and the `WorkSpace` with the solved points.
    near : (n,) int
        Sensors whose field may hold the points, see `near_fields`.
    """
    views, chance, points = space.views, space.chance, work.points
    m, instants = -1, 0
    for k in range(len(views.time_s)):
        if points.seen_by[k] >= 2:
            m = k if m < 0 else m
            instants += 1
    if instants == 1:
        total = 1.5 * LN_2PI + 0.5 * np.log(_det3(points.cov_km2[m]))
        for i in members:
            if views.seen[i, m]:
                total -= np.log(chance.density[views.sensor[i]] * views.sight[i, m, SPOT_SR])
                residual(views, i, m, points.x_km[m], work.part)
                total -= 0.5 * misfit(work.part)
    else:
        total = arc_odds(views, chance, members, points)
    total += np.log(chance.objects_km3) + _altitude_weight(points.x_km[m], space.shells)
    detections, n_missed = _detections(space, work, members, near)
    return total + detections, n_missed


@borrowing_kernel
def _detections(space, work, members, near):
    """Return the log-probability of which sensors detect the object and which miss it.

    Writes the list of those that miss it; also returns how many they are.
    """
    views, detected = space.views, space.chance.detected
    total, n_missed = 0.0, 0
    farthest2 = farthest_range2(views, members, work.points)
    mark = next_mark(work.stamp)
    for i in members:
        s = views.sensor[i]
        if work.stamp[s] != mark:
            work.stamp[s] = mark
            total += np.log(detected[s])
    for s in near:
        if work.stamp[s] != mark and should_detect(views, s, work.points, farthest2):
            work.missed[n_missed] = s
            n_missed += 1
            total += np.log(1.0 - detected[s])
    return total, n_missed


@borrowing_kernel
def next_mark(stamp):
    """Return the number of a new list of sensors, see `WorkSpace.stamp`."""
    stamp[-1] += 1
    return stamp[-1]


@borrowing_kernel
def _altitude_weight(x, shells):
    """Return the log of the object density at this radius over the mean density.

    `shells` are rows of (lowest, highest radius [km], weight). Weights of overlapping shells
    add up. Without shells the density is uniform.
    """
    if len(shells) == 0:
        return 0.0
    radius, weight = np.sqrt(x[0] ** 2 + x[1] ** 2 + x[2] ** 2), 1e-9
    for k in range(len(shells)):
        if shells[k, 0] <= radius < shells[k, 1]:
            weight += shells[k, 2]
    return np.log(weight)
