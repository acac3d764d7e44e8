"""Pair search: two attributables that one orbit may explain, and that orbit.

Two ranges and the time between give an orbit (Lambert's problem). The rates of both directions are
then four numbers for two unknowns. With Lagrange's coefficients f and g of the orbit between both
positions, the rates are linear in the two ranges (after Siminski et al. 2014, "Short-arc tracklet
association for geostationary objects", Adv. Space Res. 53, 1184, whose boundary value problem
searches the ranges). So four small least-squares solutions replace the search: the first with
the coefficients of a circular orbit at the sensor's height.
"""

from collections.abc import Callable

import numpy as np

from epipole.schemas.arrays import Array, Indices
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM, ESCAPE_SPEED_KM_S, GM_KM3_S2, J2
from epipole.tasks.algorithms.kernels import borrowing_kernel
from epipole.tasks.algorithms.orbit_linking.arc_fit import Tracklets
from epipole.tasks.algorithms.orbit_linking.population import MIN_HEIGHT_KM
from epipole.tasks.algorithms.symmetric_matrices import invert_symmetric

# Solutions, each with the coefficients of the orbit of the one before. With 2, bench_orbit_linking
# takes up to twice the time, and joins some sets differently.
ROUNDS = 4
# Ranges are unknown at first: the first solution has the sigmas at this one. With half or twice of
# it bench_orbit_linking finds the same objects.
FIRST_RANGE_KM = 1000.0
# The path of a satellite is an orbit at range 0 from itself: it fits any two of its tracklets. So
# other solutions are searched for from circular orbits at these ranges.
OTHER_RANGES_KM = (150.0, 500.0, 1000.0, 1700.0, 2700.0)
# Two sensors are on one satellite if its orbit leads from one to the other within this distance.
SAME_SATELLITE_KM = 20.0
# Error of the first solution, as a share of the effect of gravity: the object's height is unknown.
GRAVITY_SHARE = 0.4
FASTER = 0.1  # share of that error that is left after each further solution
J2_SHARE = 0.1  # error of the mean effect of the oblateness, as a share of the effect
FIRST_GATE = 40.0  # chi-square of 2 degrees of freedom, of the first solution
GATE = 30.0  # and of the last: 3e-7 of true pairs are beyond it
MAX_RANGE_KM = 100_000.0  # as `association.max_range_km`
MIN_PAIRS = 4096  # room for pairs at first; if there are more, the search is repeated with more
MAX_LATER = 3000  # tracklets that each is compared with: bounds the time of a dense night


@borrowing_kernel
def _stumpff(z):
    """Return Stumpff's functions c2 and c3 (Battin 1999, section 4.5)."""
    if z > 1e-3:
        s = np.sqrt(z)
        return (1.0 - np.cos(s)) / z, (s - np.sin(s)) / (z * s)
    if z < -1e-3:
        s = np.sqrt(-z)
        return (np.cosh(s) - 1.0) / -z, (np.sinh(s) - s) / (-z * s)
    return 0.5 - z / 24.0 + z * z / 720.0, 1.0 / 6.0 - z / 120.0 + z * z / 5040.0


@borrowing_kernel
def lagrange(r, v, dt_s):
    """Return Lagrange's f, g and the derivative of g of two-body motion over dt_s [s].

    By universal variables (Battin 1999, section 4.5). r, v (3,) [km, km/s].
    """
    # alpha: inverse semi-major axis [1/km]; x: universal anomaly; far: distance at the end [km].
    rr = np.sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
    v2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    root = np.sqrt(GM_KM3_S2)
    sigma = (r[0] * v[0] + r[1] * v[1] + r[2] * v[2]) / root
    alpha = 2.0 / rr - v2 / GM_KM3_S2
    x = root * dt_s * alpha if alpha > 1e-6 else root * dt_s / rr
    c2, c3, z, far = 0.5, 1.0 / 6.0, 0.0, rr
    for _ in range(8):
        z = alpha * x * x
        c2, c3 = _stumpff(z)
        off = sigma * x * x * c2 + (1.0 - alpha * rr) * x**3 * c3 + rr * x - root * dt_s
        far = sigma * x * (1.0 - z * c3) + (1.0 - alpha * rr) * x * x * c2 + rr
        step = off / far
        x -= step
        if abs(step) < 1e-9 * (1.0 + abs(x)):
            break
    z = alpha * x * x
    c2, c3 = _stumpff(z)
    far = sigma * x * (1.0 - z * c3) + (1.0 - alpha * rr) * x * x * c2 + rr
    return 1.0 - x * x / rr * c2, dt_s - x**3 / root * c3, 1.0 - x * x / far * c2


@borrowing_kernel
def dot(a, b):
    """Return the product of two vectors (3,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


# The normal equations of both ranges a and b [km]: the weighted sums of squares and products
# (aa, ab, bb, a right, b right, right^2).
NO_EQUATIONS = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
SINGULAR = 1e-12  # minimum determinant over the product of the diagonal: below it is rounding


@borrowing_kernel
def _with_equation(sums, weight, of_a, of_b, right):
    """Return the sums with the equation ``of_a * a + of_b * b = right`` of this weight."""
    aa, ab, bb, a_right, b_right, square = sums
    return (
        aa + weight * of_a * of_a,
        ab + weight * of_a * of_b,
        bb + weight * of_b * of_b,
        a_right + weight * of_a * right,
        b_right + weight * of_b * right,
        square + weight * right * right,
    )


@borrowing_kernel
def _solved_ranges(sums):
    """Return the ranges [km] that fit best, and chi-square; inf where the sums are singular."""
    aa, ab, bb, a_right, b_right, square = sums
    det = aa * bb - ab * ab
    if not det > SINGULAR * aa * bb:
        return 0.0, 0.0, np.inf
    a, b = (bb * a_right - ab * b_right) / det, (aa * b_right - ab * a_right) / det
    return a, b, square - a * a_right - b * b_right


@borrowing_kernel
def _ranges(tracklets, i, j, arc, a, b, model_km, oblate):
    """Return the ranges for which the rates of both directions fit best, and their chi-square.

    Parameters
    ----------
    arc : (4,) tuple
        Time between both [s], Lagrange's f, g and derivative of g.
    a, b : float
        Approximate ranges, for the weights [km].
    model_km : float
        1-sigma error of the equations.
    oblate : (3,) float
        Mean acceleration by the oblateness [km/s^2].
    """
    dt, f, g, gdot = arc
    si, sj, sums = tracklets.r_km[i], tracklets.r_km[j], NO_EQUATIONS
    common = tracklets.position_km[i] ** 2 + tracklets.position_km[j] ** 2 + model_km * model_km
    for side in range(2):
        # The equation is for the rate of k; `near` and `far` are the ranges of k and of the other.
        k, other, near, far = (i, j, a, b) if side == 0 else (j, i, b, a)
        for c in range(2):
            axis = tracklets.east[k] if c == 0 else tracklets.north[k]
            of_rate, of_other = -g * dot(axis, tracklets.w[k]), dot(axis, tracklets.u[other])
            right = g * dot(axis, tracklets.v_km_s[k])
            half = -0.5 * dt * dt * dot(axis, oblate)
            if side == 0:
                pa, pb = of_rate, of_other
                right -= dot(axis, sj) + half - f * dot(axis, si)
            else:
                pa, pb = -of_other, of_rate
                right -= gdot * dot(axis, sj) - dot(axis, si) - half
            of_k, others = tracklets.cov[k], tracklets.cov[other]
            variance = near * near * (g * g * of_k[2 + c, 2 + c] + of_k[c, c])
            weight = 1.0 / (variance + far * far * others[c, c] + common)
            sums = _with_equation(sums, weight, pa, pb, right)
    return _solved_ranges(sums)


@borrowing_kernel
def join_pair(tracklets, i, j, first_km, state, work):
    """Find the orbit through two attributables; write it at i's epoch to `state` (6,).

    The state is in the GCRF [km, km/s]. The first solution is about a circular orbit at the
    distance `first_km` from the geocentre.

    Returns chi-square of 2 degrees of freedom, inf where no orbit in space is near. `work` (8, 3)
    is scratch.
    """
    dt = tracklets.time_s[j] - tracklets.time_s[i]
    ri, rj, v, oblate = work[0], work[1], work[2], work[3]
    n = np.sqrt(GM_KM3_S2 / first_km**3)
    arc = dt, np.cos(n * dt), np.sin(n * dt) / n, np.cos(n * dt)
    for m in range(3):
        oblate[m] = 0.0
    a = b = FIRST_RANGE_KM
    r2, chi2 = first_km * first_km, np.inf
    model_km = GRAVITY_SHARE * 0.5 * GM_KM3_S2 / r2 * dt * dt
    for round_ in range(ROUNDS):
        a, b, chi2 = _ranges(tracklets, i, j, arc, a, b, model_km, oblate)
        if not (chi2 < FIRST_GATE and 0.1 < a < MAX_RANGE_KM and 0.1 < b < MAX_RANGE_KM):
            return np.inf
        for m in range(3):
            ri[m] = tracklets.r_km[i, m] + a * tracklets.u[i, m]
            rj[m] = tracklets.r_km[j, m] + b * tracklets.u[j, m]
        r2 = dot(ri, ri)
        if min(r2, dot(rj, rj)) < (EARTH_RADIUS_KM + MIN_HEIGHT_KM) ** 2:
            return np.inf
        if abs(arc[2]) > 1.0:
            for m in range(3):
                v[m] = (rj[m] - oblate[m] * 0.5 * dt * dt - arc[1] * ri[m]) / arc[2]
        else:
            _velocity(tracklets, i, j, a, b, v, work[4:7], work[7])  # g is too small to divide by
        f, g, gdot = lagrange(ri, v, dt)
        arc = dt, f, g, gdot
        # Error of the next solution: its coefficients are of the ranges of this one.
        model_km = J2_SHARE * 0.5 * _oblateness(ri, rj, oblate) * dt * dt
        if round_ < ROUNDS - 1:
            share = GRAVITY_SHARE * FASTER ** (round_ + 1)
            model_km += share * 0.5 * GM_KM3_S2 / r2 * dt * dt
    if dot(v, v) / 2.0 > GM_KM3_S2 / np.sqrt(r2):
        return np.inf
    for m in range(3):
        state[m], state[3 + m] = ri[m], v[m]
    return chi2


@borrowing_kernel
def _oblateness(ri, rj, out):
    """Write the acceleration by the oblateness between two positions; return its scale [km/s^2].

    ri (3,), rj (3,): the positions [km]; `out` (3,): the acceleration [km/s^2], GCRF.
    """
    r2 = dot(ri, ri)
    scale = 1.5 * J2 * EARTH_RADIUS_KM**2 * GM_KM3_S2 / (r2 * r2)
    z = 0.5 * (ri[2] + rj[2])
    for m in range(3):
        share = 0.5 * (ri[m] + rj[m]) / np.sqrt(r2)
        out[m] = -scale * share * ((3.0 if m == 2 else 1.0) - 5.0 * z * z / r2)
    return scale


@borrowing_kernel
def _velocity(tracklets, i, j, a, b, v, N, right):
    """Write the velocity that fits the rates of both directions, for epochs at most a second apart.

    v (3,): the velocity [km/s], GCRF; a, b: the ranges [km]. N (3, 3) and right (3,) are scratch.
    """
    for m in range(3):
        right[m] = 0.0
        for n in range(3):
            N[m, n] = 0.0
    for side in range(2):
        k, rho = (i, a) if side == 0 else (j, b)
        for c in range(2):
            axis = tracklets.east[k] if c == 0 else tracklets.north[k]
            value = dot(axis, tracklets.v_km_s[k]) + rho * dot(axis, tracklets.w[k])
            weight = 1.0 / (rho * rho * tracklets.cov[k, 2 + c, 2 + c] + 1e-12)
            for m in range(3):
                right[m] += weight * axis[m] * value
                for n in range(3):
                    N[m, n] += weight * axis[m] * axis[n]
    trace = N[0, 0] + N[1, 1] + N[2, 2]
    for m in range(3):
        N[m, m] += 1e-9 * trace
    if invert_symmetric(N, N) == 0.0:
        N[0, 0] = N[1, 1] = N[2, 2] = np.nan
    for m in range(3):
        v[m] = N[m, 0] * right[0] + N[m, 1] * right[1] + N[m, 2] * right[2]


@borrowing_kernel
def may_be_one(tracklets, i, j):
    """Return whether two tracklets may be one object: not if one sensor saw both at one time."""
    if tracklets.sensor[i] != tracklets.sensor[j]:
        return True
    return tracklets.first_s[j] > tracklets.last_s[i] or tracklets.first_s[i] > tracklets.last_s[j]


# Columns of `packed_tracklets`: vectors of three, then numbers.
_R, _V, _U, _EAST, _NORTH = 0, 3, 6, 9, 12
_OF_V, _OF_W, _OF_R = 15, 17, 19  # components east and north of v, w and r
# Mean variances per axis, of the rate [rad^2/s^2], the direction [rad^2] and the sensor's position
# [km^2]; largest range of a bound object with that rate [km]; time [s].
_RATE_VAR, _VAR, _POSITION_VAR, _REACH, _TIME = 21, 22, 23, 24, 25
_COLUMNS = 26


def packed_tracklets(tracklets: Tracklets) -> Array:
    """Return (n, 26) what `search` needs of each tracklet, side by side in memory."""
    east, north, cov = tracklets.east, tracklets.north, tracklets.cov
    across = tracklets.v_km_s - _along(tracklets.v_km_s, tracklets.u)[:, None] * tracklets.u
    rate = np.linalg.norm(tracklets.w, axis=1)
    with np.errstate(divide="ignore"):
        reach = (ESCAPE_SPEED_KM_S + np.linalg.norm(across, axis=1)) / rate
    columns = [
        tracklets.r_km, tracklets.v_km_s, tracklets.u, east, north,
        *(
            np.stack([_along(axis, vector) for axis in (east, north)], axis=1)
            for vector in (tracklets.v_km_s, tracklets.w, tracklets.r_km)
        ),
        np.stack([(cov[:, 2, 2] + cov[:, 3, 3]) / 2, (cov[:, 0, 0] + cov[:, 1, 1]) / 2,
                  tracklets.position_km**2, np.minimum(reach, MAX_RANGE_KM), tracklets.time_s],
                 axis=1),
    ]  # fmt: skip
    return np.ascontiguousarray(np.concatenate(columns, axis=1))


def _along(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("ni,ni->n", a, b))


@borrowing_kernel
def _dot_at(a, m, b, n):
    """Return the product of the vectors (3,) that begin at ``a[m]`` and ``b[n]``."""
    return a[m] * b[n] + a[m + 1] * b[n + 1] + a[m + 2] * b[n + 2]


@borrowing_kernel
def first_ranges(p, q, f, g, model_km):
    """Return the ranges [km] of the first solution of two tracklets, and chi-square.

    p (26,), q (26,): rows of `packed_tracklets`; f and g [s]: Lagrange's; model_km: 1-sigma error
    of the equations. These are those of `_ranges`, without oblateness. All pairs are tested, so
    both axes share one weight: that of their mean variance.
    """
    square = FIRST_RANGE_KM * FIRST_RANGE_KM
    common = p[_POSITION_VAR] + q[_POSITION_VAR] + model_km * model_km
    common += square * (p[_VAR] + q[_VAR])
    of_p = 1.0 / (common + g * g * square * p[_RATE_VAR])
    of_q = 1.0 / (common + g * g * square * q[_RATE_VAR])
    sums = NO_EQUATIONS
    for c in range(2):
        axis = _EAST + 3 * c
        right = g * p[_OF_V + c] - _dot_at(p, axis, q, _R) + f * p[_OF_R + c]
        sums = _with_equation(sums, of_p, -g * p[_OF_W + c], _dot_at(p, axis, q, _U), right)
        right = g * q[_OF_V + c] - f * q[_OF_R + c] + _dot_at(q, axis, p, _R)
        sums = _with_equation(sums, of_q, -_dot_at(q, axis, p, _U), -g * q[_OF_W + c], right)
    return _solved_ranges(sums)


@borrowing_kernel
def _first_chi2(p, q, dt, f, g):
    """Return chi-square of the first solution of `join_pair`; inf where a range is not positive.

    p (26,), q (26,): rows of `packed_tracklets`; dt [s]: the time between; f and g [s]: Lagrange's,
    of a circular orbit.
    """
    fall = GRAVITY_SHARE * 0.5 * GM_KM3_S2 / _dot_at(p, _R, p, _R) * dt * dt
    a, b, chi2 = first_ranges(p, q, f, g, fall)
    return chi2 if a > 0.0 and b > 0.0 else np.inf


@borrowing_kernel
def _on_one_satellite(p, q, dt, f, g):
    """Return whether the sensors of two tracklets move on one orbit.

    Arguments as in `_first_chi2`.
    """
    off = 0.0
    for m in range(3):
        off += (f * p[_R + m] + g * p[_V + m] - q[_R + m]) ** 2
    # Eccentricity and oblateness bend the orbit away from a circle, by a hundredth at most.
    bend = 0.01 * GM_KM3_S2 / _dot_at(p, _R, p, _R) * dt * dt
    return off < SAME_SATELLITE_KM**2 + bend * bend


@borrowing_kernel
def search(tracklets, packed, group, max_gap_s, first, last, pairs, states, state, work):
    """Find pairs of tracklets that one orbit may explain, earlier ones of rows first to last.

    Parameters
    ----------
    tracklets, packed
        `Tracklets`, and `packed_tracklets` of them.
    group : (n,) int
        Known objects, -1 for none.
    max_gap_s : float
        Longest time between both; less where more than `MAX_LATER` tracklets follow.
    pairs, states : (m, 2), (m, 6), out
        The pairs, and an orbit of each at the earlier epoch. A pair is there once per orbit.
    state, work : (6,), (8, 3)
        Scratch.

    Returns
    -------
    int
        Number of pairs. It may be larger than m: then the rest is not written.
    """
    count, total = 0, len(group)
    for i in range(first, last):
        p = packed[i]
        n = np.sqrt(GM_KM3_S2 / _dot_at(p, _R, p, _R) ** 1.5)
        for j in range(i + 1, min(total, i + 1 + MAX_LATER)):
            q = packed[j]
            dt = q[_TIME] - p[_TIME]
            if dt > max_gap_s:
                break
            if _too_far(p, q, dt) or (group[i] >= 0 and group[i] == group[j]):
                continue
            f, g = np.cos(n * dt), np.sin(n * dt) / n
            # Start 0 is a circular orbit at the sensor's height, 1 and on those at other ranges.
            start = 0 if _first_chi2(p, q, dt, f, g) < FIRST_GATE else 1
            end = 1 + (len(OTHER_RANGES_KM) if _on_one_satellite(p, q, dt, f, g) else 0)
            if start == end or not may_be_one(tracklets, i, j):
                continue
            for k in range(start, end):
                first_km = _start_km(p, OTHER_RANGES_KM[k - 1] if k else 0.0)
                if not join_pair(tracklets, i, j, first_km, state, work) < GATE:
                    continue
                count = add_pair(i, j, state, count, pairs, states)
    return count


@borrowing_kernel
def add_pair(i, j, state, count, pairs, states):
    """Write a pair and its orbit as number `count`, where there is room; return the next number.

    `pairs` (m, 2) and `states` (m, 6) have room for m; `state` (6,) is the orbit [km, km/s], GCRF.
    """
    if count < len(pairs):
        pairs[count, 0], pairs[count, 1] = i, j
        for m in range(6):
            states[count, m] = state[m]
    return count + 1


@borrowing_kernel
def _too_far(p, q, dt):
    """Return whether no bound object can be near both lines of sight, `dt` [s] apart.

    p (26,), q (26,): rows of `packed_tracklets`.
    """
    apart2 = 0.0
    for m in range(3):
        apart2 += (q[_R + m] - p[_R + m]) ** 2
    reach = p[_REACH] + q[_REACH] + ESCAPE_SPEED_KM_S * dt
    return apart2 > reach * reach


@borrowing_kernel
def _start_km(p, rho):
    """Return the distance from the geocentre of a point on a line of sight, above the ground [km].

    p (26,): row of `packed_tracklets`; rho: range of the point [km].
    """
    r2 = _dot_at(p, _R, p, _R) + 2.0 * rho * _dot_at(p, _R, p, _U) + rho * rho
    return max(np.sqrt(r2), EARTH_RADIUS_KM + MIN_HEIGHT_KM)


def near_pairs(
    tracklets: Tracklets, packed: Array, group: Indices, max_gap_s: float
) -> tuple[Indices, Array]:
    """Return all pairs (p, 2) of `search`, and their orbits (p, 6)."""
    n, state, work = len(group), np.empty(6), np.empty((8, 3))
    return with_room(
        n, lambda *out: search(tracklets, packed, group, max_gap_s, 0, n, *out, state, work)
    )


def with_room(n: int, find: Callable[[Indices, Array], int]) -> tuple[Indices, Array]:
    """Return the pairs and orbits that a search of n tracklets writes to its arguments."""
    room = MIN_PAIRS + 8 * n
    while True:
        pairs, states = np.empty((room, 2), np.int64), np.empty((room, 6))
        count = find(pairs, states)
        if count <= room:
            return pairs[:count], states[:count]
        room = count
