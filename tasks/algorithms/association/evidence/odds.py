"""Odds: how much likelier one object is than unrelated tracklets."""

import numpy as np

from epipole.tasks.algorithms.association.evidence.arcs import LN_2PI, arc_odds
from epipole.tasks.algorithms.association.evidence.visibility import looks_at
from epipole.tasks.algorithms.association.sampling.views import SPOT_SR, misfit, residual
from epipole.tasks.algorithms.kernels import kernel


@kernel
def _det3(M):
    return (
        M[0, 0] * (M[1, 1] * M[2, 2] - M[1, 2] * M[2, 1])
        - M[0, 1] * (M[1, 0] * M[2, 2] - M[1, 2] * M[2, 0])
        + M[0, 2] * (M[1, 0] * M[2, 1] - M[1, 1] * M[2, 0])
    )


@kernel
def score(views, chance, members, n, points, part, shells, near, looks):
    """Return the log of the odds "one object" against "unrelated tracklets".

    A stray lies anywhere in its field (`chance.density`) and an object anywhere in view
    (`chance.objects_km3`, weighed by altitude where `shells` say so). Several instants are tied
    together by one orbit, see `arcs`. A sensor that looks at the point and has nothing there
    counts against it; `near` tells which may, `looks` in the end which did (see `_detections`).
    """
    X, _, P, seen_by = points
    m, instants = -1, 0
    for k in range(len(views.time_s)):
        if seen_by[k] >= 2:
            m = k if m < 0 else m
            instants += 1
    if instants == 1:
        total = 1.5 * LN_2PI + 0.5 * np.log(_det3(P[m]))
        for q in range(n):
            i = members[q]
            if views.seen[i, m]:
                total -= np.log(chance.density[views.sensor[i]] * views.sight[i, m, SPOT_SR])
                residual(views, i, m, X[m], part)
                total -= 0.5 * misfit(part)
    else:
        total = arc_odds(views, chance, members, n, X, seen_by)
    total += np.log(chance.objects_km3) + _altitude_weight(X[m], shells)
    return total + _detections(views, chance, members, n, X, seen_by, near, looks)


@kernel
def _detections(views, chance, members, n, X, seen_by, near, looks):
    """Return the log-probability that these sensors have it and the others that look do not.

    Writes who they are: `looks` is 1, or -1 where a sensor looks in vain.
    """
    total = 0.0
    looks[:] = 0
    for q in range(n):
        looks[views.sensor[members[q]]] = 1
    for s in range(len(looks)):
        if looks[s] == 1:
            total += np.log(chance.detected[s])
        elif near[s] and looks_at(views, s, X, seen_by):
            looks[s] = -1
            total += np.log(1.0 - chance.detected[s])
    return total


@kernel
def _altitude_weight(x, shells):
    """Return the log of how much likelier objects are at this height than on average.

    `shells` are rows of (lowest, highest radius [km], weight), which add up; none: all heights
    are alike.
    """
    if len(shells) == 0:
        return 0.0
    radius, weight = np.sqrt(x[0] ** 2 + x[1] ** 2 + x[2] ** 2), 1e-9
    for k in range(len(shells)):
        if shells[k, 0] <= radius < shells[k, 1]:
            weight += shells[k, 2]
    return np.log(weight)
