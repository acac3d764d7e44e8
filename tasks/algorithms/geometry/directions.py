"""Rotations, directions on the sky, and light time.

Quaternions are unit quaternions (x, y, z, w), scalar last. ``q_b_from_a`` converts the components
of a vector in frame a to those in frame b.
"""

import numpy as np

from epipole.schemas.arrays import Array
from epipole.tasks.algorithms.constants import SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.kernels import kernel

AXES_JUMP = 0.9  # abs(u_z) at which `tangent_basis` takes other axes: far from its degenerate ones


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
    q = q / lengths(q)[..., None]
    return np.where(q[..., 3:] < 0, -q, q)


def quaternion_from_rotation_vector(v: Array) -> Array:
    """Return (..., 4) quaternions of (..., 3) rotation vectors [rad]."""
    angle = lengths(v)[..., None]
    # sinc keeps the limit at zero angle: sin(a/2)/a = sinc(a/2pi)/2
    return np.concatenate([v * 0.5 * np.sinc(angle / (2 * np.pi)), np.cos(angle / 2)], axis=-1)


def rotation_vector_from_quaternion(q: Array) -> Array:
    """Return (..., 3) rotation vectors [rad], angle in [0, pi], of (..., 4) quaternions."""
    q = canonical(q)
    sine = lengths(q[..., :3])[..., None]
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


# Directions


def unit_from_radec(ra: Array, dec: Array) -> Array:
    """Return (..., 3) unit vectors of right ascensions and declinations [rad]."""
    level = np.cos(dec)
    return np.stack([level * np.cos(ra), level * np.sin(ra), np.sin(dec)], axis=-1)


def radec_from_unit(u: Array) -> tuple[Array, Array]:
    """Return right ascension in [0, 2 pi) and declination [rad] of (..., 3) vectors."""
    ra = _in_one_turn(np.arctan2(u[..., 1], u[..., 0]))
    return ra, np.arctan2(u[..., 2], np.hypot(u[..., 0], u[..., 1]))


def _in_one_turn(angle: Array) -> Array:
    """Return angles in [0, 2 pi) [rad]. The remainder of a tiny negative one is rounded to 2 pi."""
    turned = angle % (2 * np.pi)
    return np.where(turned < 2 * np.pi, turned, turned - 2 * np.pi)


def aberrate(u: Array, v_km_s: Array) -> Array:
    """Return the apparent directions for an observer moving at v (special relativity, exact).

    Parameters
    ----------
    u : (..., 3) float
        Unit vectors towards the sources, for an observer at rest in the frame of v.
    v_km_s : (..., 3) float
        The observer's velocity [km/s]. The inverse is the same function with -v.

    References
    ----------
    Explanatory Supplement to the Astronomical Almanac (2013), eq. 7.40.
    """
    beta = np.asarray(v_km_s) / SPEED_OF_LIGHT_KM_S
    # einsum, because a sum along a short axis is ten times slower in NumPy.
    projection = np.einsum("...i,...i->...", u, beta)[..., None]
    inverse_gamma = np.sqrt(1 - np.einsum("...i,...i->...", beta, beta)[..., None])
    apparent = inverse_gamma * u + beta * (1 + projection / (1 + inverse_gamma))
    return apparent / np.sqrt(np.einsum("...i,...i->...", apparent, apparent)[..., None])


def tangent_basis(u: Array) -> Array:
    """Return (..., 2, 3): two unit vectors that complete u to a right-handed triad.

    Deterministic, without a degenerate direction, and smooth except at ``abs(u_z) = AXES_JUMP``.
    """
    out = np.empty((*u.shape[:-1], 2, 3))
    _tangent_basis(np.array(u, float, order="C").reshape(-1, 3), out.reshape(-1, 2, 3))
    return out


@kernel
def _tangent_basis(u, out):
    """Write `tangent_basis` of u (n, 3) to `out` (n, 2, 3)."""
    for i in range(len(u)):
        x, y, z = u[i, 0], u[i, 1], u[i, 2]
        # At right angles to u and to the z axis, or to the x axis where u is near the z axis.
        a, b, c = (-y, x, 0.0) if abs(z) < AXES_JUMP else (0.0, -z, y)
        length = np.sqrt(a * a + b * b + c * c)
        a, b, c = a / length, b / length, c / length
        out[i, 0, 0], out[i, 0, 1], out[i, 0, 2] = a, b, c
        out[i, 1, 0], out[i, 1, 1], out[i, 1, 2] = y * c - z * b, z * a - x * c, x * b - y * a


def east_north(u: Array) -> Array:
    """Return (..., 2, 3): the unit vectors towards growing right ascension and declination."""
    out = np.empty((*u.shape[:-1], 2, 3))
    _east_north(np.array(u, float, order="C").reshape(-1, 3), out.reshape(-1, 2, 3))
    return out


@kernel
def _east_north(u, out):
    """Write `east_north` of u (n, 3) to `out` (n, 2, 3).

    At a pole the right ascension is that of `radec_from_unit`: 0, or half a turn for x = -0.0.
    """
    for i in range(len(u)):
        x, y, z = u[i, 0], u[i, 1], u[i, 2]
        across = np.sqrt(x * x + y * y)
        a, b = (-y / across, x / across) if across != 0.0 else (0.0, np.copysign(1.0, x))
        out[i, 0, 0], out[i, 0, 1], out[i, 0, 2] = a, b, 0.0
        out[i, 1, 0], out[i, 1, 1], out[i, 1, 2] = -z * b, z * a, x * b - y * a


def boresight_angles(R_sensor_from_icrs: Array) -> tuple[Array, Array, Array]:
    """Return right ascension, declination and roll [rad] of (..., 3, 3) attitudes.

    Roll is the position angle of the sensor's -y axis at the boresight, from celestial
    north through east, in [0, 2 pi).
    """
    up, boresight = -R_sensor_from_icrs[..., 1, :], R_sensor_from_icrs[..., 2, :]
    ra, dec = radec_from_unit(boresight)
    to_east, to_north = np.einsum("...ij,...j->i...", east_north(boresight), up)
    return ra, dec, _in_one_turn(np.arctan2(to_east, to_north))


def lengths(v: Array) -> Array:
    """Return the lengths (...) of vectors (..., k).

    `numpy.linalg.norm` takes four times as long along a short axis.
    """
    return np.sqrt(np.einsum("...i,...i->...", v, v))


# Light time


def apparent_positions(x_km: Array, v_km_s: Array, light_s: Array, r_km: Array) -> Array:
    """Return the positions of objects when the light left that reaches sensors at an epoch.

    Parameters
    ----------
    x_km, v_km_s : (n, 3) float
        Positions [km] and velocities [km/s] of the objects, GCRF.
    light_s : (n,) float
        Time from the given positions to the epoch [s].
    r_km : (n, 3) float
        Positions of the sensors at the epoch, GCRF [km].

    Returns
    -------
    (n, 3) float
        Positions [km], GCRF.
    """
    delay_s = lengths(x_km - r_km) / SPEED_OF_LIGHT_KM_S
    return np.asarray(x_km + v_km_s * (light_s - delay_s)[:, None])
