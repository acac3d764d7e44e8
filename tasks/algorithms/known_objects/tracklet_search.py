"""The search for the satellites of a catalogue that a tracklet may show.

1. All satellites are predicted at nodes of ten minutes, with cubics between them, and sorted into
   cubes of space anew for each half minute.
2. A tracklet is a line of sight from its sensor. The satellites in the cubes along it are
   compared with it, and all that are farther from the Earth than the cubes reach.
3. One that would be seen so if it were ahead of its prediction, or behind, and that would then move
   nearly so, is predicted by SGP4 at the tracklet's epoch.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from sgp4.api import SatrecArray

from epipole.schemas.arrays import Array, Flags, Indices, Nanoseconds
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM, GM_KM3_S2, SECOND_NS
from epipole.tasks.algorithms.geometry.directions import east_north, unit_from_radec
from epipole.tasks.algorithms.kernels import borrowing_kernel, inlined_kernel, kernel
from epipole.tasks.algorithms.known_objects.prediction import Satellites, predict_all, predict_each
from epipole.tasks.algorithms.times import direction_to_sun

# Cubics between the nodes are up to 4 km off in low orbit. During a slice, motion is a straight
# line, up to 1 km off.
NODE_NS = 600 * SECOND_NS
SLICE_NS = 30 * SECOND_NS
NEGLECTED_KM = 5.0
# Cubes: so large that a satellite within `MAX_REACH_KM` of a point of the line, of which there is
# one in each cube's length, is in the cube of that point or one beside it, wherever it moves during
# a slice.
CUBE_KM = 600.0
MAX_REACH_KM = 300.0
MARGIN_KM = 100.0  # rounding of far ones, and reaches aside
N_CUBES = 30  # per axis: they reach to 9,000 km
OVER, UP = (-1, -1, -1, 0, 0, 0, 1, 1, 1), (-1, 0, 1, -1, 0, 1, -1, 0, 1)  # columns of cubes
LOWEST_KM = 6000.0  # a line of sight ends inside the Earth
# The motion that is allowed to differ: a share of it, shares for each share of the distance that
# the position may be off across the track, and errors of both.
RATE_SHARE = 0.03
RATE_SHARES = 3.0
RATE_SIGMAS = 6.0
RATE_KM_S = 0.03  # of the elements, beside what moves with the sensor
# The Sun's radius over its distance: the Earth's shadow narrows by this. Within the margin of its
# edge a satellite may be lit: its position is not known better, and air bends light.
SUN_RADIUS_RAD = 0.00465
SHADOW_MARGIN_KM = 100.0
MIN_DISTANCE_KM = 20.0  # nearer is the satellite that carries the sensor
# No satellite is brighter at 1,000 km for longer than a flare: the brightest station has -1.8.
BRIGHTEST_AT_1000_KM = -4.0


class SeenTracklets(NamedTuple):
    """What m tracklets tell, each of one sensor at its epoch.

    time_ns : (m,) int
        Epoch, UTC since 1970.
    ra_dec, rates : (m, 2) float
        Astrometric direction [rad] and its rate [rad/s], the first of each times cos dec where it
        is a difference or rate; GCRF axes.
    cov : (m, 4, 4) float
        Covariance of direction and rates, with all that the sensor's tracklets share.
    r_km, v_km_s : (m, 3) float
        The sensor's position and velocity, GCRF.
    position_sigma_km : (m,) float
        1-sigma error of the sensor's position, per axis.
    magnitude : (m,) float
        NaN where unknown.
    """

    time_ns: Nanoseconds
    ra_dec: Array
    rates: Array
    cov: Array
    r_km: Array
    v_km_s: Array
    position_sigma_km: Array
    magnitude: Array

    def take(self, rows: Indices) -> "SeenTracklets":
        """Return some of the tracklets."""
        return SeenTracklets._make(column[rows] for column in self)

    def axes(self) -> Array:
        """Return the line of sight and the directions of growing ra and dec as rows, (m, 3, 3)."""
        u = unit_from_radec(*self.ra_dec.T)
        return np.concatenate([u[:, None], east_north(u)], axis=1)


class Pairs(NamedTuple):
    """Tracklets and satellites that they may show, sorted by tracklet and then by satellite.

    tracklet, satellite : (k,) int
        Rows of the tracklets and of the catalogue.
    states : (k, 6) float
        The satellite's state at the tracklet's epoch by SGP4, GCRF [km, km/s].
    """

    tracklet: Indices
    satellite: Indices
    states: Array

    def take(self, which: Flags | Indices | slice) -> "Pairs":
        """Return some of the pairs."""
        return Pairs._make(column[which] for column in self)


def find_pairs(
    tracklets: SeenTracklets, satellites: Satellites, along_km: Array, aside_km: Array
) -> Pairs:
    """Return the pairs of tracklets and satellites that are near each other and move alike.

    Parameters
    ----------
    satellites
        n of them.
    along_km, aside_km : (n,) float
        How far each satellite may be from its prediction along its track, at most
        `MAX_REACH_KM`, and at right angles to it.
    """
    order = np.argsort(tracklets.time_ns, kind="stable")
    slices = tracklets.time_ns[order] // SLICE_NS
    lines = _lines(tracklets)
    reach_km = np.stack([np.minimum(along_km, MAX_REACH_KM), aside_km + NEGLECTED_KM], axis=1)
    reach_km = reach_km.astype(np.float32)
    nodes, found = _Nodes(satellites), [np.empty((0, 2), np.int64)]
    for at in np.split(order, np.flatnonzero(np.diff(slices)) + 1) if len(order) else []:
        middle_ns = int(tracklets.time_ns[at[0]]) // SLICE_NS * SLICE_NS + SLICE_NS // 2
        dt_s = ((tracklets.time_ns[at] - middle_ns) / SECOND_NS).astype(np.float32)
        states = nodes.states(middle_ns)
        pairs = _near(lines[at], dt_s, *_cubes(states), reach_km)
        found.append(np.stack([at[pairs[:, 0]], pairs[:, 1]], axis=1))
    both = np.concatenate(found)
    both = both[np.lexsort((both[:, 1], both[:, 0]))]
    pairs = Pairs(both[:, 0], both[:, 1], _states(tracklets, satellites, both))
    return pairs.take(_may_be_seen(tracklets, pairs))


def _states(tracklets: SeenTracklets, satellites: Satellites, both: Indices) -> Array:
    """Return the states of pairs. Velocities are derivatives: those of SGP4 lack small terms."""
    time_ns = tracklets.time_ns[both[:, 0]]
    before, at, after = (
        predict_each(satellites, both[:, 1], time_ns + dt_ns)[:, :3]
        for dt_ns in (-SECOND_NS // 2, 0, SECOND_NS // 2)
    )
    return np.concatenate([at, after - before], axis=1)


def _lines(tracklets: SeenTracklets) -> npt.NDArray[np.float32]:
    """Return direction, its rate, sensor position and velocity, and the rate's error, (m, 13)."""
    axes = tracklets.axes()
    rates = np.einsum("mi,mij->mj", tracklets.rates, axes[:, 1:])
    sigma = np.sqrt(np.trace(tracklets.cov[:, 2:, 2:], axis1=1, axis2=2))
    columns = [axes[:, 0], rates, tracklets.r_km, tracklets.v_km_s, RATE_SIGMAS * sigma[:, None]]
    return np.concatenate(columns, axis=1).astype(np.float32)


class _Nodes:
    """States of satellites at any time, by cubics between nodes that are kept while needed."""

    def __init__(self, satellites: Satellites) -> None:
        self._satellites = SatrecArray(list(satellites))
        self._nodes: dict[int, Array] = {}

    def states(self, time_ns: int) -> npt.NDArray[np.float32]:
        """Return positions [km] and velocities [km/s], GCRF, (n, 6)."""
        node, rest = divmod(time_ns, NODE_NS)
        self._nodes = {
            k: self._nodes[k]
            if k in self._nodes
            else predict_all(self._satellites, np.array([k * NODE_NS]))[:, 0]
            for k in (node, node + 1)
        }
        return _between(self._nodes[node], self._nodes[node + 1], rest / NODE_NS)


@kernel
def _between(before, after, share):
    """Return (n, 6) float32 states between two nodes, by the cubic that fits both."""
    h = NODE_NS / SECOND_NS
    out = np.empty(before.shape, np.float32)
    for k in range(len(before)):
        for i in range(3):
            start = h * before[k, 3 + i]
            step = after[k, i] - before[k, i]
            bend = start + h * after[k, 3 + i] - 2 * step
            turn = step - start - bend
            out[k, i] = before[k, i] + share * (start + share * (turn + share * bend))
            out[k, 3 + i] = (start + share * (2 * turn + share * 3 * bend)) / h
    return out


@inlined_kernel
def _cube(x, y, z):
    """Return the number of the cube of a point [km, GCRF]; `N_CUBES` ** 3 outside of all."""
    half = N_CUBES // 2
    i, j = int(np.floor(x / CUBE_KM)) + half, int(np.floor(y / CUBE_KM)) + half
    k = int(np.floor(z / CUBE_KM)) + half
    if min(i, j, k) < 0 or max(i, j, k) >= N_CUBES:
        return N_CUBES**3
    return (i * N_CUBES + j) * N_CUBES + k


@kernel
def _cubes(states):
    """Sort (n, 6) states by cube; those outside of all cubes come last, NaN are left out.

    Returns
    -------
    states, order : (v, 6), (v,)
        The sorted states, and their satellites.
    first : (cubes + 2,) int
        The first of each cube.
    """
    n = len(states)
    cube = np.empty(n, np.int64)
    first = np.zeros(N_CUBES**3 + 2, np.int64)
    for k in range(n):
        valid = np.isfinite(states[k, 0])
        cube[k] = _cube(states[k, 0], states[k, 1], states[k, 2]) if valid else -1
        if valid:
            first[cube[k] + 1] += 1
    first = np.cumsum(first)
    at = first.copy()
    order, ordered = np.empty(first[-1], np.int64), np.empty((first[-1], 6), np.float32)
    for k in range(n):
        if cube[k] >= 0:
            j = at[cube[k]]
            at[cube[k]] += 1
            order[j], ordered[j] = k, states[k]
    return ordered, order, first


@kernel
def _near(lines, dt_s, states, order, first, reach_km):
    """Return rows (tracklet, satellite) of pairs that are near each other and move alike, (k, 2).

    `lines` (m, 13) of `_lines`; `dt_s` (m,): seconds since the instant of the states;
    `states`, `order` and `first` of `_cubes`; `reach_km` (n, 2) of the satellites: along the track,
    and at right angles to it.
    """
    found = np.empty((64, 2), np.int64)
    count = 0
    for i in range(len(lines)):
        for n in range(-1, 3 * N_CUBES):
            x, y, z = _point(lines, i, n * CUBE_KM)
            if n >= 0 and _is_end(lines, i, x, y, z):
                break
            for c in range(9 if n >= 0 else 1):
                start, end = first[N_CUBES**3], first[N_CUBES**3 + 1]
                if n >= 0:
                    start, end = _row(first, x + OVER[c] * CUBE_KM, y + UP[c] * CUBE_KM, z)
                for j in range(start, end):
                    if not (
                        _is_beside(lines, i, dt_s[i], states, j, n)
                        and _fits(lines, i, dt_s[i], states, j, reach_km, order[j])
                    ):
                        continue
                    if count == len(found):
                        more = np.empty((2 * count, 2), np.int64)
                        more[:count] = found
                        found = more
                    found[count, 0], found[count, 1] = i, order[j]
                    count += 1
    return found[:count].copy()


@borrowing_kernel
def _row(first, x, y, z):
    """Return where the satellites in the cube of a point and the two beside it in z begin and end.

    They are rows of the sorted states of `_cubes`, the end not included; `first` (cubes + 2,) is of
    `_cubes` too. x, y, z [km], GCRF.
    """
    half = N_CUBES // 2
    i, j = int(np.floor(x / CUBE_KM)) + half, int(np.floor(y / CUBE_KM)) + half
    k = int(np.floor(z / CUBE_KM)) + half
    if min(i, j) < 0 or max(i, j) >= N_CUBES or k < -1 or k > N_CUBES:
        return 0, 0
    row = (i * N_CUBES + j) * N_CUBES
    return first[row + max(k - 1, 0)], first[row + min(k + 2, N_CUBES)]


@borrowing_kernel
def _point(lines, i, along_km):
    """Return the point of a line of sight at some distance from its sensor [km], GCRF.

    The line is row i of `lines` (m, 13), see `_lines`.
    """
    return (
        lines[i, 6] + along_km * lines[i, 0],
        lines[i, 7] + along_km * lines[i, 1],
        lines[i, 8] + along_km * lines[i, 2],
    )


@borrowing_kernel
def _is_end(lines, i, x, y, z):
    """Return whether a point of a line of sight is in the Earth, or leaves all cubes.

    The line is row i of `lines` (m, 13), see `_lines`; x, y, z [km], GCRF.
    """
    height_km = np.sqrt(x * x + y * y + z * z)
    is_leaving = x * lines[i, 0] + y * lines[i, 1] + z * lines[i, 2] > 0
    return height_km < LOWEST_KM or (is_leaving and height_km > CUBE_KM * N_CUBES)


@inlined_kernel
def _is_beside(lines, i, dt, states, k, n):
    """Return whether a satellite is within `MAX_REACH_KM` and some of a line of sight.

    The line is row i of `lines` (m, 13), see `_lines`, `dt` [s] after the instant of the states;
    the satellite is row k of `states` (v, 6) [km, km/s], GCRF. With `n` >= 0 its distance along the
    line must be nearest to `n` cubes: the others are compared with other points of the line.
    """
    x, y, z = (
        states[k, 0] + dt * states[k, 3] - lines[i, 6],
        states[k, 1] + dt * states[k, 4] - lines[i, 7],
        states[k, 2] + dt * states[k, 5] - lines[i, 8],
    )
    ahead = x * lines[i, 0] + y * lines[i, 1] + z * lines[i, 2]
    off2 = x * x + y * y + z * z - ahead * ahead
    is_near = ahead > 0 and off2 < (MAX_REACH_KM + MARGIN_KM) ** 2
    return is_near and (n < 0 or abs(ahead - n * CUBE_KM) <= CUBE_KM / 2)


@borrowing_kernel
def _fits(lines, i, dt, states, k, reach_km, satellite):
    """Return whether a satellite may be on a line of sight, and move as the tracklet does.

    It may be ahead of its prediction or behind. The line and the satellite are those of
    `_is_beside`; the reaches [km], along the track and at right angles, are row `satellite` of
    `reach_km` (n, 2).
    """
    along_km, aside_km = reach_km[satellite, 0], reach_km[satellite, 1]
    ux, uy, uz = lines[i, 0], lines[i, 1], lines[i, 2]
    vx, vy, vz = states[k, 3], states[k, 4], states[k, 5]
    rx, ry, rz = states[k, 0] + dt * vx, states[k, 1] + dt * vy, states[k, 2] + dt * vz
    dx, dy, dz = rx - lines[i, 6], ry - lines[i, 7], rz - lines[i, 8]
    ahead = dx * ux + dy * uy + dz * uz
    v2, d2 = vx * vx + vy * vy + vz * vz, dx * dx + dy * dy + dz * dz
    vu = vx * ux + vy * uy + vz * uz
    dv = dx * vx + dy * vy + dz * vz
    if d2 - ahead * ahead > (along_km + aside_km) ** 2:
        return False
    # How far ahead of its prediction [s] it would be nearest to the line.
    v2_aside = max(v2 - vu * vu, np.float32(1e-6) * v2)
    limit = along_km / np.sqrt(v2)
    s = min(max((ahead * vu - dv) / v2_aside, -limit), limit)
    t = dt + s  # since the instant of the states
    pull = GM_KM3_S2 / (rx * rx + ry * ry + rz * rz) ** 1.5
    fall = pull * t * t / 2
    dx, dy, dz = dx + s * vx - fall * rx, dy + s * vy - fall * ry, dz + s * vz - fall * rz
    ahead = dx * ux + dy * uy + dz * uz
    d2 = dx * dx + dy * dy + dz * dz
    if ahead <= 0 or d2 - ahead * ahead > aside_km * aside_km:
        return False
    wx = vx - pull * t * rx - lines[i, 9]
    wy = vy - pull * t * ry - lines[i, 10]
    wz = vz - pull * t * rz - lines[i, 11]
    wu = (wx * dx + wy * dy + wz * dz) / d2
    distance = np.sqrt(d2)
    ex = (wx - wu * dx) / distance - lines[i, 3]
    ey = (wy - wu * dy) / distance - lines[i, 4]
    ez = (wz - wu * dz) / distance - lines[i, 5]
    speed = np.sqrt(wx * wx + wy * wy + wz * wz) / distance
    allowed = (RATE_SHARE + RATE_SHARES * aside_km / distance) * speed + lines[i, 12]
    allowed += RATE_KM_S / distance
    return ex * ex + ey * ey + ez * ez < allowed * allowed


def _may_be_seen(tracklets: SeenTracklets, pairs: Pairs) -> Flags:
    """Return whether each satellite is in sunlight, before the Earth, and not too bright."""
    r_km, from_km = pairs.states[:, :3], tracklets.r_km[pairs.tracklet]
    to_sun = direction_to_sun(tracklets.time_ns)[pairs.tracklet]
    sunward = np.sum(r_km * to_sun, axis=1)
    aside = np.linalg.norm(r_km - sunward[:, None] * to_sun, axis=1)
    shadow_km = EARTH_RADIUS_KM + SUN_RADIUS_RAD * sunward - SHADOW_MARGIN_KM
    line = r_km - from_km
    distance = np.linalg.norm(line, axis=1)
    share = np.clip(-np.sum(from_km * line, axis=1) / distance**2, 0.0, 1.0)
    height = np.linalg.norm(from_km + share[:, None] * line, axis=1)
    reduced = tracklets.magnitude[pairs.tracklet] - 5 * np.log10(distance / 1000.0)
    is_lit = (sunward > 0) | (aside > shadow_km)
    is_visible = (height > EARTH_RADIUS_KM - SHADOW_MARGIN_KM) & (distance > MIN_DISTANCE_KM)
    return is_lit & is_visible & ~(reduced < BRIGHTEST_AT_1000_KM)  # NaN: may be
