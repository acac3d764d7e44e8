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
    """Return the log-odds of a set of tracklets, `members` (n,), as one object, as `odds.score`.

    -inf if they do not fit. Writes `work.missed`, and the point `x_km` (3,), GCRF, at the first
    solved instant.
    """
    views, points = space.views, work.points
    points.seen_by[:] = 0
    chi2, dof = solve(views, members, points, work.part)
    if not chi2 <= quantile(max(dof, 1), space.gate_sigma) or not possible(space, members, points):
        return -np.inf, 0.0, 0
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

    A fragment of a track adds little to the odds of an object that has the rest of the track. So
    the odds that both are fragments of one track count too. A merger may have a lower score than
    `h`.
    """
    seen = space.views.seen
    solved = seen[list(h.members)].sum(axis=0) >= 2
    if solved.all():
        return None
    best, best_odds, x_km = None, -np.inf, np.empty(3)
    odds_of_h: float | None = None
    tried = {h.members}
    for other in others:
        added = [i for i in other.members if i not in h.members]
        members = tuple(sorted({*h.members, *added}))
        if not added or members in tried or space.taken[added].any():
            continue
        if seen[added][:, solved].any():
            continue
        tried.add(members)
        value, fragments, n_missed = _weigh(space, work, np.array(members, np.int64), x_km)
        if not value + fragments > best_odds:
            continue
        merger = Hypothesis(value, h.seed, members, x_km.copy(), work.missed[:n_missed].copy())
        odds_of_h = _with_fragments(space, work, h) if odds_of_h is None else odds_of_h
        if value + fragments > max(odds_of_h, _with_fragments(space, work, other)):
            best, best_odds = merger, value + fragments
    return best


def _with_fragments(space: SearchSpace, work: WorkSpace, h: Hypothesis) -> float:
    """Return the log-odds of a hypothesis and of its fragments as one track."""
    sensors = set(space.views.sensor[list(h.members)].tolist())
    if len(sensors) == len(h.members):
        return h.score
    return h.score + float(_weigh(space, work, np.array(h.members, np.int64), np.empty(3))[1])
