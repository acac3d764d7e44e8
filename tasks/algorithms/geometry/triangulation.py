"""Triangulation: the one point that explains all lines of sight, by weighted least squares.

A view is a sensor's place, a direction and the direction's covariance, all at one epoch. The
residual is the angle between the direction and the point, on the direction's tangent plane.
"""

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.constants import SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.sky import tangent_basis
from epipole.tasks.algorithms.kernels import kernel

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

ITERATIONS = 12
CONVERGED = 1e-9  # of the range
LIGHT = SPEED_OF_LIGHT_KM_S


@kernel
def invert3(M, out):
    """Write the inverse of a symmetric 3x3 matrix; return its determinant (0: not done)."""
    a, b, c = M[0, 0], M[0, 1], M[0, 2]
    d, e, f = M[1, 1], M[1, 2], M[2, 2]
    m00, m01, m02 = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * m00 + b * m01 + c * m02
    if not det > 0.0:
        return 0.0
    out[0, 0], out[0, 1], out[0, 2] = m00 / det, m01 / det, m02 / det
    out[1, 1], out[1, 2] = (a * f - c * c) / det, (b * c - a * e) / det
    out[2, 2] = (a * d - b * b) / det
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]
    return det


@kernel
def start_point(use, r, u, x):
    """Write the point nearest to the lines in use (all alike); return false where parallel.

    The plain sum of squared distances in km: the start of the iteration only.
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
    det = invert3(N, inverse)
    # Two lines at angle t give det = n (n/2) ... sin^2 t; below 1e-6 rad nothing is left of it.
    if det < 1e-12 * n**3:
        return False
    for i in range(3):
        x[i] = inverse[i, 0] * rhs[0] + inverse[i, 1] * rhs[1] + inverse[i, 2] * rhs[2]
    return True


@kernel
def _residual(r, u, basis, shift, x, out):
    """Write a view's residual [rad] on its tangent plane; return the range [km]."""
    d0, d1, d2 = x[0] + shift[0] - r[0], x[1] + shift[1] - r[1], x[2] + shift[2] - r[2]
    rho = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    for a in range(2):
        out[a] = (basis[a, 0] * d0 + basis[a, 1] * d1 + basis[a, 2] * d2) / rho
    return rho


@kernel
def weight_of(cov, sigma_km, rho, out):
    """Write the inverse of a view's 2x2 covariance, the sensor's place included."""
    extra = (sigma_km / rho) ** 2
    a, b, c = cov[0, 0] + extra, cov[0, 1], cov[1, 1] + extra
    det = a * c - b * b
    out[0, 0], out[1, 1] = c / det, a / det
    out[0, 1] = out[1, 0] = -b / det


@kernel
def solve_point(use, r, u, basis, cov, sigma_km, velocity, x, P):
    """Solve one point over the views in `use`; x has its start and receives the point.

    `velocity` [km/s] of the object moves it between the emissions that the sensors see: the
    point is where it was at the mean emission. Returns chi-square, or NaN where it fails
    (parallel lines, a point behind a sensor).
    """
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
            for a in range(3):  # light of a farther sensor left earlier
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
        if invert3(N, P) == 0.0:
            return np.nan
        step2, size2 = 0.0, 0.0
        for i in range(3):
            step = P[i, 0] * rhs[0] + P[i, 1] * rhs[1] + P[i, 2] * rhs[2]
            x[i] += step
            step2 += step * step
            size2 += x[i] * x[i]
        if not step2 < 1e14:  # ran off to infinity: as good as parallel
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
def _worst(use, r, u, basis, cov, sigma_km, velocity, x, P):
    """Return the view with the largest normalised residual, and that residual squared.

    Normalised by the residual's own covariance C - J P J', smaller than the error's.
    """
    e, _W, shift = np.empty(2), np.empty((2, 2)), np.zeros(3)
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
        # With few views one direction of the residual carries no information: its variance is
        # nothing but rounding. The larger eigenvalue's direction is what can be judged.
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
def _solve_groups(
    offsets, r, u, basis, cov, sigma_km, velocity, reject2, x, P, chi2, used, mean_rho
):
    for g in range(len(offsets) - 1):
        lo, hi = offsets[g], offsets[g + 1]
        use = np.arange(lo, hi)
        chi2[g] = np.nan
        while len(use) >= 2:
            if not start_point(use, r, u, x[g]):
                break
            chi2[g] = solve_point(use, r, u, basis, cov, sigma_km, velocity[g], x[g], P[g])
            if len(use) < 3 or np.isnan(chi2[g]):
                break
            v, score = _worst(use, r, u, basis, cov, sigma_km, velocity[g], x[g], P[g])
            if score <= reject2:
                break
            use = use[use != v]
        for v in range(lo, hi):
            used[v] = False
        mean_rho[g] = 0.0
        for v in use:
            used[v] = not np.isnan(chi2[g])
            mean_rho[g] += np.sqrt(
                (x[g, 0] - r[v, 0]) ** 2 + (x[g, 1] - r[v, 1]) ** 2 + (x[g, 2] - r[v, 2]) ** 2
            ) / len(use)


def triangulate(
    offsets: Indices,
    r_gcrf_km: Array,
    u_icrs: Array,
    cov_rad2: Array,
    sigma_km: Array,
    velocity_km_s: Array,
    reject_sigma: float,
) -> tuple[Array, Array, Array, npt.NDArray[np.bool_], Array]:
    """Return the positions of objects from their lines of sight, and which of them served.

    Parameters
    ----------
    offsets : (g + 1,) int
        Group k has the views ``offsets[k]:offsets[k + 1]``.
    r_gcrf_km, u_icrs : (n, 3) float
        Sensor positions [km] and directions to the object without aberration, at one epoch.
    cov_rad2 : (n, 2, 2) float
        Covariance of the direction [rad^2] on `tangent_basis(u_icrs)`.
    sigma_km : (n,) float
        1-sigma error of the sensor's position an axis [km].
    velocity_km_s : (g, 3) float
        Velocity of each object; it matters only over the differences of light time.
    reject_sigma
        A view further off than this, of three or more, is left out, the worst first.

    Returns
    -------
    r_km : (g, 3) float
        Positions [km] at the epoch minus the mean light time of the views used; NaN where the
        lines are parallel, meet behind a sensor, or fewer than two are left.
    cov_km2 : (g, 3, 3) float
        Covariances.
    chi2 : (g,) float
        Weighted sums of squares, 2 n - 3 degrees of freedom.
    used : (n,) bool
        Views that served.
    mean_range_km : (g,) float
        Mean distance of the sensors used.

    References
    ----------
    Gauss-Newton on the angular residuals; Hartley and Sturm (1997), Triangulation, CVIU 68(2),
    for why angles and not distances are to be made small.
    """
    n, g = len(r_gcrf_km), len(offsets) - 1
    x, P = np.full((g, 3), np.nan), np.full((g, 3, 3), np.nan)
    chi2, used, mean_range = np.full(g, np.nan), np.zeros(n, np.bool_), np.full(g, np.nan)
    # Copies: to numba a read-only array is another type, and all would compile twice.
    _solve_groups(
        np.array(offsets, np.int64),
        np.array(r_gcrf_km, float, order="C"),
        np.array(u_icrs, float, order="C"),
        np.array(tangent_basis(u_icrs), order="C"),
        np.array(cov_rad2, float, order="C"),
        np.array(sigma_km, float, order="C"),
        np.array(velocity_km_s, float, order="C"),
        float(reject_sigma) ** 2,
        x,
        P,
        chi2,
        used,
        mean_range,
    )
    failed = np.isnan(chi2)
    x[failed], P[failed] = np.nan, np.nan
    return x, P, chi2, used, mean_range
