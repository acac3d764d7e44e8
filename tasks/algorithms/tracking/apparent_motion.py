"""How fast the apparent motion of an object can change: bounds from its apparent rate.

Four causes change a rate. Geometry changes it by its square: an object that passes at range d with
speed v has the rate v / d, which changes by up to (v / d)^2. While the range changes, the rate
changes by twice the relative range rate times the rate. Gravity changes it by the rate times g / v
of a low orbit. A sensor in a low orbit changes it by its acceleration over the range of a far
object. Each further derivative has one more factor of the rate, of the relative range rate, or of
the angular rate of a low orbit.

The relative range rate is the rate times the cotangent of the angle between the line of sight and
the relative velocity. So it is bounded by the rate as well: an object that is known to be slow
cannot bend like one nearby.
"""

import numpy as np

from epipole.tasks.algorithms.kernels import kernel

LOW_ORBIT_S = 1e-3  # [1/s] angular rate of a low orbit; also g / v there
APPROACH = 2.0  # relative range rate over apparent rate: real low orbits rarely exceed it
APPROACH_S = 7e-3  # [1/s] largest relative range rate: 14 km/s at 2,000 km
FAR_RAD_S2 = 2.5e-7  # [rad/s^2] a low sensor's acceleration over the range of a far object


@kernel
def approach(rate: float) -> float:
    """Return how fast [1/s] the range of an object at a rate [rad/s] may change, over the range."""
    return min(APPROACH * rate, APPROACH_S)


@kernel
def acceleration(rate: float) -> float:
    """Return how fast [rad/s^2] a rate [rad/s] may change."""
    return rate * rate + (LOW_ORBIT_S + 2 * approach(rate)) * rate + FAR_RAD_S2


@kernel
def jerk(rate: float) -> float:
    """Return how fast [rad/s^3] the acceleration at a rate [rad/s] may change."""
    return 2 * rate**3 + 6 * approach(rate) ** 2 * rate + LOW_ORBIT_S * acceleration(rate)


@kernel
def jerk_of(rate: float, bend: float) -> float:
    """Return how fast [rad/s^3] an acceleration `bend` [rad/s^2] at a rate [rad/s] may change.

    An object that approaches accelerates by twice its relative range rate times its rate. This
    acceleration changes by three times the relative range rate times itself.
    """
    geometry = (2 + 6 * APPROACH**2) * rate**3 + LOW_ORBIT_S * acceleration(rate)
    return geometry + 1.5 * bend * bend / max(rate, 1e-6)


@kernel
def cubic_span(rate: float, sigma: float) -> float:
    """Return over how long [s] a cubic describes the motion to a standard deviation [rad].

    The best cubic misses a quartic s t^4 / 24 by an eighth of its value at the ends.
    """
    snap = 2 * (rate + LOW_ORBIT_S + 2 * approach(rate)) * jerk(rate)
    return float(2 * np.sqrt(np.sqrt(8 * 24 * sigma / snap)))
