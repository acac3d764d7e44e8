"""Merging: hypotheses that share a tracklet and follow each other in time may be one object.

A hypothesis grows by tracklets that are seen at its solved instants. A sensor that sees the object
only before or after these begins a second hypothesis, with a tracklet of the first. The two do not
contradict each other. They are one object if one orbit fits both.
"""

from collections.abc import Iterable

import numpy as np

from epipole.tasks.algorithms.association.hypothesis_queue import Hypothesis
from epipole.tasks.algorithms.association.odds import score
from epipole.tasks.algorithms.association.search.field_index import near_points
from epipole.tasks.algorithms.association.search.instant_points import possible, solve
from epipole.tasks.algorithms.association.search.search_space import SearchSpace, WorkSpace
from epipole.tasks.algorithms.association.search.sight_lines import quantile
from epipole.tasks.algorithms.kernels import kernel


@kernel
def _weigh(space, work, members, x_km):
    """Return the log-odds of a set of tracklets as one object, and the number of misses.

    -inf if they do not fit. Writes `work.missed`, and the point `x_km` (3,) at the first solved
    instant.
    """
    views, points = space.views, work.points
    points.seen_by[:] = 0
    chi2, dof = solve(views, members, points, work.part)
    if not chi2 <= quantile(max(dof, 1), space.gate_sigma) or not possible(space, members, points):
        return -np.inf, 0
    a = b = views.sensor[members[0]]
    for i in members:
        b = views.sensor[i] if views.sensor[i] != a else b
    n_near = near_points(space, work, a, b)
    x_km[:] = points.x_km[np.argmax(points.seen_by >= 2)]
    return score(space, work, members, work.near[:n_near])


def best_merger(
    space: SearchSpace, work: WorkSpace, h: Hypothesis, others: Iterable[Hypothesis]
) -> Hypothesis | None:
    """Return the likeliest merger of a hypothesis with another; None unless it beats both.

    Another hypothesis is tried only if its other tracklets are not seen at the solved instants of
    `h`: those that are seen there did not fit when `h` grew.
    """
    seen = space.views.seen
    solved = seen[list(h.members)].sum(axis=0) >= 2
    if solved.all():
        return None
    best = None
    tried = {h.members}
    for other in others:
        more = [i for i in other.members if i not in h.members]
        members = tuple(sorted({*h.members, *more}))
        if not more or members in tried or space.taken[more].any() or seen[more][:, solved].any():
            continue
        tried.add(members)
        x_km = np.empty(3)
        value, n_missed = _weigh(space, work, np.array(members, np.int64), x_km)
        if value > max(h.score, other.score, best.score if best else -np.inf):
            best = Hypothesis(value, h.seed, members, x_km, work.missed[:n_missed].copy())
    return best
