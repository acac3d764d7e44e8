"""Directions on the sky: spherical coordinates, tangent planes, aberration, boresight angles."""

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.constants import SPEED_OF_LIGHT_KM_S

Array = npt.NDArray[np.float64]


def unit_from_radec(ra: Array, dec: Array) -> Array:
    """Return (..., 3) unit vectors of right ascensions and declinations [rad]."""
    return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=-1)


def radec_from_unit(u: Array) -> tuple[Array, Array]:
    """Return right ascension in [0, 2 pi) and declination [rad] of (..., 3) vectors."""
    ra = np.arctan2(u[..., 1], u[..., 0]) % (2 * np.pi)
    return ra, np.arctan2(u[..., 2], np.hypot(u[..., 0], u[..., 1]))


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

    Deterministic, without a degenerate direction, and smooth except at ``abs(u_z) = 0.9``.
    """
    helper = np.where(np.abs(u[..., 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    first = np.cross(helper, u)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(u, first)], axis=-2)


def east_north(u: Array) -> Array:
    """Return (..., 2, 3): the unit vectors towards growing right ascension and declination."""
    ra, _ = radec_from_unit(u)
    east = np.stack([-np.sin(ra), np.cos(ra), np.zeros_like(ra)], axis=-1)
    return np.stack([east, np.cross(u, east)], axis=-2)


def boresight_angles(R_sensor_from_icrs: Array) -> tuple[Array, Array, Array]:
    """Return right ascension, declination and roll [rad] of (..., 3, 3) attitudes.

    Roll is the position angle of the sensor's -y axis at the boresight, from celestial
    north through east, in [0, 2 pi).
    """
    up, boresight = -R_sensor_from_icrs[..., 1, :], R_sensor_from_icrs[..., 2, :]
    ra, dec = radec_from_unit(boresight)
    to_east, to_north = np.einsum("...ij,...j->i...", east_north(boresight), up)
    roll = np.arctan2(to_east, to_north)
    return ra, dec, roll % (2 * np.pi)
