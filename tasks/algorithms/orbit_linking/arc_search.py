"""Arc search: the earlier objects that an object may be, hours after they were last seen.

Orbits of earlier objects are propagated from block to block of time. In each block the orbits that
begin there are compared with them, by a tree over position and velocity: linear in the number of
objects, where not all of them are near each other.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from epipole.tasks.algorithms.earth_gravity import advance
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.orbit_linking.arc_fit import STEP_S

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

BLOCK_S = 600.0  # length of a block: the orbits that begin in it are propagated to its middle
# Farther apart [km, km/s] two orbits are not compared. Estimated: the orbit of two tracklets a
# minute apart is off by a part of this an hour later, and neighbours in a plane are farther apart.
NEAR_KM, NEAR_KM_S = 300.0, 0.3


class ArcEnds(NamedTuple):
    """One end of each of n arcs.

    row : (n,) int
        The first or last tracklet.
    time_s, epoch_s : (n,) float
        Its time, and the epoch of the orbit [s].
    state : (n, 6) float
        The orbit near that end [km, km/s], GCRF.
    """

    row: Indices
    time_s: Array
    epoch_s: Array
    state: Array


@kernel
def move(states, dt_s):
    """Propagate states (n, 6) by dt_s (n,), in place: two bodies and J2."""
    work = np.empty((5, 6))
    for k in range(len(states)):
        advance(states[k], dt_s[k], STEP_S, work)


def near_orbits(tails: ArcEnds, heads: ArcEnds, max_gap_s: float) -> Indices:
    """Return pairs (p, 2) of an earlier tail and a later head whose orbits are near each other.

    Parameters
    ----------
    tails, heads
        Ends of any number of arcs.
    max_gap_s
        Longest time between the last tracklet of one and the first of the other [s].
    """
    scale = np.array([NEAR_KM] * 3 + [NEAR_KM_S] * 3)
    of_head = np.floor(heads.time_s / BLOCK_S).astype(np.int64)
    ends, at_s = tails.state.copy(), tails.epoch_s.copy()
    pairs = [np.zeros((0, 2), np.int64)]
    for block in np.unique(of_head).tolist():
        middle_s = (block + 0.5) * BLOCK_S
        later = np.flatnonzero(of_head == block)
        begun = heads.state[later].copy()
        move(begun, middle_s - heads.epoch_s[later])
        earlier = np.flatnonzero(
            (tails.time_s < (block + 1) * BLOCK_S) & (tails.time_s > block * BLOCK_S - max_gap_s)
        )
        if not len(earlier):
            continue
        moved = ends[earlier]
        move(moved, middle_s - at_s[earlier])
        ends[earlier], at_s[earlier] = moved, middle_s
        near = cKDTree(begun / scale).query_ball_point(moved / scale, 1.0)
        found = np.array([(i, j) for i, js in zip(earlier, near, strict=True) for j in later[js]])
        pairs.append(found.reshape(-1, 2).astype(np.int64))
    earlier, later = np.concatenate(pairs).T
    gap = heads.time_s[later] - tails.time_s[earlier]
    kept = (gap > 0.0) & (gap <= max_gap_s)
    return np.stack([earlier[kept], later[kept]], axis=1)
