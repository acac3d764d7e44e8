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

SCALES = (1.0, 1e-3)  # kilometres, metres
INERTIAL = np.zeros(3)
EARTH_FIXED = np.array([0.0, 0.0, EARTH_RATE_RAD_S])
_AXES = [sign * EARTH_RATE_RAD_S * axis for axis in np.eye(3) for sign in (1.0, -1.0)]
RATES = (INERTIAL, EARTH_FIXED, *(w for w in _AXES if not np.array_equal(w, EARTH_FIXED)))
FARTHEST_KM = 2e6  # a bound orbit about the Earth ends before
# An excess is within its error up to 1; beyond doubt from `FAR` on, where another reading leaves
# but a fifth of it. A share of gravity is
# allowed for what the model leaves out: the flattening is a six-hundredth of it. Sun and Moon
# pull at a distant sensor.
FAR = 1.5
CLEARLY = 0.2
MODEL_SHARE = 0.01
MODEL_KM_S2 = 1e-7
SIGMAS = 5.0


class Reading(NamedTuple):
    """A reading of positions: they are kilometres after `scale`, in axes that turn at `rate`."""

    scale: float
    rate_rad_s: Array


class ReadingFit(NamedTuple):
    """How well a reading fits all arcs of a sensor.

    `misfit` is the excess acceleration in units of what is allowed, `share` in units of gravity,
    with a fifth of what is allowed as its error; the median over the arcs.
    """

    reading: Reading
    misfit: float
    share: float
    share_sigma: float


def main_readings(stated_rate: Array) -> list[Reading]:
    """Return the stated reading, the other frame, and the other unit."""
    other = EARTH_FIXED if stated_rate is INERTIAL else INERTIAL
    kilometres, metres = SCALES
    return [
        Reading(kilometres, stated_rate), Reading(kilometres, other), Reading(metres, stated_rate)
    ]  # fmt: skip


def all_readings(stated_rate: Array) -> list[Reading]:
    """Return all readings; the stated one is the first.

    Exchanged axes show only where they should turn with the Earth. With another stated frame they
    would be a second mistake, and thrust may look like one.
    """
    rates = [stated_rate, *(w for w in RATES if w is not stated_rate)]
    rates = rates if stated_rate is EARTH_FIXED else rates[:2]
    return [Reading(scale, rate) for scale in SCALES for rate in rates]


def read_arcs(arcs: Sequence[Arc], reading: Reading) -> list[ReadArc]:
    """Return all arcs of a sensor as a reading has them."""
    return [read_arc(arc, *reading) for arc in arcs]


def fit_reading(
    arcs: Sequence[ReadArc], reading: Reading, use_velocities: bool = False
) -> ReadingFit:
    """Return how well a reading fits.

    Parameters
    ----------
    arcs
        As the reading has them.
    use_velocities
        Whether velocities are known to be those of the path: then the better of the two
        estimates counts.
    """
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
    return ReadingFit(reading, *np.median(np.array(rows), axis=0).tolist())


def is_on_the_ground(arcs: Sequence[Arc]) -> bool:
    """Return whether the sensor is too low for an orbit, or on the ground."""
    radius_km = np.median(np.concatenate([np.linalg.norm(arc.r, axis=1) for arc in arcs]))
    return bool(EARTH_RADIUS_KM - 100.0 < radius_km < LOWEST_ORBIT_KM)
