"""Illumination: distance, phase angle and sunlight of objects as a sensor sees them."""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Flags, Integers
from epipole.tasks.algorithms.constants import AU_KM, EARTH_RADIUS_KM
from epipole.tasks.algorithms.times import direction_to_sun

REFERENCE_KM = 1000.0  # distance to which magnitudes are reduced


class Illumination(NamedTuple):
    """How n objects are lit and seen.

    range_km : (n,) float
        Distance from the sensor.
    phase_rad : (n,) float
        Angle at the object between the directions to the Sun and to the sensor; 0: fully lit.
    sunlit : (n,) bool
        Whether the middle of the Sun is above the Earth there; a sphere without air.
    """

    range_km: Array
    phase_rad: Array
    sunlit: Flags


def illumination(time_ns: Integers, r_km: Array, sensor_km: Array) -> Illumination:
    """Return how objects are lit and seen.

    Parameters
    ----------
    time_ns : (n,) int
        UTC since 1970.
    r_km, sensor_km : (n, 3) float
        Positions of object, when its light left, and of its sensor, GCRF; NaN: unknown.
    """
    to_sun = AU_KM * direction_to_sun(time_ns) - r_km
    to_sun /= np.linalg.norm(to_sun, axis=1, keepdims=True)
    to_sensor = sensor_km - r_km
    range_km = np.linalg.norm(to_sensor, axis=1)
    cosine = np.einsum("na,na->n", to_sun, to_sensor) / range_km
    # Not the arc cosine, which has no digits near full phase.
    sine = np.linalg.norm(np.cross(to_sun, to_sensor), axis=1) / range_km
    towards = np.einsum("na,na->n", r_km, to_sun)
    aside = np.linalg.norm(np.cross(r_km, to_sun), axis=1)
    sunlit = (towards > 0.0) | (aside > EARTH_RADIUS_KM)
    return Illumination(range_km, np.arctan2(sine, cosine), sunlit)


def reduced_magnitude(magnitude: Array, range_km: Array) -> Array:
    """Return magnitudes (n,) as they would be from `REFERENCE_KM`."""
    return np.asarray(magnitude - 5.0 * np.log10(range_km / REFERENCE_KM))
