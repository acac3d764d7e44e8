"""Attitude from matched directions: the optimum and its covariance.

The error of an attitude R is a small rotation phi about the sensor axes,
``R_true = exp([phi x]) R``. Covariances are those of phi [rad^2]; its sign does not matter.
"""

import numpy as np

from epipole.schemas.arrays import Array
from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel
from epipole.tasks.algorithms.symmetric_matrices import invert_symmetric


def optimal_attitude(u_sensor: Array, u_icrs: Array, sigma_rad: Array) -> tuple[Array, Array]:
    """Return the attitude that fits weighted directions best, with its covariance.

    Parameters
    ----------
    u_sensor, u_icrs : (n, 3) float
        Measured unit vectors, and the apparent directions of their stars. n >= 2, not all equal.
    sigma_rad : (n,) float
        1-sigma errors of the measured vectors, per axis.

    Returns
    -------
    R_sensor_from_icrs : (3, 3) float
    cov_rad2 : (3, 3) float
        Of the small rotation about the sensor axes; NaN if the directions do not determine it.

    References
    ----------
    Davenport's q method, in Wertz (1978), section 12.2.3; covariance: Shuster and Oh (1981),
    eq. 103.
    """
    weight = 1.0 / np.square(sigma_rad)
    weight = weight / weight.sum()
    B = np.einsum("n,ni,nj->ij", weight, u_sensor, u_icrs)
    z = np.array([B[2, 1] - B[1, 2], B[0, 2] - B[2, 0], B[1, 0] - B[0, 1]])
    K = np.zeros((4, 4))
    K[:3, :3] = B + B.T - np.trace(B) * np.eye(3)
    K[:3, 3] = K[3, :3] = z
    K[3, 3] = np.trace(B)
    x, y, zz, w = np.linalg.eigh(K)[1][:, -1]
    R = np.array(
        [
            [1 - 2 * (y * y + zz * zz), 2 * (x * y - zz * w), 2 * (x * zz + y * w)],
            [2 * (x * y + zz * w), 1 - 2 * (x * x + zz * zz), 2 * (y * zz - x * w)],
            [2 * (x * zz - y * w), 2 * (y * zz + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    return R, attitude_covariance(u_sensor, sigma_rad)


def attitude_covariance(u_sensor: Array, sigma_rad: Array) -> Array:
    """Return (sum of (I - u u') / sigma^2)^-1 [rad^2] about the sensor axes; NaN if singular."""
    weight = 1.0 / np.square(sigma_rad)
    information = weight.sum() * np.eye(3) - np.einsum("n,ni,nj->ij", weight, u_sensor, u_sensor)
    # Directions within a millionth of a radian do not determine the roll.
    if len(u_sensor) < 2 or np.linalg.cond(information) > 1e12:
        return np.full((3, 3), np.nan)
    return np.linalg.inv(information)


@borrowing_kernel
def attitude_information(u_sensor, sigma_rad, A):
    """Write the sum of (I - u u') / sigma^2 [rad^-2] about the sensor axes to A (compiled).

    u_sensor (n, 3) are unit vectors, sigma_rad (n,) their 1-sigma errors, A is (3, 3).
    """
    A[:] = 0.0
    for k in range(len(u_sensor)):
        w = 1.0 / (sigma_rad[k] * sigma_rad[k])
        for i in range(3):
            A[i, i] += w
            for j in range(3):
                A[i, j] -= w * u_sensor[k, i] * u_sensor[k, j]


@borrowing_kernel
def copy_matrix(source, target):
    """Copy a (3, 3) matrix (compiled); a slice assignment compiles to much more code."""
    for i in range(3):
        for j in range(3):
            target[i, j] = source[i, j]


@borrowing_kernel
def turn(R, x, y, z):
    """Turn R (3, 3), sensor from ICRS, in place by the rotation vector (x, y, z) [rad] (compiled).

    The vector is on the sensor axes of R.
    """
    angle = np.sqrt(x * x + y * y + z * z)
    if angle == 0.0:
        return
    half = 0.5 * angle
    f = np.sin(half) / angle
    qx, qy, qz, qw = f * x, f * y, f * z, np.cos(half)
    for j in range(3):
        a, b, c = R[0, j], R[1, j], R[2, j]
        # Column j of R, (a, b, c), becomes v + 2 q x (q x v + w v).
        tx, ty, tz = (
            qy * c - qz * b + qw * a,
            qz * a - qx * c + qw * b,
            qx * b - qy * a + qw * c,
        )
        R[0, j] = a + 2.0 * (qy * tz - qz * ty)
        R[1, j] = b + 2.0 * (qz * tx - qx * tz)
        R[2, j] = c + 2.0 * (qx * ty - qy * tx)


@borrowing_kernel
def orthonormalise(R):
    """Make the rows of R (3, 3) orthonormal in place; the boresight, row 2, is kept (compiled)."""
    n = np.sqrt(R[2, 0] ** 2 + R[2, 1] ** 2 + R[2, 2] ** 2)
    for j in range(3):
        R[2, j] /= n
    d = R[0, 0] * R[2, 0] + R[0, 1] * R[2, 1] + R[0, 2] * R[2, 2]
    for j in range(3):
        R[0, j] -= d * R[2, j]
    n = np.sqrt(R[0, 0] ** 2 + R[0, 1] ** 2 + R[0, 2] ** 2)
    for j in range(3):
        R[0, j] /= n
    R[1, 0] = R[2, 1] * R[0, 2] - R[2, 2] * R[0, 1]
    R[1, 1] = R[2, 2] * R[0, 0] - R[2, 0] * R[0, 2]
    R[1, 2] = R[2, 0] * R[0, 1] - R[2, 1] * R[0, 0]


@kernel
def refine_attitude(R, u, sigma, a, star_of, P):
    """Move R to the weighted least-squares attitude of its matches, in place; write P (compiled).

    Gauss-Newton on the rotation group; its fixed point is the optimum of Wahba's problem.

    Parameters
    ----------
    R : (3, 3) float, sensor from ICRS, near the optimum (a few degrees)
    u, sigma : (n, 3), (n,) float, measured directions and their errors [rad]
    a : (m, 3) float, apparent directions of stars, ICRS axes
    star_of : (n,) int, the star of each direction; -1 without
    P : (3, 3) float, out: covariance about the sensor axes [rad^2]

    Returns
    -------
    bool
        False if the matches do not determine the attitude; R and P are then invalid.
    """
    return refine_attitude_in(R, u, sigma, a, star_of, P, np.empty((3, 3)))


@borrowing_kernel
def refine_attitude_in(R, u, sigma, a, star_of, P, A):
    """Do what `refine_attitude` does, with work space A (3, 3) (compiled)."""
    for _ in range(3):
        A[:] = 0.0
        b0, b1, b2, total = 0.0, 0.0, 0.0, 0.0
        for k in range(len(u)):
            s = star_of[k]
            if s < 0:
                continue
            x = R[0, 0] * a[s, 0] + R[0, 1] * a[s, 1] + R[0, 2] * a[s, 2]
            y = R[1, 0] * a[s, 0] + R[1, 1] * a[s, 1] + R[1, 2] * a[s, 2]
            z = R[2, 0] * a[s, 0] + R[2, 1] * a[s, 1] + R[2, 2] * a[s, 2]
            w = 1.0 / (sigma[k] * sigma[k])
            total += w
            A[0, 0] += w * (1.0 - x * x)
            A[1, 1] += w * (1.0 - y * y)
            A[2, 2] += w * (1.0 - z * z)
            A[0, 1] -= w * x * y
            A[0, 2] -= w * x * z
            A[1, 2] -= w * y * z
            b0 += w * (y * u[k, 2] - z * u[k, 1])
            b1 += w * (z * u[k, 0] - x * u[k, 2])
            b2 += w * (x * u[k, 1] - y * u[k, 0])
        A[1, 0], A[2, 0], A[2, 1] = A[0, 1], A[0, 2], A[1, 2]
        if invert_symmetric(A, P) <= 1e-12 * total * total * total:
            return False
        px = P[0, 0] * b0 + P[0, 1] * b1 + P[0, 2] * b2
        py = P[1, 0] * b0 + P[1, 1] * b1 + P[1, 2] * b2
        pz = P[2, 0] * b0 + P[2, 1] * b1 + P[2, 2] * b2
        turn(R, px, py, pz)
        if px * px + py * py + pz * pz < 1e-20:  # a step below 1e-10 rad
            break
    orthonormalise(R)
    return True
