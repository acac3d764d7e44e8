"""Rotations: unit quaternions (x, y, z, w), scalar last, and matrices.

``q_b_from_a`` converts the components of a vector in frame a to those in frame b.
"""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def matrix_from_quaternion(q: Array) -> Array:
    """Return (..., 3, 3) matrices of (..., 4) unit quaternions."""
    x, y, z, w = np.moveaxis(np.asarray(q, float), -1, 0)
    # Rows of the matrix that converts components in a to components in b.
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_matrix(R: Array) -> Array:
    """Return (..., 4) unit quaternions, w >= 0, of (..., 3, 3) rotation matrices.

    References
    ----------
    Shepperd (1978), Quaternion from rotation matrix: the largest component first.
    """
    R = np.asarray(R, float)
    m = R.reshape(-1, 3, 3)
    trace = np.trace(m, axis1=1, axis2=2)
    # Four times the squares of x, y, z, w.
    squares = np.column_stack([1 + 2 * m[:, i, i] - trace for i in range(3)] + [1 + trace])
    best = np.argmax(squares, axis=1)
    i, j, k = best % 3, (best + 1) % 3, (best + 2) % 3
    n = np.arange(len(m))
    q = np.empty((len(m), 4))
    vector = best < 3
    half = 0.5 / np.sqrt(squares[n, best])
    q[n, i] = (m[n, k, j] - m[n, j, k]) * half  # overwritten where a vector part is largest
    q[n, j] = np.where(vector, m[n, j, i] + m[n, i, j], m[n, i, k] - m[n, k, i]) * half
    q[n, k] = np.where(vector, m[n, k, i] + m[n, i, k], m[n, j, i] - m[n, i, j]) * half
    w = np.where(vector, (m[n, k, j] - m[n, j, k]) * half, squares[n, best] * half)
    q[n, i] = np.where(vector, squares[n, best] * half, q[n, i])
    q[:, 3] = w
    return canonical(q).reshape((*R.shape[:-2], 4))


def canonical(q: Array) -> Array:
    """Return unit quaternions of the same rotations with w >= 0."""
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., 3:] < 0, -q, q)


def quaternion_from_rotation_vector(v: Array) -> Array:
    """Return (..., 4) quaternions of (..., 3) rotation vectors [rad]."""
    angle = np.linalg.norm(v, axis=-1, keepdims=True)
    # sinc keeps the limit at zero angle: sin(a/2)/a = sinc(a/2pi)/2
    return np.concatenate([v * 0.5 * np.sinc(angle / (2 * np.pi)), np.cos(angle / 2)], axis=-1)


def rotation_vector_from_quaternion(q: Array) -> Array:
    """Return (..., 3) rotation vectors [rad], angle in [0, pi], of (..., 4) quaternions."""
    q = canonical(q)
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., 3:])
    with np.errstate(invalid="ignore", divide="ignore"):
        factor = np.where(sine > 1e-12, angle / sine, 2.0)
    return q[..., :3] * factor


def multiply(q: Array, p: Array) -> Array:
    """Return the quaternion of ``R(q) @ R(p)``: ``q_c_from_b * q_b_from_a = q_c_from_a``."""
    qv, qw, pv, pw = q[..., :3], q[..., 3:], p[..., :3], p[..., 3:]
    vector = qw * pv + pw * qv + np.cross(qv, pv)
    scalar = qw * pw - np.sum(qv * pv, axis=-1, keepdims=True)
    return np.concatenate([vector, scalar], axis=-1)


def conjugate(q: Array) -> Array:
    """Return the quaternion of the inverse rotation."""
    return q * np.array([-1.0, -1.0, -1.0, 1.0])


def skew(v: Array) -> Array:
    """Return (..., 3, 3) matrices S with ``S @ a = v x a``."""
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def interpolate_quaternions(times: Array, q: Array, at: Array) -> Array:
    """Return attitudes at times `at`, turned at a constant rate between neighbours (slerp).

    Parameters
    ----------
    times : (n,) float
        Increasing, n >= 1.
    q : (n, 4) float
        Attitudes at these times.
    at : (m,) float
        Requested times; beyond the ends the nearest two attitudes are extrapolated.
    """
    if len(times) == 1:
        return np.repeat(canonical(q), len(at), axis=0)
    i = np.clip(np.searchsorted(times, at) - 1, 0, len(times) - 2)
    share = (at - times[i]) / (times[i + 1] - times[i])
    turn = rotation_vector_from_quaternion(multiply(q[i + 1], conjugate(q[i])))
    return canonical(multiply(quaternion_from_rotation_vector(turn * share[:, None]), q[i]))
