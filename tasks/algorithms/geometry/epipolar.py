"""Epipolar geometry of two sensors that see directions, not pixels.

A direction seen by one sensor and the baseline span a plane, and the same object's direction
from the other sensor lies in it. In an image that plane is the epipolar line.
"""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


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
        0 where the first direction lies along the baseline and no plane is defined.

    References
    ----------
    Huang, Zhang, Feng, doi 10.19650/j.cnki.cjsi.J1905157, as |p_2' F p_1| over the norm of the
    line, here on the unit sphere, where it holds for any camera.
    """
    baseline = r_2_km - r_1_km
    normal = np.cross(baseline, u_1)
    length = np.linalg.norm(normal, axis=-1)
    defined = length > 1e-12 * np.linalg.norm(baseline, axis=-1)  # below, it is rounding
    sine = np.sum(normal * u_2, axis=-1) / np.where(defined, length, np.inf)
    return np.arcsin(np.clip(sine, -1.0, 1.0))


def epipolar_sigma(
    r_1_km: Array,
    u_1: Array,
    cov_1: Array,
    r_2_km: Array,
    u_2: Array,
    cov_2: Array,
    sigma_1_km: Array,
    sigma_2_km: Array,
    x_km: Array,
) -> Array:
    """Return the standard deviation of `epipolar_angle` [rad] for an object at x.

    Parameters
    ----------
    cov_1, cov_2 : (..., 3, 3) float
        Covariances of the directions [rad^2] in the same axes.
    sigma_1_km, sigma_2_km : (...) float
        1-sigma errors of the positions an axis [km].
    x_km : (..., 3) float
        The object: an error of the first direction matters by the ratio of the ranges.
    """
    normal = np.cross(u_1, u_2)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = normal / np.where(length > 0, length, 1.0)
    range_1 = np.linalg.norm(x_km - r_1_km, axis=-1)
    range_2 = np.linalg.norm(x_km - r_2_km, axis=-1)
    across_1 = np.einsum("...i,...ij,...j", normal, cov_1, normal) * range_1**2
    across_2 = np.einsum("...i,...ij,...j", normal, cov_2, normal) * range_2**2
    return np.sqrt(across_1 + across_2 + sigma_1_km**2 + sigma_2_km**2) / range_2
