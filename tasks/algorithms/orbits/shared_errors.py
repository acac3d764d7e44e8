"""Shared errors: are the errors that all views of a sensor share larger than stated?

An ephemeris or a prior attitude is told with a standard deviation, and sometimes it is worse. What
a single object shows of that is little, all objects of a sensor together show it well. The stated
deviation is taken as the scale of a Student distribution: most errors are of this size, and some
are much larger. Then the likeliest scale follows from the lines of sight.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

FREEDOM = 4.0  # degrees of freedom of the Student distribution: 1 error in 90 beyond five sigma
AXES = 3
ITERATIONS = 200
CONVERGED = 1e-3  # relative change of the factors


class SensorEquations(NamedTuple):
    """Normal equations of all sensors' shared errors, without a prior.

    Each sensor has six unknowns: an error of its directions [rad] and one of its place [km],
    three axes each. The states of the objects are eliminated.

    normal : (6 s, 6 s) float
    right : (6 s,) float
    """

    normal: Array
    right: Array


def scale_shared_errors(
    equations: SensorEquations, prior: Array, free: npt.NDArray[np.bool_]
) -> Array:
    """Return by which factors the variances of sensors' shared errors are larger than stated.

    Parameters
    ----------
    equations
        From all objects of the sensors.
    prior : (s, 6, 6) float
        Inverse of the stated covariance of each sensor's errors, direction and place not
        correlated.
    free : (s, 2) bool
        Whether the direction and the place may have a larger error than stated.

    Returns
    -------
    (s, 2) float
        Factors of the variances of direction and place, 1 or larger.

    Notes
    -----
    An error e of k axes with covariance C, from a Student distribution with f degrees of freedom,
    has the variance factor (f + e' C^-1 e) / (f + k). If the stated covariance is right, its mean
    is 1. Expectation maximisation: e' C^-1 e is the expected one, so a sensor whose errors do not
    show keeps a factor of 1.

    References
    ----------
    Lange, Little, Taylor (1989), Robust statistical modeling using the t distribution, JASA 84.
    """
    n_sensors = len(prior)
    factor = np.ones((n_sensors, 2))
    unit = _units(prior)
    normal = equations.normal * unit[:, None] * unit
    right = equations.right * unit
    block = np.arange(2 * n_sensors).repeat(AXES)
    stated = np.zeros_like(normal)
    for s in range(n_sensors):
        of_sensor = slice(6 * s, 6 * s + 6)
        stated[of_sensor, of_sensor] = prior[s] * unit[of_sensor, None] * unit[of_sensor]
    for _ in range(ITERATIONS):
        weight = 1.0 / factor.ravel()[block]
        # Within a block the weight is one, and blocks are not correlated.
        cov = np.linalg.inv(normal + stated * np.sqrt(weight[:, None] * weight))
        error = cov @ right
        square = np.sum(stated * (np.outer(error, error) + cov), axis=1)
        expected = np.bincount(block, square, minlength=2 * n_sensors)
        new = np.maximum((FREEDOM + expected) / (FREEDOM + AXES), 1.0).reshape(n_sensors, 2)
        new[~free] = 1.0
        done = (np.abs(new - factor) < CONVERGED * factor).all()
        factor = new
        if done:
            break
    return factor


def _units(prior: Array) -> Array:
    """Return the stated standard deviation of each unknown, to have all in one size."""
    return np.asarray(1.0 / np.sqrt(np.diagonal(prior, axis1=1, axis2=2)).ravel())
