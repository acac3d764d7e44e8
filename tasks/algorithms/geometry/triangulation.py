"""Triangulation: the point that fits all lines of sight best, by weighted least squares.

A view is a sensor's position, a direction and the direction's covariance, all at one epoch. The
residual is the angle between the direction and the point, on the direction's tangent plane.
"""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.tasks.algorithms.constants import SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.symmetric_matrices import invert_symmetric

ITERATIONS = 12
CONVERGED = 1e-9  # of the range
# Largest error of a position, over its range: with a larger one the lines are parallel within their
# errors. Two cameras of one satellite leave any range, and the covariance at the wrong one is too
# small: of such positions 50 % lie in their 99 % ellipsoid, and of those at this limit 95 %.
MAX_ERROR = 0.2
LIGHT = SPEED_OF_LIGHT_KM_S


class LinesOfSight(NamedTuple):
    """Views of all groups, one after the other, for kernels.

    r_km, u : (n, 3) float
        Sensor positions [km] and directions.
    basis, cov : (n, 2, 3), (n, 2, 2) float
        Tangent bases of the directions, and their covariances [rad^2] on these.
    sigma_km : (n,) float
        1-sigma errors of the positions, per axis [km].
    """

    r_km: Array
    u: Array
    basis: Array
    cov: Array
    sigma_km: Array


class Triangulated(NamedTuple):
    """Positions of g groups from n views.

    r_km : (g, 3) float
        Positions [km] at the epoch minus the mean light time of the used views; NaN if the lines
        are parallel within their errors or meet behind a sensor, or with fewer than two views.
    cov_km2 : (g, 3, 3) float
        Covariances of the positions.
    chi2 : (g,) float
        Weighted sums of squares, 2 n - 3 degrees of freedom.
    used : (n,) bool
        False for rejected views.
    mean_range_km : (g,) float
        Mean distance to the sensors of the used views.
    """

    r_km: Array
    cov_km2: Array
    chi2: Array
    used: Flags
    mean_range_km: Array


@kernel
def start_point(use, r, u, x):
    """Write the point nearest to the lines in `use` to x (3,) [km]; return false if parallel.

    `use` has rows of r (n, 3), sensor positions [km], and u (n, 3), directions. The sum of the
    squared distances is minimal, without weights: a start for the iteration.
    """
    N, inverse, rhs = np.zeros((3, 3)), np.empty((3, 3)), np.zeros(3)
    n = 0
    for v in use:
        n += 1
        for i in range(3):
            for j in range(3):
                p = (1.0 if i == j else 0.0) - u[v, i] * u[v, j]
                N[i, j] += p
                rhs[i] += p * r[v, j]
    det = invert_symmetric(N, inverse)
    # Two lines at an angle t give det = 2 sin^2 t: below some 2e-6 rad it is rounding.
    if det < 1e-12 * n**3:
        return False
    for i in range(3):
        x[i] = inverse[i, 0] * rhs[0] + inverse[i, 1] * rhs[1] + inverse[i, 2] * rhs[2]
    return True


@kernel
def _residual(r, u, basis, shift, x, out):
    """Write a view's residual on its tangent plane to out (2,) [rad]; return the range [km].

    r (3,) is the sensor [km], basis (2, 3) the tangent plane; the object is at x + shift (3,) [km].
    """
    d0, d1, d2 = x[0] + shift[0] - r[0], x[1] + shift[1] - r[1], x[2] + shift[2] - r[2]
    rho = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    for a in range(2):
        out[a] = (basis[a, 0] * d0 + basis[a, 1] * d1 + basis[a, 2] * d2) / rho
    return rho


@kernel
def weight_of(cov, sigma_km, rho, out):
    """Write the inverse covariance of a view to out (2, 2) [rad^-2].

    The covariance is cov (2, 2) [rad^2] plus that of the sensor's position, sigma_km over the range
    rho [km].
    """
    extra = (sigma_km / rho) ** 2
    a, b, c = cov[0, 0] + extra, cov[0, 1], cov[1, 1] + extra
    det = a * c - b * b
    out[0, 0], out[1, 1] = c / det, a / det
    out[0, 1] = out[1, 0] = -b / det


@kernel
def solve_point(use, lines, velocity, x, P):
    """Solve one point over the views in `use`, rows of `LinesOfSight`; return chi-square.

    x (3,) [km] has the start and then the point, P (3, 3) [km^2] its covariance. Light to a more
    distant sensor left earlier: the object moves by `velocity` (3,) [km/s] between the emissions,
    and the point is its position at their mean time. NaN if the lines are parallel or the point is
    behind a sensor.
    """
    r, u, basis, cov, sigma_km = lines
    N, rhs = np.empty((3, 3)), np.empty(3)
    e, W, shift = np.empty(2), np.empty((2, 2)), np.zeros(3)
    chi2 = np.nan
    for _ in range(ITERATIONS):
        mean_range = 0.0
        for v in use:
            mean_range += np.sqrt(
                (x[0] - r[v, 0]) ** 2 + (x[1] - r[v, 1]) ** 2 + (x[2] - r[v, 2]) ** 2
            ) / len(use)
        N[:] = 0.0
        rhs[:] = 0.0
        chi2 = 0.0
        for v in use:
            rho = np.sqrt((x[0] - r[v, 0]) ** 2 + (x[1] - r[v, 1]) ** 2 + (x[2] - r[v, 2]) ** 2)
            for a in range(3):  # light to a farther sensor left earlier
                shift[a] = velocity[a] * (mean_range - rho) / LIGHT
            rho = _residual(r[v], u[v], basis[v], shift, x, e)
            weight_of(cov[v], sigma_km[v], rho, W)
            for a in range(2):
                for b in range(2):
                    chi2 += e[a] * W[a, b] * e[b]
                    for i in range(3):
                        rhs[i] -= basis[v, a, i] / rho * W[a, b] * e[b]
                        for j in range(3):
                            N[i, j] += basis[v, a, i] * W[a, b] * basis[v, b, j] / (rho * rho)
        if invert_symmetric(N, P) == 0.0:
            return np.nan
        step2, size2 = 0.0, 0.0
        for i in range(3):
            step = P[i, 0] * rhs[0] + P[i, 1] * rhs[1] + P[i, 2] * rhs[2]
            x[i] += step
            step2 += step * step
            size2 += x[i] * x[i]
        if not step2 < 1e14:  # [km^2] diverges: the lines are nearly parallel
            return np.nan
        if step2 < CONVERGED * CONVERGED * size2:
            break
    for v in use:
        ahead = 0.0
        for a in range(3):
            ahead += u[v, a] * (x[a] - r[v, a])
        if ahead <= 0.0:
            return np.nan
    return chi2


@kernel
def _worst(use, lines, velocity, x, P):
    """Return the view with the largest normalised residual, and its square [sigma^2].

    It is normalised by the covariance of the residual, C - J P J', which is smaller than C. The
    views `use` (m,), the point `x` (3,) [km], its covariance `P` (3, 3) [km^2], and
    `velocity` (3,) [km/s] as in `solve_point`. The view is -1 if no residual can be tested.
    """
    r, u, basis, cov, sigma_km = lines
    e, shift = np.empty(2), np.zeros(3)
    mean_range = 0.0
    for v in use:
        mean_range += np.sqrt(
            (x[0] - r[v, 0]) ** 2 + (x[1] - r[v, 1]) ** 2 + (x[2] - r[v, 2]) ** 2
        ) / len(use)
    worst, largest = -1, 0.0
    for v in use:
        rho = np.sqrt((x[0] - r[v, 0]) ** 2 + (x[1] - r[v, 1]) ** 2 + (x[2] - r[v, 2]) ** 2)
        for a in range(3):
            shift[a] = velocity[a] * (mean_range - rho) / LIGHT
        rho = _residual(r[v], u[v], basis[v], shift, x, e)
        extra = (sigma_km[v] / rho) ** 2
        c00, c01, c11 = cov[v, 0, 0] + extra, cov[v, 0, 1], cov[v, 1, 1] + extra
        for i in range(3):
            for j in range(3):
                p = P[i, j] / (rho * rho)
                c00 -= basis[v, 0, i] * p * basis[v, 0, j]
                c01 -= basis[v, 0, i] * p * basis[v, 1, j]
                c11 -= basis[v, 1, i] * p * basis[v, 1, j]
        # With few views the residual has no information along one axis: its variance there is
        # rounding. The axis of the larger eigenvalue can always be tested.
        half, diff = 0.5 * (c00 + c11), 0.5 * (c00 - c11)
        radius = np.sqrt(diff * diff + c01 * c01)
        big, small = half + radius, half - radius
        angle = 0.5 * np.arctan2(c01, diff)
        along = e[0] * np.cos(angle) + e[1] * np.sin(angle)
        across = -e[0] * np.sin(angle) + e[1] * np.cos(angle)
        full = cov[v, 0, 0] + cov[v, 1, 1]
        score = along * along / big if big > 1e-6 * full else 0.0
        if small > 1e-3 * full:
            score += across * across / small
        if score > largest:
            worst, largest = v, score
    return worst, largest


@kernel
def _solve_groups(offsets, lines, velocity, reject2, out):
    """Triangulate each group; while the largest residual is above the limit, reject that view.

    offsets (g + 1,), `lines` are `LinesOfSight`, velocity (g, 3) [km/s]; `reject2` is the square of
    the limit [sigma^2]; `out` is `Triangulated`.
    """
    r, u = lines.r_km, lines.u
    x, P, chi2, used, mean_range = out
    for g in range(len(offsets) - 1):
        lo, hi = offsets[g], offsets[g + 1]
        use = np.arange(lo, hi)
        chi2[g] = np.nan
        while len(use) >= 2:
            if not start_point(use, r, u, x[g]):
                chi2[g] = np.nan  # the views that are left are parallel
                break
            chi2[g] = solve_point(use, lines, velocity[g], x[g], P[g])
            if len(use) < 3 or np.isnan(chi2[g]):
                break
            v, score = _worst(use, lines, velocity[g], x[g], P[g])
            if score <= reject2:
                break
            use = use[use != v]
        mean_range[g] = 0.0
        for v in use:
            mean_range[g] += np.sqrt(
                (x[g, 0] - r[v, 0]) ** 2 + (x[g, 1] - r[v, 1]) ** 2 + (x[g, 2] - r[v, 2]) ** 2
            ) / len(use)
        if not P[g, 0, 0] + P[g, 1, 1] + P[g, 2, 2] < (MAX_ERROR * mean_range[g]) ** 2:
            chi2[g] = np.nan  # parallel within their errors
        for v in range(lo, hi):
            used[v] = False
        for v in use:
            used[v] = not np.isnan(chi2[g])


def triangulate(
    offsets: Indices,
    r_gcrf_km: Array,
    u_icrs: Array,
    cov_rad2: Array,
    sigma_km: Array,
    velocity_km_s: Array,
    reject_sigma: float,
) -> Triangulated:
    """Return the positions of objects from their lines of sight, and which views were used.

    Parameters
    ----------
    offsets : (g + 1,) int
        Group k has the views ``offsets[k]:offsets[k + 1]``.
    r_gcrf_km, u_icrs : (n, 3) float
        Sensor positions [km] and directions to the object without aberration, at one epoch.
    cov_rad2 : (n, 2, 2) float
        Covariance of the direction [rad^2] on `tangent_basis(u_icrs)`.
    sigma_km : (n,) float
        1-sigma error of the sensor's position, per axis [km].
    velocity_km_s : (g, 3) float
        Velocity of each object. It matters only over the differences of light time.
    reject_sigma
        Limit of the normalised residual: with three or more views, larger ones are rejected, the
        largest first.

    References
    ----------
    Gauss-Newton on the angular residuals. Hartley and Sturm (1997), Triangulation, CVIU 68(2),
    for minimising errors in the image instead of distances in space.
    """
    n, g = len(r_gcrf_km), len(offsets) - 1
    # Copies: a read-only array is another type to numba, and all kernels would compile twice.
    lines = LinesOfSight(
        r_km=np.array(r_gcrf_km, float, order="C"),
        u=np.array(u_icrs, float, order="C"),
        basis=np.array(tangent_basis(u_icrs), order="C"),
        cov=np.array(cov_rad2, float, order="C"),
        sigma_km=np.array(sigma_km, float, order="C"),
    )
    out = Triangulated(
        r_km=np.full((g, 3), np.nan),
        cov_km2=np.full((g, 3, 3), np.nan),
        chi2=np.full(g, np.nan),
        used=np.zeros(n, np.bool_),
        mean_range_km=np.full(g, np.nan),
    )
    velocity = np.array(velocity_km_s, float, order="C")
    _solve_groups(np.array(offsets, np.int64), lines, velocity, float(reject_sigma) ** 2, out)
    failed = np.isnan(out.chi2)
    out.r_km[failed], out.cov_km2[failed] = np.nan, np.nan
    return out
