"""Leftover seeds: where no pair of sensors has looked for an object.

Among many sensors only some pairs seed, enough to cover the middle of the space that they share
(`sensor_pairs`). In the corners of their fields, an object may be seen by two that were skipped;
and so may one that is near to these two, and too faint for the sensors of the pairs. So
the tracklets that are in no group at the end are compared with each other. Without that, 14 of 48
objects in the corners of two of 8 or 16 fields were lost.
"""

import numpy as np

from epipole.tasks.algorithms.association.odds import MAX_RANGE_RATIO, in_view, range2_of
from epipole.tasks.algorithms.association.search.search_space import doubled
from epipole.tasks.algorithms.association.search.seeds import meet
from epipole.tasks.algorithms.association.search.sight_lines import meeting_point
from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel

# Maximum number of a sensor's tracklets in no group: with more, it takes no part. With 150, 20
# sensors with 100 false points each take 40 % longer, and find the same.
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
        A point that this number of the pairs that have seeded should see needs no seed. A sensor
        that is much farther away than the two need not see it.
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
                _write_seeing(views, (a, b), m, x, sees)
                if _is_covered(pairs, enough, sees):
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
def _write_seeing(views, of_seed, m, x, sees):
    """Write which sensors should see an object at x (3,) [km] at instant m to `sees` (s,).

    They have x in their fields, and are not much farther away than the nearer one of two sensors
    that do see it, `of_seed`: for the others it may be too faint, as in `odds.should_detect`.
    """
    one, other = of_seed
    nearest2 = min(range2_of(views.camera, one, m, x), range2_of(views.camera, other, m, x))
    for s in range(len(sees)):
        sees[s] = (
            in_view(views.camera[s, m], x)
            and range2_of(views.camera, s, m, x) <= MAX_RANGE_RATIO * MAX_RANGE_RATIO * nearest2
        )


@borrowing_kernel
def _is_covered(pairs, enough, sees):
    """Return whether `enough` pairs have seeded of two sensors that should see a point.

    `sees` (s,) bool are these sensors.
    """
    n = 0
    for k in range(len(pairs.a)):
        n += not pairs.waiting[k] and sees[pairs.a[k]] and sees[pairs.b[k]]
        if n >= enough:
            return True
    return False
