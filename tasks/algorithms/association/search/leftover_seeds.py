"""Leftover seeds: where no pair of sensors has looked for an object.

Among many sensors only some pairs seed, enough to cover the middle of the space that they share
(`sensor_pairs`). In the corners of their fields, an object may be seen by two that were skipped. So
the tracklets that are in no group at the end are compared with each other. Without that, 14 of 48
objects in the corners of two of 8 or 16 fields were lost.
"""

import numpy as np

from epipole.tasks.algorithms.association.odds import in_view
from epipole.tasks.algorithms.association.search.search_space import doubled
from epipole.tasks.algorithms.association.search.seeds import meet
from epipole.tasks.algorithms.association.search.sight_lines import meeting_point
from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel

# Maximum number of tracklets in no group, of a sensor that takes part. With 150, 20 sensors with
# 100 false points each take 40 % longer, and find the same.
MAX_LEFT = 30


@kernel
def leftover_seeds(space, pairs, enough, gate_sigma):
    """Return (n, 2): free tracklets of two sensors whose lines of sight meet.

    Parameters
    ----------
    space
        `SearchSpace`.
    pairs
        `RankedPairs`: tracklets of those that were skipped are compared.
    enough : float
        Where this number of the pairs that have seeded see the point, they would have found it.
    gate_sigma : float
        As in `seeds_between`.
    """
    views, n = space.views, 0
    left, first = _left_by_sensor(space)
    work, x, sees = np.empty((2, 3)), np.empty(3), np.empty(len(first) - 1, np.bool_)
    out = np.empty((64, 2), np.int64)
    for k in range(len(pairs.a)):
        a, b = pairs.a[k], pairs.b[k]
        if not pairs.waiting[k] or max(first[a + 1] - first[a], first[b + 1] - first[b]) > MAX_LEFT:
            continue
        for i in left[first[a] : first[a + 1]]:
            for j in left[first[b] : first[b + 1]]:
                m = _first_shared(views, i, j)
                if m < 0 or not meet(space, i, j, m, gate_sigma, work):
                    continue
                meeting_point(views, i, j, m, work, x)
                if _is_covered(views, pairs, m, x, enough, sees):
                    continue
                if n == len(out):
                    out = doubled(out, n)
                out[n, 0], out[n, 1] = i, j
                n += 1
    return out[:n]


@kernel
def _left_by_sensor(space):
    """Return the free tracklets, in order, and the first of each sensor (s + 1,)."""
    views = space.views
    left, first = np.flatnonzero(~space.taken), np.zeros(len(views.first), np.int64)
    for i in left:
        first[views.sensor[i] + 1] += 1
    return left, np.cumsum(first)


@borrowing_kernel
def _first_shared(views, i, j):
    """Return the first instant at which both tracklets are seen, -1 if there is none."""
    for m in range(len(views.time_s)):
        if views.seen[i, m] and views.seen[j, m]:
            return m
    return -1


@borrowing_kernel
def _is_covered(views, pairs, m, x, enough, sees):
    """Return whether `enough` pairs that have seeded have x (3,) [km] in their fields.

    That is at instant m; `sees` (s,) bool is work space.
    """
    for s in range(len(sees)):
        sees[s] = in_view(views.camera[s, m], x)
    n = 0
    for k in range(len(pairs.a)):
        n += not pairs.waiting[k] and sees[pairs.a[k]] and sees[pairs.b[k]]
        if n >= enough:
            return True
    return False
