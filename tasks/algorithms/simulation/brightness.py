"""How bright objects are, and which of them a sensor detects."""

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from epipole.tasks.algorithms.simulation.constants import EARTH_RADIUS_KM

Array = npt.NDArray[np.float64]

STANDARD_RANGE_KM = 1000.0


def magnitude_at(standard: Array, distance_km: Array) -> Array:
    """Return the magnitudes of objects at a distance, of those at 1000 km."""
    return standard + 5 * np.log10(distance_km / STANDARD_RANGE_KM)


def lambert_dimming(u_to_sun: Array, u_to_object: Array) -> Array:
    """Return by how many magnitudes a diffuse sphere is fainter than when fully lit.

    It is infinite where the Sun is straight behind the object.

    Parameters
    ----------
    u_to_sun, u_to_object : (n, 3) float
        Unit vectors, from the Earth and from the sensor.

    References
    ----------
    Russell (1916), On the albedo of the planets and their satellites, ApJ 43, 173: the phase
    law of a sphere that scatters by Lambert's law.
    """
    phase = np.arccos(np.clip(-np.einsum("ij,ij->i", u_to_sun, u_to_object), -1, 1))
    lit = (np.sin(phase) + (np.pi - phase) * np.cos(phase)) / np.pi
    with np.errstate(divide="ignore"):
        return -2.5 * np.log10(np.maximum(lit, 0.0))


def in_earth_shadow(r_km: Array, u_to_sun: Array) -> npt.NDArray[np.bool_]:
    """Return which places (n, 3) are in the Earth's shadow, taken as a cylinder."""
    along = np.einsum("ij,ij->i", r_km, u_to_sun)
    off2 = np.einsum("ij,ij->i", r_km, r_km) - along * along
    return (along < 0) & (off2 < EARTH_RADIUS_KM**2)


def detection_probability(magnitude: Array, limit: float, fade: float) -> Array:
    """Return the probability that an object is detected: half at the limit.

    Parameters
    ----------
    fade : float
        Standard deviation of the limit [mag]; with 0 it is sharp.
    """
    if not fade:
        return (magnitude <= limit).astype(float)
    return ndtr((limit - magnitude) / fade)
