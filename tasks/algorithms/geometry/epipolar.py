"""Epipolar geometry of two sensors, on directions instead of pixels.

The baseline and a direction seen by one sensor span a plane: the epipolar plane. The direction
of the same object from the other sensor lies in it. In an image the plane is the epipolar line.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


class UncertainSight(NamedTuple):
    """A line of sight with its errors.

    r_km : (..., 3) float
        Sensor position [km].
    u : (..., 3) float
        Unit vector from the sensor to the object.
    cov : (..., 3, 3) float
        Covariance of the direction [rad^2], same axes.
    sigma_km : (...) float
        1-sigma error of the position, per axis [km].
    """

    r_km: Array
    u: Array
    cov: Array
    sigma_km: Array


def epipolar_angle(r_1_km: Array, u_1: Array, r_2_km: Array, u_2: Array) -> Array:
    """Return how far the second direction lies from the first one's epipolar plane [rad].

    Parameters
    ----------
    r_1_km, r_2_km : (..., 3) float
        Sensor positions [km], any one frame.
    u_1, u_2 : (..., 3) float
        Unit vectors from the sensors to the object, same axes, aberration removed.

    Returns
    -------
    (...) float
        Signed angle; times the focal length in pixels it is the distance to the epipolar line.
        0 where the first direction lies along the baseline: no plane is defined.

    References
    ----------
    Huang, Zhang, Feng: Space target synchronization association method under distributed star
    sensor, doi 10.19650/j.cnki.cjsi.J1905157. There it is |p_2' F p_1| over the norm of the
    line; on the unit sphere it holds for any camera.
    """
    baseline = r_2_km - r_1_km
    normal = np.cross(baseline, u_1)
    length = np.linalg.norm(normal, axis=-1)
    defined = length > 1e-12 * np.linalg.norm(baseline, axis=-1)  # below, it is rounding
    sine = np.sum(normal * u_2, axis=-1) / np.where(defined, length, np.inf)
    return np.arcsin(np.clip(sine, -1.0, 1.0))


def epipolar_sigma(first: UncertainSight, second: UncertainSight, x_km: Array) -> Array:
    """Return the standard deviation of `epipolar_angle` [rad] for an object at x.

    Parameters
    ----------
    first, second
        The two lines of sight, in the same axes.
    x_km : (..., 3) float
        The object's position [km]: an error of the first direction counts by the ratio of the
        ranges.
    """
    normal = np.cross(first.u, second.u)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = normal / np.where(length > 0, length, 1.0)
    range_1 = np.linalg.norm(x_km - first.r_km, axis=-1)
    range_2 = np.linalg.norm(x_km - second.r_km, axis=-1)
    across_1 = np.einsum("...i,...ij,...j", normal, first.cov, normal) * range_1**2
    across_2 = np.einsum("...i,...ij,...j", normal, second.cov, normal) * range_2**2
    return np.sqrt(across_1 + across_2 + first.sigma_km**2 + second.sigma_km**2) / range_2
