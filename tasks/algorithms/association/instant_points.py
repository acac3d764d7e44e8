"""Points of a hypothesis: at every instant at which two tracklets are seen, one point."""

import numpy as np
from numba import njit

from epipole.tasks.algorithms.association.sight_lines import BEYOND, SLACK_SIGMA
from epipole.tasks.algorithms.association.visibility import EARTH_RADIUS_KM, blocked
from epipole.tasks.algorithms.triangulation import invert3

ITERATIONS = 6


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
def residual(views, i, m, x, e, W):
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
            rho = residual(views, i, m, x, e, W)
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
