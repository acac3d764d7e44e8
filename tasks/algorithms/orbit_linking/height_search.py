"""Height search: pairs of tracklets a part of a revolution apart, from circular orbits.

The solutions of `pair_search` begin with the orbit at the sensor's height. Minutes later that is
too far from the object's. Here each pair is solved about circular orbits of several heights: those
at which both tracklets, each by its direction and rates, may be nearly circular.

1. For each height, the tracklets that may move there (`at_heights`; the constrained admissible
   region of DeMars and Jah 2012, "Initial orbit determination using short-arc angle and angle rate
   data", IEEE Trans. Aerosp. Electron. Syst. 48, 2628).
2. Of each two of them, both ranges by the linear equations of `pair_search`, with Lagrange's
   coefficients of the circular orbit. Nine of ten pairs end here.
3. Range and range rate at the earlier one, so that both bodies and J2 lead to the direction and the
   rates of the later one: Newton's method (`_refine`).
"""

import numpy as np

from epipole.schemas.arrays import Array, Indices
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM, GM_KM3_S2
from epipole.tasks.algorithms.earth_gravity import advance
from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel
from epipole.tasks.algorithms.orbit_linking.arc_fit import MIN_COSINE, STEP_S, Tracklets
from epipole.tasks.algorithms.orbit_linking.pair_search import (
    FIRST_GATE,
    MAX_LATER,
    MAX_RANGE_KM,
    add_pair,
    dot,
    first_ranges,
    lagrange,
    may_be_one,
    with_room,
)
from epipole.tasks.algorithms.orbit_linking.population import MIN_HEIGHT_KM

# Distances from the geocentre [km]: even steps among low orbits, then steps of a ratio.
LOWEST_KM, LOW_KM, HIGHEST_KM = 6500.0, 8500.0, 46_000.0
LOW_STEP_KM, HIGH_RATIO = 60.0, 1.06
# Deviation of the velocity from a circular orbit's, as a share of it, of orbits that are found.
NEARLY_CIRCULAR = 0.03
# Shorter gaps are those of `pair_search`, which finds eccentric orbits too: it finds all pairs of
# simulated constellations up to ten minutes apart, and a third of those of ten to fifteen.
MIN_GAP_S = 300.0
# 1-sigma error of the circular model, as a share of the length of the arc.
WAY_SHARE = 0.02
# 1-sigma error of the model in each of Newton's steps [km]; it shrinks as they converge.
# J2 comes in with the third.
STEPS_KM = (300.0, 100.0, 30.0, 3.0)
OBLATE_STEP = 2
GATE = 60.0  # chi-square, wider than for 2 degrees of freedom: correlations are neglected


def height_edges() -> Array:
    """Return the edges of the heights: distances from the geocentre [km]."""
    low = np.arange(LOWEST_KM, LOW_KM, LOW_STEP_KM)
    n_high = int(np.ceil(np.log(HIGHEST_KM / low[-1]) / np.log(HIGH_RATIO)))
    return np.concatenate([low, low[-1] * HIGH_RATIO ** np.arange(1, n_high + 1)])


@borrowing_kernel
def _off_circle(across2, along0, slope, radius):
    """Return how far the velocity is from a circular orbit's, as a share of it, at best.

    The speed along the line of sight is free. `across2`: square of the speed at right angles to it;
    along0, slope: radial velocity, as ``(along0 + slope * speed) / radius``.
    """
    circular = np.sqrt(GM_KM3_S2 / radius)
    rest = np.sqrt(max(circular * circular - across2, 0.0))
    best = np.inf
    for c in range(3):
        speed = rest if c == 0 else -rest
        if c == 2:
            if abs(slope) < 1.0:
                continue
            speed = -along0 / slope
        radial = (along0 + slope * speed) / radius
        best = min(best, radial**2 + (np.sqrt(across2 + speed * speed) - circular) ** 2)
    return np.sqrt(best) / circular


@borrowing_kernel
def _may_move_at(tracklets, k, low, high, x, v):
    """Return whether tracklet k may be nearly circular between two distances from the geocentre.

    These are `low` and `high` [km]; x (3,) and v (3,) are scratch.
    """
    r, u, w = tracklets.r_km[k], tracklets.u[k], tracklets.w[k]
    radius, up = 0.5 * (low + high), dot(r, u)
    nearest2 = dot(r, r) - up * up  # square of the line's least distance
    if high * high < nearest2:
        return False
    half = np.sqrt(max(radius * radius - nearest2, 0.0))
    # Half the way of the line between both distances.
    way = 0.5 * (np.sqrt(high * high - nearest2) - np.sqrt(max(low * low - nearest2, 0.0)))
    along = dot(tracklets.v_km_s[k], u)
    sigma = np.sqrt(tracklets.cov[k, 2, 2] + tracklets.cov[k, 3, 3])
    for side in range(2):
        rho = -up + (half if side else -half)
        if rho < -way:
            continue
        rho = max(rho, 1.0)
        for m in range(3):
            x[m] = r[m] + rho * u[m]
            v[m] = tracklets.v_km_s[k, m] - along * u[m] + rho * w[m]
        off = _off_circle(dot(v, v), dot(x, v), dot(x, u), radius)
        uncertain = np.sqrt(dot(w, w)) * way + 3.0 * sigma * rho
        if off < NEARLY_CIRCULAR + uncertain / np.sqrt(GM_KM3_S2 / radius):
            return True
    return False


@kernel
def at_heights(tracklets, edges, out):
    """Write to `out` (h, n), bool, which tracklets may be nearly circular at each height.

    `edges` (h + 1,) are the edges of the heights: distances from the geocentre [km].
    """
    x, v = np.empty(3), np.empty(3)
    for h in range(len(out)):
        for k in range(out.shape[1]):
            out[h, k] = _may_move_at(tracklets, k, edges[h], edges[h + 1], x, v)


@borrowing_kernel
def _predict(tracklets, i, j, a, q, dt, off, out):
    """Write the residuals at tracklet j of an orbit through tracklet i: out (10,).

    The orbit has the range a [km] and range rate q [km/s] at i. `off` (2, 3) is what J2 adds to the
    position and the velocity. `out`: distance from the line of sight, east and north [km]; the same
    of the velocity, with the rates [km/s]; relative position and velocity.

    Returns the range at j [km], negative if it is behind the sensor, and Lagrange's g [s] and its
    derivative.
    """
    d, s = out[4:7], out[7:10]
    for m in range(3):
        d[m] = tracklets.r_km[i, m] + a * tracklets.u[i, m]
        s[m] = tracklets.v_km_s[i, m] + a * tracklets.w[i, m] + q * tracklets.u[i, m]
    f, g, gdot = lagrange(d, s, dt)
    fdot = (f * gdot - 1.0) / g
    for m in range(3):
        x, v = d[m], s[m]
        d[m] = f * x + g * v + off[0, m] - tracklets.r_km[j, m]
        s[m] = fdot * x + gdot * v + off[1, m] - tracklets.v_km_s[j, m]
    b = np.sqrt(dot(d, d))
    for c in range(2):
        axis = tracklets.east[j] if c == 0 else tracklets.north[j]
        out[c] = dot(axis, d)
        out[2 + c] = dot(axis, s) - b * dot(axis, tracklets.w[j])
    return (b if dot(d, tracklets.u[j]) > MIN_COSINE * b else -1.0), g, gdot


@borrowing_kernel
def _oblate(tracklets, i, j, a, q, dt, there, off, y, steps):
    """Write to `off` (2, 3) what J2 adds to the motion, over two bodies' in `there` (10,).

    Position [km] and velocity [km/s], GCRF, `dt` [s] after the epoch of tracklet i; `there` is
    `out` of `_predict`. y (6,) and `steps` (5, 42) are scratch.
    """
    for m in range(3):
        y[m] = tracklets.r_km[i, m] + a * tracklets.u[i, m]
        y[3 + m] = tracklets.v_km_s[i, m] + a * tracklets.w[i, m] + q * tracklets.u[i, m]
    advance(y, dt, STEP_S, steps)
    for m in range(3):
        off[0, m] = y[m] - there[4 + m] - tracklets.r_km[j, m]
        off[1, m] = y[3 + m] - there[7 + m] - tracklets.v_km_s[j, m]


@borrowing_kernel
def _step(tracklets, i, j, a, b, g, gdot, model_km, model_km_s, predicted):
    """Return Newton's step of range and range rate, and chi-square after it, of 2 degrees.

    `predicted` (3, 10): with the range and the range rate, with 1 km more, with 1 m/s more.
    """
    e, of_a, of_q = predicted[0], predicted[1], predicted[2]
    near, far = tracklets.cov[i], tracklets.cov[j]
    common = tracklets.position_km[i] ** 2 + tracklets.position_km[j] ** 2
    common += 0.5 * (near[0, 0] + near[1, 1]) * a * a
    of_rate = 0.5 * (near[2, 2] + near[3, 3]) * a * a
    aa = aq = qq = to_a = to_q = square = 0.0
    for c in range(4):
        if c < 2:
            variance = common + g * g * of_rate + b * b * far[c, c] + model_km**2
        else:
            variance = gdot * gdot * of_rate + b * b * far[c, c] + model_km_s**2
        by_a, by_q, weight = of_a[c] - e[c], 1e3 * (of_q[c] - e[c]), 1.0 / variance
        aa += weight * by_a * by_a
        aq += weight * by_a * by_q
        qq += weight * by_q * by_q
        to_a -= weight * by_a * e[c]
        to_q -= weight * by_q * e[c]
        square += weight * e[c] * e[c]
    det = aa * qq - aq * aq
    if not det > 1e-12 * aa * qq:
        return 0.0, 0.0, np.inf
    da, dq = (qq * to_a - aq * to_q) / det, (aa * to_q - aq * to_a) / det
    return da, dq, square - da * to_a - dq * to_q


@borrowing_kernel
def _refine(tracklets, i, j, a, q, n, work):
    """Refine range [km] and range rate [km/s] at tracklet i; return them, and chi-square.

    inf where no orbit leads to tracklet j. n: mean motion [rad/s]. `work`: scratch (3, 10), (2, 3),
    (6,) and (5, 42), as `predicted`, `off`, `y` and `steps`.
    """
    dt = tracklets.time_s[j] - tracklets.time_s[i]
    predicted, off, y, steps = work
    off[:] = 0.0
    chi2 = np.inf
    for step in range(len(STEPS_KM)):
        b, g, gdot = _predict(tracklets, i, j, a, q, dt, off, predicted[0])
        if b < 0.0:
            return a, q, np.inf
        if step == OBLATE_STEP:
            _oblate(tracklets, i, j, a, q, dt, predicted[0], off, y, steps)
            b, g, gdot = _predict(tracklets, i, j, a, q, dt, off, predicted[0])
        _predict(tracklets, i, j, a + 1.0, q, dt, off, predicted[1])
        _predict(tracklets, i, j, a, q + 1e-3, dt, off, predicted[2])
        km = STEPS_KM[step]
        da, dq, chi2 = _step(tracklets, i, j, a, b, g, gdot, km, n * km, predicted)
        a, q = a + da, q + dq
        if not (chi2 < GATE and 0.1 < a < MAX_RANGE_KM):
            return a, q, np.inf
    return a, q, chi2


@borrowing_kernel
def _pair_at(tracklets, p, q, i, j, radius, n, state, work):
    """Find the orbit of two tracklets about a circular one; write it at i's epoch to `state` (6,).

    The state is in the GCRF [km, km/s]. p (26,), q (26,): their rows of `packed_tracklets`; n: mean
    motion [rad/s] at the `radius` [km]; `work` of `_refine`. Returns chi-square of 2 degrees of
    freedom, inf where no bound orbit in space is near.
    """
    dt = tracklets.time_s[j] - tracklets.time_s[i]
    f, g = np.cos(n * dt), np.sin(n * dt) / n
    a, b, chi2 = first_ranges(p, q, f, g, WAY_SHARE * radius * n * dt)
    if not (chi2 < FIRST_GATE and 0.1 < a < MAX_RANGE_KM and 0.1 < b < MAX_RANGE_KM):
        return np.inf
    rate = 0.0
    for m in range(3):
        x = tracklets.r_km[i, m] + a * tracklets.u[i, m]
        later = tracklets.r_km[j, m] + b * tracklets.u[j, m]
        rate += ((later - f * x) / g - tracklets.v_km_s[i, m]) * tracklets.u[i, m]
    a, rate, chi2 = _refine(tracklets, i, j, a, rate, n, work)
    if not chi2 < GATE:
        return np.inf
    for m in range(3):
        state[m] = tracklets.r_km[i, m] + a * tracklets.u[i, m]
        state[3 + m] = tracklets.v_km_s[i, m] + a * tracklets.w[i, m] + rate * tracklets.u[i, m]
    far = np.sqrt(dot(state[:3], state[:3]))
    if far < EARTH_RADIUS_KM + MIN_HEIGHT_KM or dot(state[3:], state[3:]) > 2.0 * GM_KM3_S2 / far:
        return np.inf
    return chi2


@kernel
def search_heights(tracklets, packed, group, possible, edges, max_gap_s, pairs, states):
    """Find pairs of tracklets that one orbit may explain, `MIN_GAP_S` to `max_gap_s` apart.

    Parameters
    ----------
    tracklets, packed
        `Tracklets`, and `packed_tracklets` of them.
    group : (n,) int
        Known objects, -1 for none.
    possible, edges : (h, n) bool, (h + 1,)
        As `at_heights` writes them, and their heights.
    max_gap_s : float
        Longest time between both; less where more than `MAX_LATER` tracklets follow.
    pairs, states : (m, 2), (m, 6), out
        The pairs, and an orbit of each at the earlier epoch. A pair is there once per height.

    Returns
    -------
    int
        Number of pairs. It may be larger than m: then the rest is not written.
    """
    work = np.empty((3, 10)), np.empty((2, 3)), np.empty(6), np.empty((5, 42))
    state, rows, count = np.empty(6), np.empty(len(group), np.int64), 0
    for h in range(len(possible)):
        radius, total = 0.5 * (edges[h] + edges[h + 1]), 0
        n = np.sqrt(GM_KM3_S2 / radius**3)
        for k in range(len(group)):
            if possible[h, k]:
                rows[total] = k
                total += 1
        for at in range(total):
            i = rows[at]
            for later in range(at + 1, total):
                j = rows[later]
                dt = tracklets.time_s[j] - tracklets.time_s[i]
                if dt > max_gap_s or j > i + MAX_LATER:
                    break
                if dt < MIN_GAP_S or (group[i] >= 0 and group[i] == group[j]):
                    continue
                chi2 = _pair_at(tracklets, packed[i], packed[j], i, j, radius, n, state, work)
                if not (chi2 < GATE and may_be_one(tracklets, i, j)):
                    continue
                count = add_pair(i, j, state, count, pairs, states)
    return count


def later_pairs(
    tracklets: Tracklets, packed: Array, group: Indices, max_gap_s: float
) -> tuple[Indices, Array]:
    """Return all pairs (p, 2) of `search_heights`, and their orbits (p, 6)."""
    edges = height_edges()
    possible = np.empty((len(edges) - 1, len(group)), np.bool_)
    at_heights(tracklets, edges, possible)
    return with_room(
        len(group),
        lambda *out: search_heights(tracklets, packed, group, possible, edges, max_gap_s, *out),
    )
