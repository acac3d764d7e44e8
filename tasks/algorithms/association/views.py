"""Views: the samples sorted by sensor and projected onto planes, for the compiled search.

Each sensor has, at each instant, a plane tangent to the sky in the middle of its directions. On
it a tracklet is two coordinates and their covariance, a point is projected by nine
multiplications, and a grid of cells holds the tracklets that are near.
"""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.tasks.algorithms.association.samples import Samples
from epipole.tasks.algorithms.constants import SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel

# Columns of `Views.sight` and `Views.camera`. For a tracklet or a sensor at an instant the search
# reads a single row. Few arrays also compile fast.
X, Y, XX, XY, YY, SIGMA_KM, DX, DY, HAS_RATE = range(9)
R_KM, PLANE, TURN, HALF, CORNER, SCALE, MAX_VARIANCE, REACH = 0, 3, 12, 21, 23, 25, 27, 28
V_KM_S, MAX_RATE, MAX_SIGMA_KM = 29, 32, 33
N_SIGHT, N_CAMERA = 9, 34


class Views(NamedTuple):
    """`Samples` by sensor: t tracklets, k instants, s sensors.

    first : (s + 1,) int
        Tracklets of sensor s are ``first[s]:first[s + 1]``.
    sensor, start_s, end_s, seen, time_s
        As in `Samples`.
    sight : (t, k, 9) float
        Gnomonic coordinates in the sensor's plane (X, Y), their variances and covariance (XX, XY,
        YY), the 1-sigma error of the sensor's position [km], the rates of the coordinates [1/s]
        (DX, DY), and 1 where these are known, else 0 (HAS_RATE).
    camera : (s, k, 34) float
        The sensor's position [km]; the plane's two axes and its normal; the sensor's axes (NaN
        where unknown); tangents of half its field; the grid's lowest coordinates and its cells
        per unit; the largest variance of a tracklet on the plane; the tangent of the cone about
        the normal that holds field and tracklets (0 without tracklets); the sensor's velocity
        [km/s]; among its tracklets the highest rate of a coordinate [1/s], and the largest error of
        the position [km].
    grid : (s, k, 2) int
        First cell of a sensor and instant in `cell_start`, and the number of cells per side.
    cell_start, cell_item : (c,), (v,) int
        Tracklets of a cell are ``cell_item[cell_start[q]:cell_start[q + 1]]``.
    bounded : (s,) bool
        No tracklet of the sensor is seen before its start or after its end.
    magnitude : (t,) float
        Mean apparent magnitudes; NaN where unknown.
    blend_rad : (s,) float
        Angle between two objects below which a sensor sees them as one.
    """

    first: Indices
    sensor: Indices
    start_s: Array
    end_s: Array
    seen: Flags
    sight: Array
    time_s: Array
    camera: Array
    grid: Indices
    cell_start: Indices
    cell_item: Indices
    bounded: Flags
    magnitude: Array
    blend_rad: Array

    @property
    def position_km(self) -> Array:
        """Positions of the sensors [km], (s, k, 3)."""
        return self.camera[..., R_KM:PLANE]

    @property
    def plane(self) -> Array:
        """Two axes and the normal of the planes, (s, k, 3, 3)."""
        return self.camera[..., PLANE:TURN].reshape(*self.camera.shape[:2], 3, 3)

    @property
    def attitude(self) -> Array:
        """Attitudes of the sensors, sensor from ICRS, (s, k, 3, 3); NaN where unknown."""
        return self.camera[..., TURN:HALF].reshape(*self.camera.shape[:2], 3, 3)

    @property
    def half_field(self) -> Array:
        """Tangents of half the fields, (s, 2)."""
        return self.camera[:, 0, HALF:CORNER]


def views_of(samples: Samples) -> tuple[Views, Indices]:
    """Return the samples sorted by sensor, ready for the search, and the sorting order."""
    n_sensors, n_instants = samples.sensor_km.shape[:2]
    order = np.argsort(samples.sensor, kind="stable")
    sensor = np.ascontiguousarray(samples.sensor[order], np.int64)
    first = np.searchsorted(sensor, np.arange(n_sensors + 1)).astype(np.int64)
    seen, u = np.ascontiguousarray(samples.seen), np.ascontiguousarray(samples.u, float)
    plane = _planes(first, order, seen, u)
    _sort_by_position(first, order, seen, u, plane)
    camera = np.zeros((n_sensors, n_instants, N_CAMERA))
    camera[..., R_KM:PLANE] = samples.sensor_km
    camera[..., PLANE:TURN] = plane.reshape(n_sensors, n_instants, 9)
    camera[..., TURN:HALF] = samples.R_sensor_from_icrs.reshape(n_sensors, n_instants, 9)
    camera[..., HALF:CORNER] = samples.half_field[:, None]
    rate = np.zeros((0, n_instants, 3))
    if samples.rate is not None and samples.sensor_km_s is not None:
        rate = np.ascontiguousarray(samples.rate, float)
        camera[..., V_KM_S:MAX_RATE] = np.nan_to_num(samples.sensor_km_s)
    sight = np.empty((len(order), n_instants, N_SIGHT))
    sight[..., SIGMA_KM] = samples.sigma_km[order]
    cov = np.ascontiguousarray(samples.cov, float)
    _flatten(sensor, order, seen, u, cov, rate, camera, sight)
    seen = seen[order]
    n_seen = int(np.count_nonzero(seen))
    grid = np.zeros((n_sensors, n_instants, 2), np.int64)
    cell_start = np.zeros(n_seen + n_sensors * n_instants + 1, np.int64)
    cell_item = np.zeros(n_seen, np.int64)
    _fill_grids(first, seen, sight, camera, grid, cell_start, cell_item)
    camera[..., REACH] = _reach(camera, grid)
    magnitude = np.full(len(order), np.nan) if samples.magnitude is None else samples.magnitude
    blend_rad = np.zeros(n_sensors) if samples.blend_rad is None else samples.blend_rad
    views = Views(
        first=first,
        sensor=sensor,
        start_s=samples.start_s[order].astype(float),
        end_s=samples.end_s[order].astype(float),
        seen=seen,
        sight=sight,
        time_s=samples.time_s.astype(float),
        camera=camera,
        grid=grid,
        cell_start=cell_start,
        cell_item=cell_item,
        bounded=_bounded(samples),
        magnitude=magnitude[order].astype(float),
        blend_rad=blend_rad.astype(float),
    )
    return views, order


def _bounded(samples: Samples) -> Flags:
    """Return whether each sensor's tracklets are seen from their start to their end only, (s,)."""
    outside = samples.seen & (
        (samples.time_s < samples.start_s[:, None]) | (samples.time_s > samples.end_s[:, None])
    )
    bounded = np.ones(len(samples.half_field), np.bool_)
    bounded[samples.sensor[outside.any(axis=1)]] = False
    return bounded


@kernel
def _planes(first, order, seen, u):
    """Return each sensor's planes, (s, k, 3, 3). Their axes follow the normal between instants.

    `order` (t,) sorts the tracklets by sensor: those of s are ``order[first[s]:first[s + 1]]``.
    `seen` (t, k) and `u` (t, k, 3) are those of `Samples`.
    """
    plane = np.zeros((len(first) - 1, seen.shape[1], 3, 3))
    axis, across = np.zeros(3), np.zeros(3)
    for s in range(len(plane)):
        has_axis = False
        for m in range(seen.shape[1]):
            normal = plane[s, m, 2]
            for i in order[first[s] : first[s + 1]]:
                if seen[i, m]:
                    normal += u[i, m]
            length = np.sqrt(np.sum(normal * normal))
            if not length > 0.0:
                continue
            normal /= length
            if not has_axis:  # as in `directions.tangent_basis`
                axis[:] = 0.0
                axis[2 if abs(normal[2]) < 0.9 else 0] = 1.0
                for a in range(3):
                    b, c = (a + 1) % 3, (a + 2) % 3
                    across[a] = axis[b] * normal[c] - axis[c] * normal[b]
                has_axis = True
            else:
                across[:] = axis - np.sum(axis * normal) * normal
            axis[:] = across / np.sqrt(np.sum(across * across))
            plane[s, m, 0] = axis
            for a in range(3):
                b, c = (a + 1) % 3, (a + 2) % 3
                plane[s, m, 1, a] = normal[b] * axis[c] - normal[c] * axis[b]
    return plane


@kernel
def _sort_by_position(first, order, seen, u, plane):
    """Sort the tracklets of each sensor by cells of its plane at the first instant they are seen.

    A hypothesis reads the few tracklets near its points: these become neighbours in memory. Changes
    `order` (t,), the rows of the samples by sensor, from ``first[s]`` to ``first[s + 1]``.
    `seen` (t, k) and `u` (t, k, 3) are those of `Samples`, `plane` (s, k, 3, 3) is of `_planes`.
    """
    n_instants = seen.shape[1]
    cell, position, sorted_ = (
        np.empty(len(order), np.int64),
        np.empty((len(order), 2)),
        order.copy(),
    )
    low, high = np.empty(2), np.empty(2)
    for s in range(len(first) - 1):
        lo, hi = first[s], first[s + 1]
        low[:], high[:] = np.inf, -np.inf
        for k in range(lo, hi):
            i, m = order[k], 0
            while m < n_instants - 1 and not seen[i, m]:
                m += 1
            for a in range(2):
                here = 0.0
                for b in range(3):
                    here += plane[s, m, a, b] * u[i, m, b]
                position[k, a] = here if np.isfinite(here) else 0.0
                low[a], high[a] = min(low[a], position[k, a]), max(high[a], position[k, a])
        side = int(np.sqrt(hi - lo))
        start = np.zeros(side * side + 1, np.int64)
        for k in range(lo, hi):
            q = 0
            for a in range(2):
                share = (position[k, a] - low[a]) / max(high[a] - low[a], 1e-12)
                q = q * side + min(int(share * side), side - 1)
            cell[k] = q
            start[q + 1] += 1
        start = lo + np.cumsum(start)
        for k in range(lo, hi):
            sorted_[start[cell[k]]] = order[k]
            start[cell[k]] += 1
    order[:] = sorted_


def _reach(camera: Array, grid: Indices) -> Array:
    """Return tangents of the cones about the planes' normals that hold field and tracklets."""
    side = grid[..., 1:]
    low = camera[..., CORNER:SCALE]
    high = low + side / np.maximum(camera[..., SCALE:MAX_VARIANCE], 1e-300)
    tracklets = np.hypot(*np.moveaxis(np.maximum(np.abs(low), np.abs(high)), -1, 0))
    turned = np.sum(camera[..., PLANE + 6 : TURN] * camera[..., TURN + 6 : HALF], axis=-1)
    field = np.arccos(np.clip(turned, -1, 1)) + np.arctan(np.hypot(*camera[..., HALF:CORNER].T).T)
    widest = np.fmax(np.arctan(tracklets), field)
    return np.where(side[..., 0] > 0, np.tan(np.minimum(widest, 1.5)), 0.0)


@kernel
def _flatten(sensor, order, seen, u, cov, rate, camera, sight):
    """Project directions, rates, and covariances on `directions.tangent_basis` onto the planes.

    Writes `sight` (t, k, 9), but for SIGMA_KM, and MAX_RATE of `camera` (s, k, 34). These and
    `sensor` (t,) are in the order of the search. `seen`, `u`, `cov` and `rate` are those of
    `Samples`, and `order` (t,) are their rows; `rate` is (0, k, 3) where rates are missing.
    """
    M, t, p = np.empty((2, 2)), np.empty((2, 3)), np.empty((3, 3))
    for n in range(len(order)):
        i, s = order[n], sensor[n]
        for m in range(seen.shape[1]):
            for a in range(N_SIGHT):
                if a != SIGMA_KM:
                    sight[n, m, a] = 0.0
            if not seen[i, m]:
                continue
            x, y, z = u[i, m, 0], u[i, m, 1], u[i, m, 2]
            for a in range(9):
                p[a // 3, a % 3] = camera[s, m, PLANE + a]
            if abs(z) < 0.9:
                length = np.sqrt(x * x + y * y)
                t[0, 0], t[0, 1], t[0, 2] = -y / length, x / length, 0.0
            else:
                length = np.sqrt(y * y + z * z)
                t[0, 0], t[0, 1], t[0, 2] = 0.0, -z / length, y / length
            t[1, 0] = y * t[0, 2] - z * t[0, 1]
            t[1, 1] = z * t[0, 0] - x * t[0, 2]
            t[1, 2] = x * t[0, 1] - y * t[0, 0]
            depth = max(p[2, 0] * x + p[2, 1] * y + p[2, 2] * z, 1e-3)
            for a in range(2):
                here = (p[a, 0] * x + p[a, 1] * y + p[a, 2] * z) / depth
                sight[n, m, X + a] = here
                if len(rate) > 0:
                    moved = 0.0
                    for b in range(3):
                        moved += (p[a, b] - here * p[2, b]) * rate[i, m, b] / depth
                        if rate[i, m, b] != 0.0:
                            sight[n, m, HAS_RATE] = 1.0
                    sight[n, m, DX + a] = moved
                    camera[s, m, MAX_RATE] = max(camera[s, m, MAX_RATE], abs(moved))
                for b in range(2):
                    M[a, b] = 0.0
                    for c in range(3):
                        M[a, b] += (p[a, c] - here * p[2, c]) * t[b, c] / depth
            c00, c01, c11 = cov[i, m, 0, 0], cov[i, m, 0, 1], cov[i, m, 1, 1]
            for k in range(3):
                a, b = k // 2, (k + 1) // 2  # xx, xy, yy
                along, across = c00 * M[b, 0] + c01 * M[b, 1], c01 * M[b, 0] + c11 * M[b, 1]
                sight[n, m, XX + k] = M[a, 0] * along + M[a, 1] * across


@kernel
def _fill_grids(first, seen, sight, camera, grid, cell_start, cell_item):
    """Sort each sensor's tracklets into square cells, about one tracklet per cell.

    Writes `grid`, `cell_start` and `cell_item` of `Views`, all zero before, and CORNER, SCALE,
    MAX_VARIANCE and MAX_SIGMA_KM of `camera` (s, k, 34). `first` (s + 1,), `seen` (t, k) and
    `sight` (t, k, 9) are those of `Views`.
    """
    begin, filled = 0, 0
    cell = np.empty(seen.shape[0], np.int64)
    for s in range(grid.shape[0]):
        for m in range(grid.shape[1]):
            grid[s, m, 0] = begin
            n = 0
            for a in range(2):
                low, high = np.inf, -np.inf
                for i in range(first[s], first[s + 1]):
                    if seen[i, m]:
                        low, high = min(low, sight[i, m, X + a]), max(high, sight[i, m, X + a])
                        n += 1
                camera[s, m, CORNER + a], camera[s, m, SCALE + a] = low, max(high - low, 1e-9)
            n //= 2
            if n == 0:
                continue
            side = int(np.sqrt(n))
            grid[s, m, 1] = side
            for a in range(2):
                camera[s, m, SCALE + a] = side / camera[s, m, SCALE + a] * (1 - 1e-9)
            for i in range(first[s], first[s + 1]):
                if not seen[i, m]:
                    continue
                q = 0
                for a in range(2):
                    off = sight[i, m, X + a] - camera[s, m, CORNER + a]
                    q = q * side + min(int(off * camera[s, m, SCALE + a]), side - 1)
                cell[i] = q
                cell_start[begin + q + 1] += 1
                half = (sight[i, m, XX] + sight[i, m, YY]) / 2
                apart = np.hypot((sight[i, m, XX] - sight[i, m, YY]) / 2, sight[i, m, XY])
                camera[s, m, MAX_VARIANCE] = max(camera[s, m, MAX_VARIANCE], half + apart)
                sigma_km = sight[i, m, SIGMA_KM]
                camera[s, m, MAX_SIGMA_KM] = max(camera[s, m, MAX_SIGMA_KM], sigma_km)
            cell_start[begin] = filled
            for q in range(side * side):
                cell_start[begin + q + 1] += cell_start[begin + q]
            for i in range(first[s], first[s + 1]):
                if seen[i, m]:
                    cell_item[cell_start[begin + cell[i]]] = i
                    cell_start[begin + cell[i]] += 1
            for q in range(side * side, 0, -1):
                cell_start[begin + q] = cell_start[begin + q - 1]
            cell_start[begin] = filled
            filled += n
            begin += side * side + 1


@borrowing_kernel
def cells_near(views, s, m, at0, at1, reach0, reach1):
    """Return the grid cells near a point of a plane: first and last row, first and last column.

    The plane is that of sensor s at instant m. Cells are near within `reach0` and `reach1` of the
    coordinates `at0` and `at1`. Where the grid has no such cell, a last number is below the first.
    """
    cam, side = views.camera, views.grid[s, m, 1]
    here = at0 - cam[s, m, CORNER]
    lo0 = max(int(np.floor((here - reach0) * cam[s, m, SCALE])), 0)
    hi0 = min(int(np.floor((here + reach0) * cam[s, m, SCALE])), side - 1)
    here = at1 - cam[s, m, CORNER + 1]
    lo1 = max(int(np.floor((here - reach1) * cam[s, m, SCALE + 1])), 0)
    hi1 = min(int(np.floor((here + reach1) * cam[s, m, SCALE + 1])), side - 1)
    return (lo0, hi0, lo1, hi1) if hi1 >= lo1 else (0, -1, 0, -1)


@borrowing_kernel
def direction(views, i, m, u):
    """Write the direction u (3,) of tracklet i at instant m."""
    s, x, y = views.sensor[i], views.sight[i, m, X], views.sight[i, m, Y]
    length = np.sqrt(1.0 + x * x + y * y)
    for a in range(PLANE, PLANE + 3):
        along = views.camera[s, m, a] * x + views.camera[s, m, a + 3] * y
        u[a - PLANE] = (along + views.camera[s, m, a + 6]) / length


@borrowing_kernel
def extra_light_s(d0, d1, d2, x):
    """Return the light time from x to the sensor minus that to the Earth's centre [s].

    `d0`, `d1`, `d2` is the vector [km] from the sensor to the point `x` (3,) [km], GCRF.
    """
    range_km = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    return (range_km - np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])) / SPEED_OF_LIGHT_KM_S


@borrowing_kernel
def residual(views, i, m, x, part):
    """Write a view's residual, predicted minus measured, with partials and weight.

    The object is at x (3,) [km], GCRF, one geocentric light time before the instant. A sensor at
    another range sees it there `extra_light_s` after the instant. Sensor and direction are moved to
    that time.

    `part` (11,) or longer, on the sensor's plane: the residual (2), its partials (2 by 3) [1/km],
    and the inverse covariance (xx, xy, yy). Returns the depth of the point [km], 0 behind the
    sensor.
    """
    # Element by element: numba counts references to every row that is sliced.
    cam, see, s = views.camera, views.sight, views.sensor[i]
    d0, d1, d2 = x[0] - cam[s, m, 0], x[1] - cam[s, m, 1], x[2] - cam[s, m, 2]
    n0, n1, n2 = cam[s, m, PLANE + 6], cam[s, m, PLANE + 7], cam[s, m, PLANE + 8]
    depth = n0 * d0 + n1 * d1 + n2 * d2
    if not depth > 0.0:
        return 0.0
    later, moves = extra_light_s(d0, d1, d2, x), see[i, m, HAS_RATE]
    v0, v1, v2 = cam[s, m, V_KM_S], cam[s, m, V_KM_S + 1], cam[s, m, V_KM_S + 2]
    for a in range(2):
        q = PLANE + 3 * a
        p0, p1, p2 = cam[s, m, q], cam[s, m, q + 1], cam[s, m, q + 2]
        here = (p0 * d0 + p1 * d1 + p2 * d2) / depth
        p0, p1, p2 = (p0 - here * n0) / depth, (p1 - here * n1) / depth, (p2 - here * n2) / depth
        motion = moves * (p0 * v0 + p1 * v1 + p2 * v2) + see[i, m, DX + a]
        part[a] = here - see[i, m, X + a] - later * motion
        part[2 + 3 * a], part[3 + 3 * a], part[4 + 3 * a] = p0, p1, p2
    # The error of the sensor's position, across the line of sight.
    extra, x0, x1 = (see[i, m, SIGMA_KM] / depth) ** 2, see[i, m, X], see[i, m, Y]
    c00 = see[i, m, XX] + extra * (1.0 + x0 * x0)
    c01 = see[i, m, XY] + extra * x0 * x1
    c11 = see[i, m, YY] + extra * (1.0 + x1 * x1)
    det = c00 * c11 - c01 * c01
    part[8], part[9], part[10] = c11 / det, -c01 / det, c00 / det
    return depth


@borrowing_kernel
def residual_chi2(part):
    """Return the chi-square of a residual that `residual` wrote to `part`."""
    e0, e1 = part[0], part[1]
    return part[8] * e0 * e0 + 2 * part[9] * e0 * e1 + part[10] * e1 * e1


@borrowing_kernel
def error_sr(views, i, m, part):
    """Return the solid angle [sr] of the errors of a residual that `residual` wrote.

    It is 2 pi times the square root of the determinant of their covariance, that of the sensor's
    position included. The residual `part` is that of tracklet i at instant m.
    """
    flat = 1.0 + views.sight[i, m, X] ** 2 + views.sight[i, m, Y] ** 2
    return 2 * np.pi / np.sqrt((part[8] * part[10] - part[9] ** 2) * flat**3)
