"""Readings: how the positions of a log may be meant, and which reading falls freely.

A reading is a unit and a rotation of the axes. The stated one is given up only where its excess
acceleration is far beyond its error and that of another reading is not.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM, EARTH_RATE_RAD_S
from epipole.tasks.algorithms.earth_gravity import LOWEST_ORBIT_KM
from epipole.tasks.algorithms.log_checks.free_fall import (
    Arc,
    ReadArc,
    fall,
    fall_of_velocities,
    read_arc,
)

KILOMETRES, METRES = 1.0, 1e-3  # scales
# How axes turn [rad/s]. Exchanged ones turn with the Earth, about another axis or the other way.
INERTIAL = np.zeros(3)
EARTH_FIXED = np.array([0.0, 0.0, EARTH_RATE_RAD_S])
_AXES = [sign * EARTH_RATE_RAD_S * axis for axis in np.eye(3) for sign in (1.0, -1.0)]
EXCHANGED = [rate for rate in _AXES if not np.array_equal(rate, EARTH_FIXED)]
FARTHEST_KM = 2e6  # a bound orbit about the Earth ends before
# An excess is within its error up to 1; beyond doubt from `FAR` on, where another reading leaves
# but a fifth of it. A share of gravity is allowed for what the model leaves out: the flattening is
# a six-hundredth of it. Sun and Moon pull at a distant sensor.
FAR = 1.5
CLEARLY = 0.2
MODEL_SHARE = 0.01
MODEL_KM_S2 = 1e-7
SIGMAS = 5.0


class Reading(NamedTuple):
    """A reading of positions: they are kilometres after `scale`, in axes that turn at this rate."""

    scale: float
    rate_rad_s: Array

    def has_unit_of(self, other: "Reading") -> bool:
        """Return whether both are in the same unit."""
        return self.scale == other.scale

    def has_axes_of(self, other: "Reading") -> bool:
        """Return whether both are in the same axes."""
        return np.array_equal(self.rate_rad_s, other.rate_rad_s)


class ReadingFit(NamedTuple):
    """How well a reading fits all arcs of a sensor.

    `arcs` are as the reading has them. `misfit` is the excess acceleration in units of what is
    allowed, `share` in units of gravity, with a fifth of what is allowed as its error; the median
    over the arcs.
    """

    reading: Reading
    arcs: list[ReadArc]
    misfit: float
    share: float
    share_sigma: float


def stated_reading(earth_fixed: bool) -> Reading:
    """Return the reading that a log states: kilometres, inertial or Earth-fixed."""
    return Reading(KILOMETRES, EARTH_FIXED if earth_fixed else INERTIAL)


def main_readings(stated: Reading) -> list[Reading]:
    """Return the readings beside the stated one with a single mistake that is frequent.

    The frame is the other one, or the unit.
    """
    return [in_other_frame(stated), stated._replace(scale=METRES)]


def all_readings(stated: Reading) -> list[Reading]:
    """Return all readings beside the stated one.

    Exchanged axes show only where they should turn with the Earth. With another stated frame they
    would be a second mistake, and thrust may look like one.
    """
    axes = [stated, in_other_frame(stated)]
    if np.array_equal(stated.rate_rad_s, EARTH_FIXED):
        axes += [stated._replace(rate_rad_s=rate) for rate in EXCHANGED]
    return [*axes[1:], *(reading._replace(scale=METRES) for reading in axes)]


def in_other_frame(reading: Reading) -> Reading:
    """Return an Earth-fixed reading for one in inertial axes, an inertial one for any other."""
    is_inertial = np.array_equal(reading.rate_rad_s, INERTIAL)
    return reading._replace(rate_rad_s=EARTH_FIXED if is_inertial else INERTIAL)


def fit_reading(arcs: Sequence[Arc], reading: Reading) -> ReadingFit:
    """Return how well a reading fits all arcs of a sensor."""
    return _fit([read_arc(arc, reading.scale, reading.rate_rad_s) for arc in arcs], reading, False)


def with_velocities(fit: ReadingFit) -> ReadingFit:
    """Return how well a reading fits if velocities are known to be those of the path.

    Then the better of the two estimates counts, arc by arc.
    """
    return _fit(fit.arcs, fit.reading, use_velocities=True)


def _fit(arcs: list[ReadArc], reading: Reading, use_velocities: bool) -> ReadingFit:
    """Return how well a reading fits arcs that were read so."""
    rows = []
    for arc in arcs:
        radius_km = float(np.median(np.linalg.norm(arc.r_km, axis=1)))
        found = fall(arc)
        excess, sigma = found.excess_km_s2, found.sigma_km_s2
        if use_velocities:
            other, other_sigma = fall_of_velocities(arc)
            if other_sigma < sigma:
                excess, sigma = other, other_sigma
        allowed = MODEL_SHARE * found.gravity_km_s2 + MODEL_KM_S2 + SIGMAS * sigma
        possible = LOWEST_ORBIT_KM <= radius_km <= FARTHEST_KM
        rows.append([
            excess / allowed if possible else np.inf,
            excess / found.gravity_km_s2,
            allowed / SIGMAS / found.gravity_km_s2,
        ])  # fmt: skip
    return ReadingFit(reading, arcs, *np.median(np.array(rows), axis=0).tolist())


def is_on_the_ground(arcs: Sequence[Arc]) -> bool:
    """Return whether the sensor is too low for an orbit, or on the ground."""
    radius_km = np.median(np.concatenate([np.linalg.norm(arc.r, axis=1) for arc in arcs]))
    return bool(EARTH_RADIUS_KM - 100.0 < radius_km < LOWEST_ORBIT_KM)
