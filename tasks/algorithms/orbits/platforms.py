"""Platforms: sensors on one satellite that have the same states, and so share their error.

The fits take the errors of two sensors as independent. Of n sensors that have the same states the
error of the position would then average out. With n times its variance in each of them, it counts
once. Sensors on one satellite may as well have states of their orbit that err independently: these
differ by more than they would with a common error.
"""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from epipole.schemas.arrays import Array, Indices
from epipole.tasks.algorithms.earth_gravity import gravity, propagate_states

MAX_GAP_S = 900.0  # between positions of two sensors that are compared
BASE_S = 60.0  # longest time between the positions of a sensor from which its velocity follows
STEP_S = 60.0  # longest step of the propagation: right to a metre in these minutes
# Largest squared distance of the path of one from the other, over the variance that independent
# errors have: these stay below it in one of 30 pairs (chi-square of three degrees of freedom), and
# in fewer where velocities from positions carry them farther apart.
SAME_STATES = 0.26
MAX_SPEED_KM_S = 12.0  # above the escape speed: what is farther need not be propagated


def platform_sizes(time_s: Array, sensor: Indices, r_km: Array, sigma_km: Array) -> Indices:
    """Return how many of s sensors have the states of each, itself included: (s,).

    Parameters
    ----------
    time_s : (n,) float
        Times [s], increasing.
    sensor : (n,) int
        Sensor of each position, 0 .. s - 1 without gaps.
    r_km : (n, 3) float
        Positions of the sensors [km], in axes that do not turn; z along the Earth's pole.
    sigma_km : (s,) float
        1-sigma error of each sensor's positions, per axis.

    Notes
    -----
    A sensor with a single position counts as alone, unless the path of another sensor leads to it;
    so do sensors whose positions are more than `MAX_GAP_S` apart.
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
        near_km = np.sqrt(SAME_STATES * (sigma_km[s] ** 2 + np.delete(sigma_km, s) ** 2))
        others = _on_its_path(time_s, r_km, mine, np.delete(ends, s, axis=1), near_km)
        others += others >= s  # the sensor itself was left out
        pairs.append(np.stack([np.full(len(others), s), others]))
    one, other = np.concatenate(pairs, axis=1)
    links = coo_array((np.ones(len(one)), (one, other)), (n_sensors, n_sensors))
    _, satellite = connected_components(links, directed=False)
    return np.asarray(np.bincount(satellite)[satellite], np.int64)


def views_from_one_position(offsets: Indices, r_km: Array, sigma_km: Array) -> Indices:
    """Return how many views of its group are from the position of each, itself included: (n,).

    Parameters
    ----------
    offsets : (g + 1,) int
        Group k has the views ``offsets[k]:offsets[k + 1]``, all of one instant.
    r_km : (n, 3) float
        Reported positions of the sensors [km], in any one frame.
    sigma_km : (n,) float
        Their 1-sigma errors, per axis.

    Notes
    -----
    Two sensors are on one satellite if they are nearer to each other than independent errors would
    let them be, see `SAME_STATES`.
    """
    size = np.diff(offsets)
    group = np.repeat(np.arange(len(size)), size)
    count = np.ones(len(group), np.int64)
    for step in range(1, int(size.max(initial=0))):
        one = np.flatnonzero(group[step:] == group[:-step])
        other = one + step
        apart2 = np.sum((r_km[one] - r_km[other]) ** 2, axis=1)
        same = apart2 < SAME_STATES * (sigma_km[one] ** 2 + sigma_km[other] ** 2)
        count[one[same]] += 1
        count[other[same]] += 1
    return count


def _on_its_path(
    time_s: Array, r_km: Array, mine: Indices, ends: Indices, near_km: Array
) -> Indices:
    """Return the sensors that the path of another one leads to.

    Parameters
    ----------
    mine : (k,) int
        Rows of that one, in order of time.
    ends : (2, m) int
        First and last row of each of the sensors.
    near_km : (m,) float
        How near the path leads to each of those that are returned [km].
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
    may_be = (gap <= MAX_GAP_S) & (far_km < near_km + MAX_SPEED_KM_S * gap)
    if not may_be.any():
        return np.zeros(0, np.int64)
    others, near, gap_s = (rows[which[may_be]] for rows in (others, near, gap_s))
    v_km_s = _velocities(time_s[mine], r_km[mine], np.searchsorted(mine, near))
    steps = int(np.ceil(np.abs(gap_s).max() / STEP_S)) + 1
    there, _ = propagate_states(r_km[near], v_km_s, gap_s, steps)
    apart_km = np.linalg.norm(there - r_km[others], axis=1)
    return np.asarray(np.flatnonzero(may_be)[apart_km <= near_km[may_be]], np.int64)


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
