"""Platforms: sensors that are on one satellite, and so share the error of its position.

The fits take the errors of two sensors as independent. Of n sensors on one satellite the error of
the position would then average out. With n times its variance in each of them, it counts once.
"""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from epipole.schemas.arrays import Array, Indices
from epipole.tasks.algorithms.earth_gravity import gravity, propagate_states

MAX_GAP_S = 900.0  # between positions of two sensors that are compared: the motion is known so long
BASE_S = 60.0  # longest time between the positions of a sensor from which its velocity follows
STEP_S = 60.0  # longest step of the propagation: right to a metre in these minutes
# Two sensors are on one satellite if the path of one leads within this distance of the other. The
# second is for the gap between: velocities from positions that err by 50 m are off by metres a
# second. Neighbours of a constellation are tens of kilometres apart.
APART_KM, APART_KM_S = 1.0, 5e-3
MAX_SPEED_KM_S = 12.0  # above the escape speed: what is farther need not be propagated


def platform_sizes(time_s: Array, sensor: Indices, r_km: Array) -> Indices:
    """Return how many of s sensors are on the satellite of each, itself included: (s,).

    Parameters
    ----------
    time_s : (n,) float
        Times [s], increasing.
    sensor : (n,) int
        Sensor of each position, 0 .. s - 1 without gaps.
    r_km : (n, 3) float
        Positions of the sensors [km], in axes that do not turn; z along the Earth's pole.

    Notes
    -----
    A sensor with a single position counts as alone on its satellite, unless the path of another
    sensor leads to it.
    """
    n_sensors = int(sensor.max(initial=-1)) + 1
    by_sensor = np.argsort(sensor, kind="stable")
    bounds = np.searchsorted(sensor[by_sensor], np.arange(n_sensors + 1))
    # Where two sensors see the object at the same time, one of them begins or ends within the time
    # of the other; else an end of one is nearest to the other.
    ends = by_sensor[np.stack([bounds[:-1], bounds[1:] - 1])]
    pairs = [np.zeros((2, 0), np.int64)]
    for s in range(n_sensors):
        mine = by_sensor[bounds[s] : bounds[s + 1]]
        others = _on_its_path(time_s, r_km, mine, np.delete(ends, s, axis=1))
        others += others >= s  # the sensor itself was left out
        pairs.append(np.stack([np.full(len(others), s), others]))
    one, other = np.concatenate(pairs, axis=1)
    links = coo_array((np.ones(len(one)), (one, other)), (n_sensors, n_sensors))
    _, satellite = connected_components(links, directed=False)
    return np.asarray(np.bincount(satellite)[satellite], np.int64)


def _on_its_path(time_s: Array, r_km: Array, mine: Indices, ends: Indices) -> Indices:
    """Return the sensors that the path of another one leads to.

    Parameters
    ----------
    mine : (k,) int
        Rows of that one, in order of time.
    ends : (2, m) int
        First and last row of each of the sensors.
    """
    if len(mine) < 2 or not ends.size:
        return np.zeros(0, np.int64)
    others = ends.ravel()
    after = np.clip(np.searchsorted(time_s[mine], time_s[others]), 1, len(mine) - 1)
    late = time_s[mine[after]] - time_s[others] < time_s[others] - time_s[mine[after - 1]]
    near = mine[np.where(late, after, after - 1)]
    gap_s = time_s[others] - time_s[near]
    # Of each sensor the end that is nearer in time, if the satellite can have come from there.
    nearer = np.argmin(np.abs(gap_s).reshape(ends.shape), axis=0)
    which = nearer * ends.shape[1] + np.arange(ends.shape[1])
    far_km = np.linalg.norm(r_km[near[which]] - r_km[others[which]], axis=1)
    gap = np.abs(gap_s[which])
    may_be = (gap <= MAX_GAP_S) & (far_km < APART_KM + MAX_SPEED_KM_S * gap)
    if not may_be.any():
        return np.zeros(0, np.int64)
    others, near, gap_s = (rows[which[may_be]] for rows in (others, near, gap_s))
    v_km_s = _velocities(time_s[mine], r_km[mine], np.searchsorted(mine, near))
    steps = int(np.ceil(np.abs(gap_s).max() / STEP_S)) + 1
    there, _ = propagate_states(r_km[near], v_km_s, gap_s, steps)
    apart_km = np.linalg.norm(there - r_km[others], axis=1)
    on_path = apart_km < APART_KM + APART_KM_S * np.abs(gap_s)
    return np.asarray(np.flatnonzero(may_be)[on_path], np.int64)


def _velocities(time_s: Array, r_km: Array, rows: Indices) -> Array:
    """Return the velocities (m, 3) [km/s] at some of a sensor's positions; NaN where none is near.

    Each follows from the position that is farthest in time, but within `BASE_S`.
    """
    at = time_s[rows]
    first = np.searchsorted(time_s, at - BASE_S)
    last = np.searchsorted(time_s, at + BASE_S, side="right") - 1
    other = np.where(at - time_s[first] > time_s[last] - at, first, last)
    step_s = np.where(other == rows, np.nan, time_s[other] - at)[:, None]
    step_s[step_s == 0.0] = np.nan
    r, r_other = r_km[rows], r_km[other]
    fall = (2.0 * gravity(r) + gravity(r_other)) / 6.0
    return (r_other - r) / step_s - fall * step_s
