"""Covariances of directions: from the centroid, the attitude, and the optics.

Errors of centroids change from frame to frame. Those of the optics are the same in all frames of a
sensor: a bias. Wrong optics turn the attitude that fits a frame's stars best. Where the stars are,
attitude and optics then compensate each other, and the direction of an object there is nearly
right.
"""

import numpy as np

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.tasks.algorithms.geometry.camera import (
    Camera,
    ideal_position,
    project,
    slopes,
    unproject,
)
from epipole.tasks.algorithms.geometry.directions import skew, tangent_basis
from epipole.tasks.algorithms.kernels import kernel

MAX_LEVERAGE = 0.8  # a direction with more determines the fit: no residual is left
MAX_PRODUCT = 20.0  # [variances] a larger product of two residuals is of another object
MIN_RESIDUALS = 20  # minimum number: their variance is then known to a third
OPTICS = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3")
FRAMES_AT_ONCE = 500  # limits the memory: 27 derivatives per star
ALL_AT_ONCE = np.zeros(1, np.int64)  # all directions are of one frame
GRID = 9  # grid positions on each side of the image, for a frame's stars


def centroid_covariance(u_icrs: Array, sigma_rad: Array) -> Array:
    """Return (n, 3, 3) covariances of directions with the same error on both axes.

    Parameters
    ----------
    u_icrs : (n, 3) float
        Unit vectors.
    sigma_rad : (n,) float
        1-sigma error, per axis [rad].
    """
    out = np.empty((len(u_icrs), 3, 3))
    sigma = np.array(np.broadcast_to(sigma_rad, len(u_icrs)), float)
    _across(np.array(u_icrs, float, order="C"), sigma, out)
    return out


@kernel
def _across(u, sigma, out):
    """Write `centroid_covariance` of u (n, 3) and `sigma` (n,) [rad] to `out` (n, 3, 3)."""
    for i in range(len(u)):
        variance = sigma[i] * sigma[i]
        for a in range(3):
            for b in range(3):
                out[i, a, b] = -u[i, a] * u[i, b] * variance
            out[i, a, a] += variance


def attitude_covariance(u_icrs: Array, cov_icrs_rad2: Array) -> Array:
    """Return (n, 3, 3) covariances of directions due to attitude errors.

    Parameters
    ----------
    u_icrs : (n, 3) float
        Unit vectors.
    cov_icrs_rad2 : (n, 3, 3) float
        Covariance of the small rotation of their frame, about the axes of the ICRS [rad^2].

    Notes
    -----
    A small rotation phi moves a direction by phi x u; the sign of phi does not matter.
    """
    return in_components(skew(u_icrs), cov_icrs_rad2)


def on_tangent_plane(u_icrs: Array, cov: Array) -> Array:
    """Return (n, 3, 3) covariances as (n, 2, 2) on `tangent_basis(u_icrs)`."""
    return in_components(tangent_basis(u_icrs), cov)


def in_components(basis: Array, cov: Array) -> Array:
    """Return ``B @ C @ B.T`` of each two matrices.

    Parameters
    ----------
    basis : (n, k, 3) float
        New components by the old ones.
    cov : (n, 3, 3) float
        Covariances of the old components.

    Returns
    -------
    (n, k, k) float
        Covariances of the new components.

    Notes
    -----
    Compiled: NumPy multiplies stacks of small matrices one by one, which takes ten times as long.
    """
    out = np.empty((len(basis), basis.shape[1], basis.shape[1]))
    cov = np.array(np.broadcast_to(cov, (len(basis), 3, 3)), float, order="C")
    _transform(np.array(basis, float, order="C"), cov, out)
    return out


@kernel
def _transform(basis, cov, out):
    """Write `in_components` of `basis` (n, k, 3) and `cov` (n, 3, 3) to `out` (n, k, k)."""
    for i in range(len(basis)):
        B, C = basis[i], cov[i]
        for a in range(len(B)):
            x = B[a, 0] * C[0, 0] + B[a, 1] * C[1, 0] + B[a, 2] * C[2, 0]
            y = B[a, 0] * C[0, 1] + B[a, 1] * C[1, 1] + B[a, 2] * C[2, 1]
            z = B[a, 0] * C[0, 2] + B[a, 1] * C[1, 2] + B[a, 2] * C[2, 2]
            for b in range(len(B)):
                out[i, a, b] = x * B[b, 0] + y * B[b, 1] + z * B[b, 2]


def traces(cov: Array) -> Array:
    """Return the traces (n,) of matrices (n, k, k).

    `numpy.trace` takes five times as long for small ones.
    """
    return np.einsum("nii->n", cov)


def scatter_beyond(residual_rad: Array, sigma_rad: Array, leverage: Array, follows: Flags) -> float:
    """Return the variance of directions, per axis, in excess of their stated one [rad^2].

    It divides the error of a prior attitude into a part that changes from frame to frame and a
    constant part: only the former scatters about a smooth motion.

    Parameters
    ----------
    residual_rad : (n, 3) float
        Directions minus the smooth motion that was fitted to them.
    sigma_rad : (n,) float
        1-sigma errors of the directions, per axis.
    leverage : (n,) float
        Weight of each direction in its fitted value; it makes the residual smaller.
    follows : (n,) bool
        Whether a row is the next direction of the object of the row before.

    Returns
    -------
    float
        0 with too few residuals. If neighbours correlate, because attitudes were interpolated, it
        is the variance of independent errors whose mean over many frames has the same variance.

    Notes
    -----
    A robust estimate from the median, because some detections are of another object. Half the
    square of a Gaussian residual on two axes is exponentially distributed; its median is ln 2
    variances.
    """
    has_residual = leverage < MAX_LEVERAGE
    if np.count_nonzero(has_residual) < MIN_RESIDUALS:
        return 0.0
    half_square = np.sum(residual_rad[has_residual] ** 2, axis=1) / 2
    variance = np.median(half_square / (1.0 - leverage[has_residual])) / np.log(2.0)
    beyond = variance - np.median(sigma_rad[has_residual] ** 2)
    pairs = follows & has_residual
    pairs[1:] &= has_residual[:-1]
    if beyond > 0.0 and np.count_nonzero(pairs) >= MIN_RESIDUALS:
        later = np.flatnonzero(pairs)
        product = np.sum(residual_rad[later] * residual_rad[later - 1], axis=1) / 2
        inlier = np.abs(product) < MAX_PRODUCT * variance
        # The fit makes neighbours correlate: minus the weight of one in the fitted other.
        beyond += 2 * max(np.mean((product + leverage[later] * variance)[inlier]), 0.0)
    return float(max(beyond, 0.0))


# Optics


def image_derivatives(camera: Camera, u: Array) -> tuple[Array, Array]:
    """Return the derivatives of pixel positions by the attitude and by the optics.

    Parameters
    ----------
    u : (n, 3) float
        Directions in the sensor frame.

    Returns
    -------
    J_turn : (n, 2, 3) float
        By a small rotation of the directions about the sensor axes [px/rad].
    J_optics : (n, 2, 9) float
        By the numbers of `OPTICS`.
    """
    x, y = u[:, 0] / u[:, 2], u[:, 1] / u[:, 2]
    from_middle = np.stack(project(camera, u), axis=1) - np.array([camera.cx_px, camera.cy_px])
    f = np.array([camera.fx_px, camera.fy_px])
    stretch, ideal = np.stack(slopes(camera, x, y)), np.stack(ideal_position(camera, x, y))
    return _derivatives(np.stack([x, y]), stretch, ideal, from_middle, f)


@kernel
def _derivatives(xy, stretch, ideal, from_middle, f):
    """Return `image_derivatives` from what the camera makes of each direction.

    `xy` (2, n) are directions (x, y, 1), `stretch` (4, n) the derivatives of their distorted by
    their undistorted positions, `ideal` (2, n) the latter [focal lengths], `from_middle` (n, 2) the
    images about the principal point [px], f (2,) the focal lengths [px].
    """
    n = xy.shape[1]
    by_turn, by_optics = np.empty((n, 2, 3)), np.zeros((n, 2, 9))
    for i in range(n):
        x, y = xy[0, i], xy[1, i]
        for a in range(2):
            across, down = f[a] * stretch[2 * a, i], f[a] * stretch[2 * a + 1, i]
            by_turn[i, a, 0] = -across * x * y - down * (1 + y * y)
            by_turn[i, a, 1] = across * (1 + x * x) + down * x * y
            by_turn[i, a, 2] = down * x - across * y
        x, y = ideal[0, i], ideal[1, i]
        r2 = x * x + y * y
        for a, along in enumerate((x, y)):
            moved = by_optics[i, a]
            moved[a] = from_middle[i, a] / f[a]
            moved[2 + a] = 1.0
            moved[4] = along * r2 * f[a]
            moved[5] = along * r2**2 * f[a]
            moved[8] = along * r2**3 * f[a]
            moved[6 + a] = 2 * x * y * f[a]
            moved[7 - a] = (r2 + 2 * along * along) * f[a]
    return by_turn, by_optics


def shared_attitude_covariance(
    camera: Camera, cov_optics: Array, u: Array, sigma_rad: Array, offsets: Indices
) -> Array:
    """Return (f, 3, 3) covariances of attitudes due to the error of the optics [rad^2].

    About the sensor axes. The error is shared by all frames of the sensor.

    Parameters
    ----------
    cov_optics : (9, 9) float
        Covariance of the numbers of `OPTICS`.
    u : (n, 3) float
        Measured directions of the stars that the attitudes were fitted to, sensor frame.
    sigma_rad : (n,) float
        Their 1-sigma errors, per axis.
    offsets : (f + 1,) int
        Frame k has the stars ``offsets[k]:offsets[k + 1]``, at least two with different directions.
    """
    cov = np.empty((len(offsets) - 1, 3, 3))
    for first in range(0, len(cov), FRAMES_AT_ONCE):
        some = offsets[first : first + FRAMES_AT_ONCE + 1]
        of = slice(some[0], some[-1])
        lever = _levers(_apparent_turns(camera, u[of]), u[of], sigma_rad[of], some[:-1] - some[0])
        cov[first : first + len(lever)] = lever @ cov_optics @ np.swapaxes(lever, 1, 2)
    return cov


def shared_direction_covariance(
    camera: Camera, cov_optics: Array, u: Array, from_stars: Flags
) -> Array:
    """Return (n, 3, 3) covariances of directions due to the error of the optics [rad^2].

    In sensor axes. The error is shared by all frames of the sensor.

    Parameters
    ----------
    cov_optics : (9, 9) float
        Covariance of the numbers of `OPTICS`.
    u : (n, 3) float
        Measured directions, sensor frame.
    from_stars : (n,) bool
        Whether the attitude is from stars, with the same optics. The attitude then compensates a
        part of the error, computed for stars all over the image: see `few_stars_covariance`.
    """
    grid = _grid(camera)
    lever = _levers(_apparent_turns(camera, grid), grid, np.ones(len(grid)), ALL_AT_ONCE)
    compensated = from_stars[:, None, None] * lever
    moved = skew(u) @ (_apparent_turns(camera, u) - compensated)
    return moved @ cov_optics @ np.swapaxes(moved, -1, -2)


def few_stars_covariance(camera: Camera, cov_optics: Array) -> Array:
    """Return the (3, 3) covariance of attitudes, times their number of stars [rad^2].

    It is that of attitudes from few stars about those from stars all over the image, due to the
    error of the optics. About the sensor axes; shared by the frames with the same stars.

    Notes
    -----
    The attitude is a mean over the stars. If they are anywhere in the image, the covariance of a
    mean of n is that of one over n.
    """
    grid = _grid(camera)
    turns, across = _apparent_turns(camera, grid), np.eye(3) - grid[:, :, None] * grid[:, None, :]
    left = turns - across @ _levers(turns, grid, np.ones(len(grid)), ALL_AT_ONCE)
    scatter = np.sum(left @ cov_optics @ np.swapaxes(left, 1, 2), axis=0)
    weight = np.linalg.inv(across.sum(axis=0))
    return np.asarray(len(grid) * weight @ scatter @ weight)


def _grid(camera: Camera) -> Array:
    """Return directions all over the image, sensor frame: (n, 3), 81 of most lenses.

    In the corners of a wide lens's image, a position may have no direction.
    """
    middle = (np.arange(GRID) + 0.5) / GRID
    side, down = (middle * size - 0.5 for size in (camera.width, camera.height))
    x_px, y_px = (axis.ravel() for axis in np.meshgrid(side, down))
    u = unproject(camera, x_px, y_px)
    return u[np.isfinite(u[:, 2])]


def _apparent_turns(camera: Camera, u: Array) -> Array:
    """Return (n, 3, 9): the rotation of each direction with the same effect as the optics.

    The smallest such rotation; its axis is at right angles to the direction.
    """
    J_turn, J_optics = image_derivatives(camera, u)
    turned = np.swapaxes(J_turn, 1, 2)
    return turned @ np.linalg.solve(J_turn @ turned, J_optics)


def _levers(turns: Array, u: Array, sigma_rad: Array, starts: Indices) -> Array:
    """Return (f, 3, 9): minus the derivatives of each frame's attitude by the optics.

    The weighted mean of the stars' rotations, by the normal equations of `optimal_attitude`.
    """
    weight = 1.0 / np.square(sigma_rad)
    across = np.eye(3) - u[:, :, None] * u[:, None, :]
    A = np.add.reduceat(weight[:, None, None] * across, starts)
    A += 1e-9 * traces(A)[:, None, None] * np.eye(3)  # if all are equal
    return np.linalg.solve(A, np.add.reduceat(weight[:, None, None] * turns, starts))
