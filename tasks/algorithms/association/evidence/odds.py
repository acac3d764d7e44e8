"""Odds: how much more likely one object is than unrelated tracklets."""

import numpy as np

from epipole.tasks.algorithms.association.evidence.arcs import LN_2PI, arc_odds
from epipole.tasks.algorithms.association.evidence.visibility import should_detect
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
def score(views, chance, members, points, shells, near, outcomes, part):
    """Return the log-odds of "one object" against "unrelated tracklets".

    An unrelated tracklet may lie anywhere in its field (`chance.density`), an object anywhere in
    view (`chance.objects_km3`, weighted by altitude with `shells`). Several instants are tied
    together by one orbit, see `arcs`. A sensor that has the point in its field but no tracklet
    of it counts against the object.

    Parameters
    ----------
    near : (s,) bool
        Sensors whose field may hold the points, see `near_fields`.
    outcomes : (s,) int
        Output, see `_detections`.
    part : (11,) float
        Work space, see `residual`.
    """
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
                residual(views, i, m, points.x_km[m], part)
                total -= 0.5 * misfit(part)
    else:
        total = arc_odds(views, chance, members, points)
    total += np.log(chance.objects_km3) + _altitude_weight(points.x_km[m], shells)
    return total + _detections(views, chance, members, points, near, outcomes)


@borrowing_kernel
def _detections(views, chance, members, points, near, outcomes):
    """Return the log-probability of which sensors detect the object and which miss it.

    Writes `outcomes` for each sensor: 1 detection, -1 miss, 0 where none is expected.
    """
    total = 0.0
    outcomes[:] = 0
    for i in members:
        outcomes[views.sensor[i]] = 1
    for s in range(len(outcomes)):
        if outcomes[s] == 1:
            total += np.log(chance.detected[s])
        elif near[s] and should_detect(views, members, s, points):
            outcomes[s] = -1
            total += np.log(1.0 - chance.detected[s])
    return total


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
