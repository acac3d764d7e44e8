"""Candidates: which tracklet of a sensor a hypothesis' points explain best."""

import numpy as np
from numba import njit

from epipole.tasks.algorithms.association.sight_lines import quantile


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
def best_of_sensor(views, chance, s, members, n, taken, X, P, seen_by, gate_sigma, least):
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
