"""Field index: the sensors whose fields share space, by the cells that the fields sweep.

Space is divided into cells whose size grows with the distance from the Earth. Each field is a
cone; it is entered in all cells that it touches at any instant. Two fields can overlap only
where they share a cell, so the cost grows with the sensors per cell, not with all pairs.

The cells are cubes of one size in a map of space, the grid. Directions from the Earth's centre are
the same in both. A distance of r Earth radii is ln(r) + 1 in the grid; inside the Earth it is r.
Cones and balls have lengths in km. Times `_cells_per_km` they are lengths in the grid, over the
size of a cell; `_centre_of` leads back from a cell to space.

1. `cones_of` gives the cone about each field.
2. `field_index` enters the cones in cells, whose size it doubles until they fit.
3. `near_points` looks up the sensors that may see the points of a hypothesis, `sensors_sharing`
   those that share a cell with two sensors.
"""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Indices
from epipole.tasks.algorithms.association.odds import NEAR_SIGMA, near_fields, next_mark
from epipole.tasks.algorithms.association.search.sight_lines import BEYOND
from epipole.tasks.algorithms.association.views import HALF, PLANE, REACH, TURN, direction
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM
from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel

FEW_SENSORS = 32  # up to this number of sensors, a single cell holds all of them
MIN_CELL = 0.05  # smallest size of a cell at the Earth's surface, over the Earth's radius
MAX_CELLS = 400  # mean number per sensor: beyond it, the size of the cells is doubled
N_SAMPLED = 16  # sensors with which a first size of cells is found
PIECE_CELLS = 0.5  # length of a step along a cone, in sizes of the cells there
EDGE_RAD = 1e-3  # added to the half-angle of a cone [rad]
MAX_HALF_RAD = 1.5  # maximum half-angle of a cone [rad]: its tangent must be finite
AXIS, TANGENT = 3, 6  # columns of a cone where these begin, see `cones_of`
OFFSET = 1 << 20  # makes the coordinates of cells positive; they have 21 bits each in a key


class FieldIndex(NamedTuple):
    """The sensors, of s, whose field touches each of c cells.

    first, sensor : (c + 1,), (v,) int
        Sensors of cell q are ``sensor[first[q]:first[q + 1]]``, in increasing order.
    by_sensor_first, by_sensor_cell : (s + 1,), (v,) int
        Cells of sensor s, in increasing order, are
        ``by_sensor_cell[by_sensor_first[s]:by_sensor_first[s + 1]]``.
    size : float
        Size of the cells, see `MIN_CELL`; 0 for a single cell.
    keys, slots : (h,) int
        Hash table: ``slots[at]`` is the cell with the key ``keys[at]``, see `_slot` and `_key`. A
        key of 0 is free.
    """

    first: Indices
    sensor: Indices
    by_sensor_first: Indices
    by_sensor_cell: Indices
    size: float
    keys: Indices
    slots: Indices


def field_index(cones: Array, farthest_km: float) -> FieldIndex:
    """Return the index of the fields of all sensors that have tracklets, see `cones_of`."""
    n = len(cones)
    if n <= FEW_SENSORS:
        return FieldIndex(
            np.array([0, n]), np.arange(n), np.arange(n + 1), np.zeros(n, np.int64), 0.0,
            np.zeros(1, np.int64), np.zeros(1, np.int64),
        )  # fmt: skip
    size = MIN_CELL
    # A few sensors show quickly which sizes are too small.
    for some in (cones[:: -(-n // N_SAMPLED)], cones):
        while True:
            capacity = MAX_CELLS * len(some)
            by_sensor_first, by_sensor_cell, n_cells, keys, slots = _enter(
                some, farthest_km, size, capacity
            )
            if n_cells >= 0:
                break
            size *= 2
    sensor = np.repeat(np.arange(n), np.diff(by_sensor_first))
    order = np.argsort(by_sensor_cell, kind="stable")
    first = np.searchsorted(by_sensor_cell[order], np.arange(n_cells + 1))
    return FieldIndex(first, sensor[order], by_sensor_first, by_sensor_cell, size, keys, slots)


@borrowing_kernel
def _slot(keys, key):
    """Return the slot of a key in the hash table, or the free one for it (keys are positive)."""
    mask = len(keys) - 1  # the length is a power of two
    at = (key * 0x9E3779B97F4A7C1 >> 20) & mask
    while keys[at] != 0 and keys[at] != key:
        at = (at + 1) & mask
    return at


@borrowing_kernel
def _cells_per_km(radius_km, size):
    """Return the number of cells per kilometre at a distance from the Earth's centre.

    At r Earth radii, a length across the radius is (1 + ln(r)) / r times as long in the grid; one
    along it 1 / r times, which is less. The larger factor is returned. A position times this factor
    is its position in the grid, in cells.
    """
    r = radius_km / EARTH_RADIUS_KM
    return ((1.0 + np.log(r)) / r if r > 1.0 else 1.0) / (EARTH_RADIUS_KM * size)


@borrowing_kernel
def _centre_of(i, j, k, size):
    """Return the centre [km, GCRF] of the cell (i, j, k) of this size, and its distance from the
    Earth's centre, in Earth radii."""
    y0, y1, y2 = (i + 0.5) * size, (j + 0.5) * size, (k + 0.5) * size
    in_grid = max(np.sqrt(y0 * y0 + y1 * y1 + y2 * y2), 1e-9)
    r = np.exp(in_grid - 1.0) if in_grid > 1.0 else in_grid
    scale = EARTH_RADIUS_KM * r / in_grid
    return y0 * scale, y1 * scale, y2 * scale, r


@borrowing_kernel
def _half_diagonal_km(r, size):
    """Return half the diagonal [km] of a cell whose centre is r Earth radii from the Earth's."""
    in_grid = 0.5 * np.sqrt(3.0) * size
    # A cell is larger on its far side, by the exponential.
    return in_grid * EARTH_RADIUS_KM * max(r, 1.0) * np.exp(in_grid)


@borrowing_kernel
def _key(i, j, k):
    """Return the key of the cell (i, j, k), positive; see `OFFSET`."""
    return ((i + OFFSET) << 42) | ((j + OFFSET) << 21) | (k + OFFSET)


class Entering(NamedTuple):
    """Work arrays with which fields are entered in cells of one size.

    size : float
        As in `FieldIndex`.
    keys, slots : (h,) int
        As in `FieldIndex`.
    latest : (c,) int
        The last sensor entered in each cell.
    by_sensor_cell : (v,) int
        Cells of the sensors, one after the other.
    filled : (2,) int
        Numbers of entries and of cells.
    low, high : (3,) int
        Lowest and highest coordinates of the cells about a ball.
    """

    size: float
    keys: Indices
    slots: Indices
    latest: Indices
    by_sensor_cell: Indices
    filled: Indices
    low: Indices
    high: Indices


@borrowing_kernel
def ground_range(position, axis, half):
    """Return the longest range [km] in a cone to the ground; inf if some of it passes the Earth.

    `position` (3,) [km] and the unit vector `axis` (3,) are in the GCRF; `half` is the cone's
    half-angle [rad].
    """
    radius2, down = 0.0, 0.0
    for a in range(3):
        radius2 += position[a] * position[a]
        down -= position[a] * axis[a]
    radius = np.sqrt(radius2)
    if not radius > EARTH_RADIUS_KM:
        return np.inf
    off = np.arccos(min(max(down / radius, -1.0), 1.0)) + half
    if off >= np.arcsin(EARTH_RADIUS_KM / radius):
        return np.inf
    across = radius * np.sin(off)
    return radius * np.cos(off) - np.sqrt(EARTH_RADIUS_KM * EARTH_RADIUS_KM - across * across)


@kernel
def cones_of(views):
    """Return the cone about each field and its tracklets, (s, k, 7), at k instants.

    The sensor's position [km, GCRF], the cone's axis, and the tangent of its half-angle: 0 without
    tracklets. The axis is the boresight, or the normal of the sensor's plane where the boresight is
    unknown or gives a wider cone.
    """
    n_sensors, n_instants, cam = views.camera.shape[0], len(views.time_s), views.camera
    cones, u = np.zeros((n_sensors, n_instants, 7)), np.empty(3)
    for s in range(n_sensors):
        for m in range(n_instants):
            if not cam[s, m, REACH] > 0.0:
                continue
            cones[s, m, :AXIS] = cam[s, m, :AXIS]
            cones[s, m, AXIS:TANGENT] = cam[s, m, PLANE + 6 : PLANE + 9]
            cones[s, m, TANGENT] = cam[s, m, REACH]
            if not np.isfinite(cam[s, m, TURN + 6]):
                continue
            min_cosine = 1.0 / np.sqrt(1.0 + cam[s, m, HALF] ** 2 + cam[s, m, HALF + 1] ** 2)
            for i in range(views.first[s], views.first[s + 1]):
                if views.seen[i, m]:
                    direction(views, i, m, u)
                    along = 0.0
                    for a in range(3):
                        along += u[a] * cam[s, m, TURN + 6 + a]
                    min_cosine = min(min_cosine, along)
            tangent = np.tan(min(np.arccos(max(min_cosine, -1.0)) + EDGE_RAD, MAX_HALF_RAD))
            if tangent < cam[s, m, REACH]:
                cones[s, m, AXIS:TANGENT] = cam[s, m, TURN + 6 : HALF]
                cones[s, m, TANGENT] = tangent
    return cones


@kernel
def _enter(cones, farthest_km, size, capacity):
    """Enter all fields in cells of a size; return the cells of the sensors and the hash table.

    Of `cones` (s, k, 7), see `cones_of`, as far as `farthest_km` from the Earth's centre. Returns
    `by_sensor_first` (s + 1,) and `by_sensor_cell` (v,), the number of cells, and `keys` and
    `slots` (h,), as in `FieldIndex`. The number of cells is -1 if there are more than `capacity`
    entries: a sensor in a cell is one.
    """
    n_sensors, n_instants = cones.shape[0], cones.shape[1]
    table = 1
    while table < 2 * capacity:
        table *= 2
    by_sensor_first = np.zeros(n_sensors + 1, np.int64)
    entering = Entering(
        size,
        np.zeros(table, np.int64),
        np.zeros(table, np.int64),
        np.full(capacity, -1),
        np.empty(capacity, np.int64),
        np.zeros(2, np.int64),
        np.empty(3, np.int64),
        np.empty(3, np.int64),
    )
    by_sensor_cell, count = entering.by_sensor_cell, entering.filled
    for s in range(n_sensors):
        m = 0
        while m < n_instants:
            if not cones[s, m, TANGENT] > 0.0:
                m += 1
                continue
            last, shift, turn, reach = _together(cones, s, m, size)
            sweep = (s, m, shift, turn, reach)
            if not _walk(cones, sweep, farthest_km, entering):
                return by_sensor_first, by_sensor_cell[:0], -1, entering.keys, entering.slots
            m = last + 1
        by_sensor_first[s + 1] = count[0]
        by_sensor_cell[by_sensor_first[s] : count[0]].sort()
    return (
        by_sensor_first,
        by_sensor_cell[: count[0]].copy(),
        count[1],
        entering.keys,
        entering.slots,
    )


@borrowing_kernel
def _together(cones, s, m, size):
    """Return the last instant until which a field moves by less than a cell, and its motion.

    From instant m on, for sensor s of `cones` (s, k, 7). The motion is the maximum shift of the
    position [km] and turn of the axis [rad], and the maximum tangent of the cone's half-angle.
    """
    last, shift, turn, reach = m, 0.0, 0.0, cones[s, m, TANGENT]
    for h in range(m + 1, cones.shape[1]):
        if not cones[s, h, TANGENT] > 0.0:
            break
        moved2, turned2 = 0.0, 0.0
        for a in range(3):
            moved2 += (cones[s, h, a] - cones[s, m, a]) ** 2
            turned2 += (cones[s, h, AXIS + a] - cones[s, m, AXIS + a]) ** 2
        if not (np.sqrt(moved2) <= size * EARTH_RADIUS_KM and np.sqrt(turned2) <= size / 2):
            break
        last, shift = h, max(shift, np.sqrt(moved2))
        turn, reach = max(turn, np.sqrt(turned2)), max(reach, cones[s, h, TANGENT])
    return last, shift, turn, reach


@borrowing_kernel
def _walk(cones, sweep, farthest_km, entering):
    """Enter one cone, step by step along its axis; return false if the arrays are full.

    `cones` (s, k, 7); `sweep` is the sensor, the instant, and the motion until the last instant for
    which this cone stands, as in `_together`: shift [km], turn [rad], tangent. A ball encloses each
    step. The walk ends beyond the farthest distance, or at the Earth.
    """
    s, m, shift, turn, reach = sweep
    half = np.arctan(reach) + turn
    ends = ground_range(cones[s, m, :AXIS], cones[s, m, AXIS:TANGENT], half)
    ends = min(ends, (2.0 + BEYOND) * farthest_km)
    at = 0.0
    while True:
        x0, x1, x2 = _along(cones, s, m, at)
        per_km = _cells_per_km(np.sqrt(x0 * x0 + x1 * x1 + x2 * x2), entering.size)
        length = max(PIECE_CELLS / per_km, PIECE_CELLS * at * min(reach, 1.0))
        middle = at + length / 2
        x0, x1, x2 = _along(cones, s, m, middle)
        ball = np.hypot((at + length) * reach, length / 2) + shift + middle * turn
        distance = np.sqrt(x0 * x0 + x1 * x1 + x2 * x2)
        if distance + ball < EARTH_RADIUS_KM:
            return True
        if at > ends or distance - ball > (1.0 + BEYOND) * farthest_km:
            return True
        if not _enter_ball(cones, sweep, (x0, x1, x2), ball, entering):
            return False
        at += length


@borrowing_kernel
def _along(cones, s, m, at):
    """Return the point [km, GCRF] of a cone's axis that is `at` [km] from its sensor.

    The cone is that of sensor s at instant m, of `cones` (s, k, 7).
    """
    return (
        cones[s, m, 0] + at * cones[s, m, AXIS],
        cones[s, m, 1] + at * cones[s, m, AXIS + 1],
        cones[s, m, 2] + at * cones[s, m, AXIS + 2],
    )


@borrowing_kernel
def _enter_ball(cones, sweep, x, ball, entering):
    """Enter a sensor in the cells that a ball and its cone touch; false if the arrays are full.

    The ball has the centre `x` (3,) [km], GCRF, and the radius `ball` [km]. `cones` and `sweep` as
    in `_walk`.
    """
    size, low, high = entering.size, entering.low, entering.high
    distance = np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
    # In cells. The scale of the grid is largest where the ball is nearest to the Earth.
    per_km, radius = _cells_per_km(distance, size), ball * _cells_per_km(distance - ball, size)
    c0, c1, c2 = x[0] * per_km, x[1] * per_km, x[2] * per_km
    low[0], high[0] = int(np.floor(c0 - radius)), int(np.floor(c0 + radius))
    low[1], high[1] = int(np.floor(c1 - radius)), int(np.floor(c1 + radius))
    low[2], high[2] = int(np.floor(c2 - radius)), int(np.floor(c2 + radius))
    earth2 = 1.0 / (size * size)  # squared radius of the Earth, in cells
    for i in range(low[0], high[0] + 1):
        d0 = max(i - c0, c0 - i - 1.0, 0.0)  # from the ball's centre to the cell, along an axis
        far0 = max(-i, i + 1)  # from the Earth's centre to the cell's far side
        for j in range(low[1], high[1] + 1):
            d1, far1 = max(j - c1, c1 - j - 1.0, 0.0), max(-j, j + 1)
            for k in range(low[2], high[2] + 1):
                d2, far2 = max(k - c2, c2 - k - 1.0, 0.0), max(-k, k + 1)
                if d0 * d0 + d1 * d1 + d2 * d2 > radius * radius:
                    continue
                if far0 * far0 + far1 * far1 + far2 * far2 < earth2:
                    continue  # all of the cell is inside the Earth
                if not _enter_cell(cones, sweep, i, j, k, entering):
                    return False
    return True


@borrowing_kernel
def _enter_cell(cones, sweep, i, j, k, entering):
    """Enter a sensor in the cell (i, j, k) if its cone touches it; false if the arrays are full.

    A sensor is entered once in a cell. `cones` and `sweep` as in `_walk`.
    """
    keys, slots, latest, count = entering.keys, entering.slots, entering.latest, entering.filled
    key = _key(i, j, k)
    at = _slot(keys, key)
    if keys[at] != 0 and latest[slots[at]] == sweep[0]:
        return True
    if not _touches(cones, sweep, entering.size, i, j, k):
        return True
    if keys[at] == 0:
        if count[1] >= len(latest):
            return False
        keys[at], slots[at] = key, count[1]
        count[1] += 1
    if count[0] >= len(entering.by_sensor_cell):
        return False
    latest[slots[at]] = sweep[0]
    entering.by_sensor_cell[count[0]] = slots[at]
    count[0] += 1
    return True


@borrowing_kernel
def _touches(cones, sweep, size, i, j, k):
    """Return whether the centre of a cell is within half its diagonal of a cone that moves.

    The cell is (i, j, k) of those with this size; `cones` and `sweep` as in `_walk`.
    """
    s, m, shift, turn, reach = sweep
    x0, x1, x2, r = _centre_of(i, j, k, size)
    d0, d1, d2 = x0 - cones[s, m, 0], x1 - cones[s, m, 1], x2 - cones[s, m, 2]
    along = d0 * cones[s, m, AXIS] + d1 * cones[s, m, AXIS + 1] + d2 * cones[s, m, AXIS + 2]
    length2 = d0 * d0 + d1 * d1 + d2 * d2
    # The cone stands for those until the last instant: they may be this much nearer to the cell.
    near_km = _half_diagonal_km(r, size) + (shift + turn * np.sqrt(length2))
    if length2 <= near_km * near_km:
        return True
    across = np.sqrt(max(length2 - along * along, 0.0))
    return across - along * reach <= near_km * np.sqrt(1.0 + reach * reach)


@borrowing_kernel
def cell_at(index, x):
    """Return the cell that holds the point x (3,) [km, GCRF]; -1 if no field touches that cell."""
    if index.size == 0.0:
        return np.int64(0)
    per_km = _cells_per_km(np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2]), index.size)
    i, j, k = np.floor(x[0] * per_km), np.floor(x[1] * per_km), np.floor(x[2] * per_km)
    return _cell(index, int(i), int(j), int(k))


@borrowing_kernel
def _cell(index, i, j, k):
    """Return the row of the cell (i, j, k), -1 if no field touches it."""
    key = _key(i, j, k)
    at = _slot(index.keys, key)
    return index.slots[at] if index.keys[at] == key else np.int64(-1)


@borrowing_kernel
def cells_across(index, x, radius_km):
    """Return the radius of a ball about x (3,) [km, GCRF] over the size of the cells there."""
    if index.size == 0.0:
        return 0.0
    distance = np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
    return radius_km * _cells_per_km(distance - radius_km, index.size)


@borrowing_kernel
def sensors_about(index, x, radius_km, stamp, mark, out, n):
    """Append to `out` the sensors whose fields may touch a ball; return the new length of `out`.

    `x` (3,) is the centre [km, GCRF]; `out` (s,) has n sensors so far. Sensors with
    ``stamp[s] == mark`` are in `out` already; `stamp` (s + 1,) is changed. The ball should not be
    much larger than a cell: all cells that it touches are visited.
    """
    if index.size == 0.0:
        return _add_cell(index, 0, stamp, mark, out, n)
    per_km = _cells_per_km(np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2]), index.size)
    radius = cells_across(index, x, radius_km)
    c0, c1, c2 = x[0] * per_km, x[1] * per_km, x[2] * per_km
    for i in range(int(np.floor(c0 - radius)), int(np.floor(c0 + radius)) + 1):
        for j in range(int(np.floor(c1 - radius)), int(np.floor(c1 + radius)) + 1):
            for k in range(int(np.floor(c2 - radius)), int(np.floor(c2 + radius)) + 1):
                q = _cell(index, i, j, k)
                if q >= 0:
                    n = _add_cell(index, q, stamp, mark, out, n)
    return n


@borrowing_kernel
def _add_cell(index, q, stamp, mark, out, n):
    """Append the sensors of cell q to `out` (s,), as in `sensors_about`; return the new length."""
    for k in range(index.first[q], index.first[q + 1]):
        s = index.sensor[k]
        if stamp[s] != mark:
            stamp[s] = mark
            out[n] = s
            n += 1
    return n


@borrowing_kernel
def sensors_sharing(index, a, b, stamp, mark, out):
    """Write the sensors that share a cell with both a and b; return their number.

    These are the first ones of `out` (s,); `stamp` (s + 1,) and `mark` as in `sensors_about`.
    """
    i, j, n = index.by_sensor_first[a], index.by_sensor_first[b], 0
    while i < index.by_sensor_first[a + 1] and j < index.by_sensor_first[b + 1]:
        p, q = index.by_sensor_cell[i], index.by_sensor_cell[j]
        if p == q:
            n = _add_cell(index, p, stamp, mark, out, n)
        i += p <= q
        j += q <= p
    return n


@borrowing_kernel
def near_points(space, work, a, b):
    """Write to `work.near` the sensors whose field may hold the points; return their number.

    Candidates come from the cells about the points of `work`. If a point is uncertain by more than
    a cell, they come from the cells that sensors a and b share. Writes `work.nearby` too.
    """
    index, points, n = space.fields, work.points, np.int64(0)
    mark, known = next_mark(work.stamp), True
    for m in range(len(points.seen_by)):
        if points.seen_by[m] >= 2:
            P = points.cov_km2[m]
            error_km = NEAR_SIGMA * np.sqrt(P[0, 0] + P[1, 1] + P[2, 2])
            known &= cells_across(index, points.x_km[m], error_km) <= 1.0  # false for NaN
    if known:
        for m in range(len(points.seen_by)):
            if points.seen_by[m] >= 2:
                x, P = points.x_km[m], points.cov_km2[m]
                error_km = NEAR_SIGMA * np.sqrt(P[0, 0] + P[1, 1] + P[2, 2])
                n = sensors_about(index, x, error_km, work.stamp, mark, work.nearby, n)
    else:
        n = np.int64(sensors_sharing(index, a, b, work.stamp, mark, work.nearby))
    return near_fields(space.views, points, work.nearby[:n], work.near)
