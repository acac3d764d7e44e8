"""Arc search: the earlier objects that an object may be, hours after they were last seen.

Orbits of earlier objects are propagated from block to block of time. In each block the orbits that
begin there are compared with them, by a tree over position and velocity: linear in the number of
objects, where not all of them are near each other (`near_orbits`). Single tracklets are compared
with the direction and the rates that each orbit has at their time (`near_tracklets`).
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from epipole.schemas.arrays import Array, Indices
from epipole.tasks.algorithms.earth_gravity import advance
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.orbit_linking.arc_fit import MIN_COSINE, STEP_S, Tracklets

BLOCK_S = 600.0  # length of a block: the orbits that begin in it are propagated to its middle
# Largest distance of two orbits that are compared [km, km/s]. Estimated: an orbit from two
# tracklets a minute apart errs by less after an hour; neighbours in a plane are farther apart.
NEAR_KM, NEAR_KM_S = 300.0, 0.3
NEAR_SIGMA = 5.0  # of a tracklet's rates, beside `NEAR_KM_S`
MIN_ROOM = 4096  # for pairs at first; if there are more, the search is repeated with more
# Single tracklets that each end is compared with: bounds the time of a dense night.
MAX_SINGLE = 5000


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


def no_ends(count: int) -> ArcEnds:
    """Return ends that have no orbit yet."""
    return ArcEnds(
        np.full(count, -1), np.zeros(count), np.zeros(count), np.full((count, 6), np.nan)
    )


def sound_ends(ends: ArcEnds) -> ArcEnds:
    """Return the ends with an orbit."""
    kept = np.isfinite(ends.state).all(axis=1)
    return ArcEnds(ends.row[kept], ends.time_s[kept], ends.epoch_s[kept], ends.state[kept])


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


@kernel
def _near(y, tracklets, k):
    """Return whether an orbit y (6,) at a tracklet's time is near its line of sight and motion."""
    rho2, seen = 0.0, 0.0
    for m in range(3):
        d = y[m] - tracklets.r_km[k, m]
        rho2 += d * d
        seen += d * tracklets.u[k, m]
    rho = np.sqrt(rho2)
    if seen < MIN_COSINE * rho:
        return False
    across2, faster2 = 0.0, 0.0
    for c in range(2):
        axis = tracklets.east[k] if c == 0 else tracklets.north[k]
        off, faster = 0.0, 0.0
        for m in range(3):
            off += axis[m] * (y[m] - tracklets.r_km[k, m])
            faster += axis[m] * (y[3 + m] - tracklets.v_km_s[k, m] - rho * tracklets.w[k, m])
        across2 += off * off
        faster2 += faster * faster
    sigma2 = rho2 * (tracklets.cov[k, 2, 2] + tracklets.cov[k, 3, 3])
    return across2 < NEAR_KM**2 and faster2 < NEAR_KM_S**2 + NEAR_SIGMA**2 * sigma2


@kernel
def near_tracklets(ends, tracklets, free, way, min_gap_s, max_gap_s, out):
    """Find single tracklets that are near the orbit of an arc, before or after it.

    Parameters
    ----------
    ends : ArcEnds
        Last ends, or the first ones.
    free : (f,) int
        The single tracklets, in order of time.
    way : int
        1: tracklets after the ends; -1: before them.
    min_gap_s, max_gap_s : float
        Shortest and longest time between a tracklet and the end [s]; less than the longest where
        more than `MAX_SINGLE` tracklets are between.
    out : (m, 2) int, out
        The ends, and the rows of the tracklets.

    Returns
    -------
    int
        Number of pairs. It may be larger than m: then the rest is not written.
    """
    y, work, count = np.empty(6), np.empty((5, 42)), 0
    time_s = tracklets.time_s[free]
    for n in range(len(ends.row)):
        for m in range(6):
            y[m] = ends.state[n, m]
        now = ends.epoch_s[n]
        if way > 0:
            first = np.searchsorted(time_s, ends.time_s[n] + min_gap_s)
            room = len(free) - first
        else:
            room = np.searchsorted(time_s, ends.time_s[n] - min_gap_s, side="right")
            first = room - 1
        for step in range(min(room, MAX_SINGLE)):
            k = free[first + way * step]
            if way * (tracklets.time_s[k] - ends.time_s[n]) > max_gap_s:
                break
            advance(y, tracklets.time_s[k] - now, STEP_S, work)
            now = tracklets.time_s[k]
            if _near(y, tracklets, k):
                if count < len(out):
                    out[count, 0], out[count, 1] = n, k
                count += 1
    return count


def all_near_tracklets(
    ends: ArcEnds, tracklets: Tracklets, free: Indices, way: int, min_gap_s: float, max_gap_s: float
) -> Indices:
    """Return all pairs of `near_tracklets`."""
    room = MIN_ROOM
    while True:
        out = np.empty((room, 2), np.int64)
        room = near_tracklets(ends, tracklets, free, way, min_gap_s, max_gap_s, out)
        if room <= len(out):
            return out[:room]
