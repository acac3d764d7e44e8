"""Hypotheses: tracklets that may be one object, their points, and how likely that is.

Everything is compiled and works on `Views`. A hypothesis is a list of tracklets; at every
instant at which two of them are seen, their lines of sight give one point.
"""

import numpy as np
from numba import njit

from epipole.tasks.algorithms.triangulation import invert3

EARTH_RADIUS_KM = 6378.137
BEYOND = 0.2  # share of the farthest distance
SLACK_SIGMA = 3.0  # a point may lie this far outside where objects can be
INSIDE = 0.98  # of the half field: nearer to the edge a sensor may well miss an object
FEW = 3  # sensors that must have looked before a hypothesis is given up
SPEAKS = 2.0  # log-odds at which a view of a well-known point is clearly of the object
CONTESTED = 3.0  # log-odds by which the best view of a sensor must lead the next one
REVIEWS = 2  # the first may still rest on a stray
ENOUGH = 4  # views that fix a point well enough to choose them all again
GIVEN_UP = -4.0  # log-odds of the sensors beside the seed's at which it is
ITERATIONS = 6


@njit(cache=True, nogil=True)
def quantile(dof, sigma):
    """Return the chi-square with `dof` degrees of freedom that is as rare as `sigma`.

    Wilson and Hilferty (1931): its cube root is close to normal.
    """
    a = 2.0 / (9.0 * dof)
    return dof * (1.0 - a + sigma * np.sqrt(a)) ** 3


@njit(cache=True, nogil=True)
def blocked(r, x, radius):
    """Return whether the Earth stands between r and x."""
    dot, length2, r2 = 0.0, 0.0, 0.0
    for a in range(3):
        d = x[a] - r[a]
        dot += r[a] * d
        length2 += d * d
        r2 += r[a] * r[a]
    return dot < 0.0 and -dot < length2 and r2 - dot * dot / length2 < radius * radius


@njit(cache=True, nogil=True)
def pair_miss(views, i, j, m, lowest, farthest):
    """Return the squared miss of two lines of sight over its variance; NaN where impossible.

    Impossible: parallel, meeting behind a sensor, or not, by 3 sigma of the range, between the
    lowest and the farthest place of an object.
    """
    ui, uj = views.u[i, m], views.u[j, m]
    ri, rj = views.r_km[views.sensor[i], m], views.r_km[views.sensor[j], m]
    n0 = ui[1] * uj[2] - ui[2] * uj[1]
    n1 = ui[2] * uj[0] - ui[0] * uj[2]
    n2 = ui[0] * uj[1] - ui[1] * uj[0]
    sine2 = n0 * n0 + n1 * n1 + n2 * n2
    if sine2 < 1e-14:  # 0.02 arcsec: parallel for any sensor
        return np.nan
    b0, b1, b2 = rj[0] - ri[0], rj[1] - ri[1], rj[2] - ri[2]
    along_i = b0 * ui[0] + b1 * ui[1] + b2 * ui[2]
    along_j = b0 * uj[0] + b1 * uj[1] + b2 * uj[2]
    cosine = ui[0] * uj[0] + ui[1] * uj[1] + ui[2] * uj[2]
    range_i = (along_i - cosine * along_j) / sine2
    range_j = (cosine * along_i - along_j) / sine2
    if range_i <= 0.0 or range_j <= 0.0:
        return np.nan
    sine = np.sqrt(sine2)
    ci, cj = views.cov[i, m], views.cov[j, m]
    radius2 = 0.0
    for a in range(3):
        radius2 += (ri[a] + range_i * ui[a]) ** 2
    si, sj = views.sigma_km[i, m], views.sigma_km[j, m]
    spread = range_i * range_i * (ci[0, 0] + ci[1, 1]) + range_j * range_j * (cj[0, 0] + cj[1, 1])
    slack = SLACK_SIGMA * np.sqrt(spread + 2 * (si * si + sj * sj)) / sine
    radius = np.sqrt(radius2)
    if radius + slack < lowest or radius - min(slack, BEYOND * farthest) > farthest:
        return np.nan
    variance = si * si + sj * sj
    bi, bj = views.basis[i, m], views.basis[j, m]
    p0 = (bi[0, 0] * n0 + bi[0, 1] * n1 + bi[0, 2] * n2) / sine * range_i
    p1 = (bi[1, 0] * n0 + bi[1, 1] * n1 + bi[1, 2] * n2) / sine * range_i
    q0 = (bj[0, 0] * n0 + bj[0, 1] * n1 + bj[0, 2] * n2) / sine * range_j
    q1 = (bj[1, 0] * n0 + bj[1, 1] * n1 + bj[1, 2] * n2) / sine * range_j
    variance += p0 * p0 * ci[0, 0] + 2 * p0 * p1 * ci[0, 1] + p1 * p1 * ci[1, 1]
    variance += q0 * q0 * cj[0, 0] + 2 * q0 * q1 * cj[0, 1] + q1 * q1 * cj[1, 1]
    miss = (b0 * n0 + b1 * n1 + b2 * n2) / sine
    return miss * miss / variance


@njit(cache=True, nogil=True)
def _start(views, members, n, m, x):
    """Write the point nearest to the members' lines; false where they are parallel."""
    N, inverse, rhs = np.zeros((3, 3)), np.empty((3, 3)), np.zeros(3)
    count = 0
    for q in range(n):
        i = members[q]
        if not views.seen[i, m]:
            continue
        count += 1
        r = views.r_km[views.sensor[i], m]
        for a in range(3):
            for b in range(3):
                p = (1.0 if a == b else 0.0) - views.u[i, m, a] * views.u[i, m, b]
                N[a, b] += p
                rhs[a] += p * r[b]
    if invert3(N, inverse) < 1e-12 * count**3:
        return False
    for a in range(3):
        x[a] = inverse[a, 0] * rhs[0] + inverse[a, 1] * rhs[1] + inverse[a, 2] * rhs[2]
    return True


@njit(cache=True, nogil=True)
def _residual(views, i, m, x, e, W):
    """Write a view's residual [rad] and its weight; return the range, or 0 behind the sensor."""
    r = views.r_km[views.sensor[i], m]
    d0, d1, d2 = x[0] - r[0], x[1] - r[1], x[2] - r[2]
    u, basis, cov = views.u[i, m], views.basis[i, m], views.cov[i, m]
    if d0 * u[0] + d1 * u[1] + d2 * u[2] <= 0.0:
        return 0.0
    rho = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    e[0] = (basis[0, 0] * d0 + basis[0, 1] * d1 + basis[0, 2] * d2) / rho
    e[1] = (basis[1, 0] * d0 + basis[1, 1] * d1 + basis[1, 2] * d2) / rho
    extra = (views.sigma_km[i, m] / rho) ** 2
    c00, c01, c11 = cov[0, 0] + extra, cov[0, 1], cov[1, 1] + extra
    det = c00 * c11 - c01 * c01
    W[0], W[1], W[2] = c11 / det, -c01 / det, c00 / det
    return rho


@njit(cache=True, nogil=True)
def solve_instant(views, members, n, m, x, P):
    """Solve one instant's point; x has its start. Return chi-square, NaN where it fails."""
    N, rhs, e, W = np.empty((3, 3)), np.empty(3), np.empty(2), np.empty(3)
    chi2 = np.nan
    for _ in range(ITERATIONS):
        N[:] = 0.0
        rhs[:] = 0.0
        chi2 = 0.0
        for q in range(n):
            i = members[q]
            if not views.seen[i, m]:
                continue
            rho = _residual(views, i, m, x, e, W)
            if rho == 0.0:
                return np.nan
            basis = views.basis[i, m]
            g0, g1 = W[0] * e[0] + W[1] * e[1], W[1] * e[0] + W[2] * e[1]
            chi2 += e[0] * g0 + e[1] * g1
            for a in range(3):
                rhs[a] -= (basis[0, a] * g0 + basis[1, a] * g1) / rho
                h0 = (W[0] * basis[0, a] + W[1] * basis[1, a]) / (rho * rho)
                h1 = (W[1] * basis[0, a] + W[2] * basis[1, a]) / (rho * rho)
                for b in range(a, 3):
                    N[a, b] += h0 * basis[0, b] + h1 * basis[1, b]
        N[1, 0], N[2, 0], N[2, 1] = N[0, 1], N[0, 2], N[1, 2]
        if invert3(N, P) == 0.0:
            return np.nan
        gain = 0.0
        for a in range(3):
            step = P[a, 0] * rhs[0] + P[a, 1] * rhs[1] + P[a, 2] * rhs[2]
            x[a] += step
            gain += step * rhs[a]
        if not gain < 1e12:  # ran off to infinity: as good as parallel
            return np.nan
        if gain < 1e-6:  # sigmas squared: nothing that matters is left
            return chi2 - gain
    return chi2


@njit(cache=True, nogil=True)
def solve(views, members, n, X, P, seen_by):
    """Solve every instant at which two members are seen; return chi-square and freedom.

    Where `seen_by` tells that an instant was solved before, its point is the start. NaN where
    an instant has no solution.
    """
    total, dof = 0.0, 0
    for m in range(len(views.time_s)):
        count = 0
        for q in range(n):
            count += views.seen[members[q], m]
        solved = seen_by[m] >= 2
        seen_by[m] = count
        if count < 2:
            continue
        if not solved and not _start(views, members, n, m, X[m]):
            return np.nan, 0
        chi2 = solve_instant(views, members, n, m, X[m], P[m])
        if np.isnan(chi2):
            return np.nan, 0
        total += chi2
        dof += 2 * count - 3
    return total, dof


@njit(cache=True, nogil=True)
def possible(views, members, n, X, P, seen_by, lowest, farthest):
    """Return whether the points lie, within 3 sigma, where their sensors can see an object."""
    for m in range(len(views.time_s)):
        if seen_by[m] < 2:
            continue
        radius = np.sqrt(X[m, 0] ** 2 + X[m, 1] ** 2 + X[m, 2] ** 2)
        slack = SLACK_SIGMA * np.sqrt(P[m, 0, 0] + P[m, 1, 1] + P[m, 2, 2])
        # However badly a range is known: far outside, no object is looked for.
        if radius + slack < lowest or radius - min(slack, BEYOND * farthest) > farthest:
            return False
        for q in range(n):
            i = members[q]
            if views.seen[i, m] and blocked(
                views.r_km[views.sensor[i], m], X[m], EARTH_RADIUS_KM - slack
            ):
                return False
    return True


@njit(cache=True, nogil=True)
def fit(views, chance, c, X, P, seen_by):
    """Return what tracklet c adds to the odds, its chi-square, and how many instants it shares.

    The log of how much likelier the points make its directions than chance does; see `score`.
    """
    gain, total, n, begun_at = 0.0, 0.0, 0, 0.0
    s = views.sensor[c]
    for m in range(len(views.time_s)):
        if seen_by[m] < 2 or not views.seen[c, m]:
            continue
        r = views.r_km[s, m]
        basis, u, cov = views.basis[c, m], views.u[c, m], views.cov[c, m]
        d0, d1, d2 = X[m, 0] - r[0], X[m, 1] - r[1], X[m, 2] - r[2]
        if d0 * u[0] + d1 * u[1] + d2 * u[2] <= 0.0:
            return -np.inf, np.inf, 0
        rho2 = d0 * d0 + d1 * d1 + d2 * d2
        rho = np.sqrt(rho2)
        e0 = (basis[0, 0] * d0 + basis[0, 1] * d1 + basis[0, 2] * d2) / rho
        e1 = (basis[1, 0] * d0 + basis[1, 1] * d1 + basis[1, 2] * d2) / rho
        extra = views.sigma_km[c, m] ** 2 / rho2
        h00, h01, h11 = _image_error(basis, P[m], rho2)
        c00, c01, c11 = cov[0, 0] + extra + h00, cov[0, 1] + h01, cov[1, 1] + extra + h11
        det = c00 * c11 - c01 * c01
        chi2 = (e0 * e0 * c11 - 2 * e0 * e1 * c01 + e1 * e1 * c00) / det
        spot = 2 * np.pi * np.sqrt(det)
        if n == 0:
            gain += np.log(chance.detected / (chance.density[s] * spot)) - 0.5 * chi2
            begun_at = views.time_s[m]
        else:
            room = np.pi * (chance.spread[s] * (views.time_s[m] - begun_at)) ** 2
            gain += np.log1p(room / spot) - 0.5 * chi2
        total += chi2
        n += 1
    return gain, total, n


@njit(cache=True, nogil=True)
def _best_of_sensor(views, chance, s, members, n, taken, X, P, seen_by, gate_sigma, least):
    """Return the free tracklet of sensor s that adds most to the odds, how much, and the next.

    -1 where there is none; the last is what the second best adds, `least` without one.

    One that adds less than `least` is not taken. At each instant only the grid cells
    that the gate touches are looked at; a tracklet is weighed once, at the first instant that
    it shares with the points.
    """
    best, best_gain, second = -1, least, least
    for m in range(len(views.time_s)):
        side = views.grid[s, m, 1]
        if seen_by[m] < 2 or side == 0:
            continue
        r, plane = views.r_km[s, m], views.plane[s, m]
        d0, d1, d2 = X[m, 0] - r[0], X[m, 1] - r[1], X[m, 2] - r[2]
        depth = plane[2, 0] * d0 + plane[2, 1] * d1 + plane[2, 2] * d2
        if depth <= 0.0:
            continue
        a0 = (plane[0, 0] * d0 + plane[0, 1] * d1 + plane[0, 2] * d2) / depth
        a1 = (plane[1, 0] * d0 + plane[1, 1] * d1 + plane[1, 2] * d2) / depth
        rho2 = d0 * d0 + d1 * d1 + d2 * d2
        h00, _, h11 = _image_error(plane, P[m], rho2)
        own = views.widest[s, m] + views.sigma_km[views.first[s], m] ** 2 / rho2
        # The gnomonic plane stretches away from its middle.
        reach = np.sqrt(quantile(2, gate_sigma)) * (1.0 + a0 * a0 + a1 * a1)
        reach0, reach1 = reach * np.sqrt(h00 + own), reach * np.sqrt(h11 + own)
        low, scale = views.corner[s, m], views.cells_per_unit[s, m]
        lo0 = max(int(np.floor((a0 - reach0 - low[0]) * scale[0])), 0)
        hi0 = min(int(np.floor((a0 + reach0 - low[0]) * scale[0])), side - 1)
        lo1 = max(int(np.floor((a1 - reach1 - low[1]) * scale[1])), 0)
        hi1 = min(int(np.floor((a1 + reach1 - low[1]) * scale[1])), side - 1)
        if hi1 < lo1:
            continue
        for g0 in range(lo0, hi0 + 1):
            row = views.grid[s, m, 0] + g0 * side
            for k in range(views.cell_start[row + lo1], views.cell_start[row + hi1 + 1]):
                c = views.cell_item[k]
                if taken[c] or _shared_before(views, c, m, seen_by):
                    continue
                gain, chi2, shared = fit(views, chance, c, X, P, seen_by)
                fits = gain > second and chi2 <= quantile(2 * shared, gate_sigma)
                if fits and not _clashes(views, c, members, n):
                    if gain > best_gain:
                        best, best_gain, second = c, gain, best_gain
                    else:
                        second = gain
    return best, best_gain, second


@njit(cache=True, nogil=True)
def _image_error(plane, P, rho2):
    """Return the point's covariance on two axes across the sight, as angles squared."""
    h00, h01, h11 = 0.0, 0.0, 0.0
    for a in range(3):
        p0 = P[a, 0] * plane[0, 0] + P[a, 1] * plane[0, 1] + P[a, 2] * plane[0, 2]
        p1 = P[a, 0] * plane[1, 0] + P[a, 1] * plane[1, 1] + P[a, 2] * plane[1, 2]
        h00 += plane[0, a] * p0
        h01 += plane[0, a] * p1
        h11 += plane[1, a] * p1
    return h00 / rho2, h01 / rho2, h11 / rho2


@njit(cache=True, nogil=True)
def _shared_before(views, c, m, seen_by):
    for earlier in range(m):
        if (
            seen_by[earlier] >= 2
            and views.seen[c, earlier]
            and (views.grid[views.sensor[c], earlier, 1] > 0)
        ):
            return True
    return False


@njit(cache=True, nogil=True)
def _clashes(views, c, members, n):
    """Return whether a member is c, or of the same sensor at the same time."""
    for q in range(n):
        o = members[q]
        if o == c:
            return True
        if views.sensor[o] == views.sensor[c] and (
            views.start_s[c] <= views.end_s[o] and views.start_s[o] <= views.end_s[c]
        ):
            return True
    return False


@njit(cache=True, nogil=True)
def _holds(members, n, c):
    return (members[:n] == c).any()


@njit(cache=True, nogil=True)
def sees(r, R, half_field, x):
    """Return whether a sensor at r has x in its field, not at the edge, the Earth not between.

    False where the sensor's place or attitude is unknown (NaN).
    """
    d0, d1, d2 = x[0] - r[0], x[1] - r[1], x[2] - r[2]
    depth = R[2, 0] * d0 + R[2, 1] * d1 + R[2, 2] * d2
    if not depth > 0.0:
        return False
    for a in range(2):
        side = (R[a, 0] * d0 + R[a, 1] * d1 + R[a, 2] * d2) / depth
        if abs(side) > INSIDE * half_field[a]:
            return False
    return not blocked(r, x, EARTH_RADIUS_KM)


@njit(cache=True, nogil=True)
def looks_at(views, s, X, seen_by):
    """Return whether sensor s has the point in its field at every solved instant."""
    looked = False
    for m in range(len(views.time_s)):
        if seen_by[m] < 2:
            continue
        if not sees(views.r_km[s, m], views.attitude[s, m], views.half_field[s], X[m]):
            return False
        looked = True
    return looked


@njit(cache=True, nogil=True)
def _det3(M):
    return (
        M[0, 0] * (M[1, 1] * M[2, 2] - M[1, 2] * M[2, 1])
        - M[0, 1] * (M[1, 0] * M[2, 2] - M[1, 2] * M[2, 0])
        + M[0, 2] * (M[1, 0] * M[2, 1] - M[1, 1] * M[2, 0])
    )


@njit(cache=True, nogil=True)
def score(views, chance, members, n, X, P, seen_by, chi2, shells):
    """Return the log of the odds "one object" against "unrelated tracklets".

    At the first instant a stray lies anywhere in the field (`chance.density`) and an object
    anywhere in view (`chance.objects_km3`, weighed by altitude where `shells` say so). At a
    later one both are known to within how differently the tracklets of a sensor move: where
    all move alike, further instants say nothing new. A sensor that looks at the point and has
    nothing there counts against it.
    """
    total, begun, begun_at = -0.5 * chi2, False, 0.0
    for m in range(len(views.time_s)):
        if seen_by[m] < 2:
            continue
        dt = views.time_s[m] - begun_at
        widest, rho_mean = 0.0, 0.0
        for q in range(n):
            i = members[q]
            if not views.seen[i, m]:
                continue
            s, spot = views.sensor[i], views.spot[i, m]
            if begun:
                total += np.log1p(np.pi * (chance.spread[s] * dt) ** 2 / spot)
            else:
                total += np.log(chance.detected / (chance.density[s] * spot))
            widest = max(widest, chance.spread[s])
            rho2 = 0.0
            for a in range(3):
                rho2 += (X[m, a] - views.r_km[s, m, a]) ** 2
            rho_mean += np.sqrt(rho2) / seen_by[m]
        det_P = _det3(P[m])
        if begun:
            grown = P[m].copy()
            for a in range(3):
                grown[a, a] += (widest * dt * rho_mean) ** 2
            total += 0.5 * np.log(det_P / _det3(grown))
        else:
            total += 1.5 * np.log(2 * np.pi) + 0.5 * np.log(det_P) + np.log(chance.objects_km3)
            total += _altitude_weight(X[m], shells)
            begun, begun_at = True, views.time_s[m]
    return total + _absences(views, chance, members, n, X, seen_by)


@njit(cache=True, nogil=True)
def _absences(views, chance, members, n, X, seen_by):
    """Return the log-probability of the sensors that look at the point and see nothing."""
    total = 0.0
    served = np.zeros(len(views.half_field), np.bool_)
    for q in range(n):
        served[views.sensor[members[q]]] = True
    for s in range(len(served)):
        if not served[s] and looks_at(views, s, X, seen_by):
            total += np.log(1.0 - chance.detected)
    return total


@njit(cache=True, nogil=True)
def _altitude_weight(x, shells):
    """Return the log of how much likelier objects are at this height than on average.

    `shells` are rows of (lowest, highest radius [km], weight), which add up; none: all heights
    are alike.
    """
    if len(shells) == 0:
        return 0.0
    radius, weight = np.sqrt(x[0] ** 2 + x[1] ** 2 + x[2] ** 2), 1e-9
    for k in range(len(shells)):
        if shells[k, 0] <= radius < shells[k, 1]:
            weight += shells[k, 2]
    return np.log(weight)


@njit(cache=True, nogil=True)
def workspace(n_instants):
    """Return the arrays that `grow` works in, made once."""
    return np.zeros((n_instants, 3)), np.zeros((n_instants, 3, 3)), np.zeros(n_instants, np.int64)


@njit(cache=True, nogil=True)
def grow(
    views, chance, seed_i, seed_j, taken, lowest, farthest, gate_sigma, shells, members, work
):  # fmt: skip
    """Grow two tracklets into a hypothesis; return its size and score, 0 where it fails.

    Sensor after sensor, the tracklet that adds most to the odds joins. A sensor that looks and
    has none counts against the hypothesis, which is given up as soon as its other sensors speak
    clearly against it (Wald's sequential test). The points are solved again as the hypothesis
    doubles, and at the end, when a member that no longer fits goes.
    """
    X, P, seen_by = work
    n_sensors = len(views.half_field)
    seen_by[:] = 0
    members[0], members[1] = seed_i, seed_j
    n, again = np.int64(2), 3  # a plain 2 is a type of its own to numba: all would compile twice
    chi2, dof = solve(views, members, n, X, P, seen_by)
    if not chi2 <= quantile(max(dof, 1), gate_sigma):
        return 0, -np.inf
    if not possible(views, members, n, X, P, seen_by, lowest, farthest):
        return 0, -np.inf
    a, b = views.sensor[seed_i], views.sensor[seed_j]
    evidence, looked, absent = 0.0, 0, np.log(1.0 - chance.detected)
    for turn in range(n_sensors + 2):
        # The seed's own sensors come last: they may hold another fragment of the object.
        s = (a + turn) % n_sensors
        if turn >= n_sensors:
            s = a if turn == n_sensors else b
        elif s in (a, b):
            continue
        found = False
        while True:
            c, gain, _ = _best_of_sensor(
                views, chance, s, members, n, taken, X, P, seen_by, gate_sigma, absent
            )
            if c < 0:
                break
            found = True
            evidence += gain
            members[n] = c
            n += 1
            if n >= again:
                n, chi2 = _settle(views, members, n, X, P, seen_by, gate_sigma)
                again = n + max(n // 2, 1)
                if n < 2:
                    return 0, -np.inf
            # A sensor has one tracklet of an object at a time; one that was let go again would
            # only come back.
            if len(views.time_s) == 1 or not _holds(members, n, c):
                break
        if turn < n_sensors:
            looks = found or looks_at(views, s, X, seen_by)
            looked += looks
            if looks and not found:
                evidence += absent
            if looked >= FEW and evidence < GIVEN_UP:
                return 0, -np.inf
    n, chi2 = _settle(views, members, n, X, P, seen_by, gate_sigma)
    for _ in range(REVIEWS):
        if n >= ENOUGH:
            n = _review(views, chance, members, n, taken, X, P, seen_by, gate_sigma)
            n, chi2 = _settle(views, members, n, X, P, seen_by, gate_sigma)
    if n < 2 or not possible(views, members, n, X, P, seen_by, lowest, farthest):
        return 0, -np.inf
    return n, score(views, chance, members, n, X, P, seen_by, chi2, shells)


@njit(cache=True, nogil=True)
def _review(views, chance, members, n, taken, X, P, seen_by, gate_sigma):
    """Choose every sensor's tracklet again, now that the points are well known.

    The first members were chosen by points that two or three views gave. A stray does more harm
    than an absence: what does not speak for the object by itself stays out, and so does a
    sensor in which two tracklets do about equally. Returns the size.
    """
    before = members[:n].copy()
    n = 0
    for s in range(len(views.half_field)):
        while n < len(members):
            c, gain, second = _best_of_sensor(
                views, chance, s, members, n, taken, X, P, seen_by, gate_sigma, SPEAKS
            )
            if c < 0 or (second > SPEAKS and gain - second < CONTESTED):
                break
            members[n] = c
            n += 1
            if len(views.time_s) == 1:
                break
    if n < ENOUGH - 1:
        n = len(before)
        members[:n] = before
    return n


@njit(cache=True, nogil=True)
def grow_all(
    views, chance, seeds, taken, lowest, farthest, gate_sigma, shells, least, sizes, scores, grown
):  # fmt: skip
    """Grow every seed; write sizes (0: fails, or scores below `least`), scores and members."""
    work = workspace(len(views.time_s))
    members = np.empty(len(views.sensor) + 2, np.int64)
    for q in range(len(seeds)):
        n, value = grow(
            views, chance, seeds[q, 0], seeds[q, 1], taken, lowest, farthest, gate_sigma, shells,
            members, work,
        )  # fmt: skip
        sizes[q], scores[q] = min(n, grown.shape[1]) if value > least else 0, value
        for k in range(sizes[q]):
            grown[q, k] = members[k]


@njit(cache=True, nogil=True)
def _settle(views, members, n, X, P, seen_by, gate_sigma):
    """Solve, and let go the member that fits worst until all fit; return size and chi-square.

    The seed is not spared. 0 members where fewer than two of them fit.
    """
    e, W = np.empty(2), np.empty(3)
    while n >= 2:
        chi2, dof = solve(views, members, n, X, P, seen_by)
        if dof > 0 and chi2 <= quantile(dof, gate_sigma):
            return n, chi2
        if n == 2:
            break
        worst, largest = 0, -1.0
        for q in range(n):
            own, shared = 0.0, 1e-9
            for m in range(len(views.time_s)):
                if seen_by[m] < 2 or not views.seen[members[q], m]:
                    continue
                if _residual(views, members[q], m, X[m], e, W) == 0.0:
                    own = np.inf
                own += W[0] * e[0] ** 2 + 2 * W[1] * e[0] * e[1] + W[2] * e[1] ** 2
                shared += 1
            if own / shared > largest:
                worst, largest = q, own / shared
        for q in range(worst, n - 1):
            members[q] = members[q + 1]
        n -= 1
        seen_by[:] = 0
    return 0, np.inf
