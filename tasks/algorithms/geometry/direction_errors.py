"""Errors of a direction from errors of the centroid and of the attitude."""

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.geometry.rotations import skew
from epipole.tasks.algorithms.geometry.sky import tangent_basis

Array = npt.NDArray[np.float64]


def centroid_covariance(u_icrs: Array, sigma_rad: Array) -> Array:
    """Return (n, 3, 3) covariances of directions with the same error on both axes.

    Parameters
    ----------
    u_icrs : (n, 3) float
        Unit vectors.
    sigma_rad : (n,) float
        1-sigma error, per axis [rad].
    """
    across = np.eye(3) - u_icrs[:, :, None] * u_icrs[:, None, :]
    return across * np.square(sigma_rad)[:, None, None]


def attitude_covariance(u_icrs: Array, R_sensor_from_icrs: Array, cov_att_rad2: Array) -> Array:
    """Return (n, 3, 3) covariances of directions due to attitude errors.

    Parameters
    ----------
    u_icrs : (n, 3) float
        Unit vectors.
    R_sensor_from_icrs : (n, 3, 3) float
        Attitudes of their frames.
    cov_att_rad2 : (n, 3, 3) float
        Covariance of the attitude's small rotation about the sensor axes [rad^2].

    Notes
    -----
    A small rotation phi moves a direction by phi x u; the sign of phi does not matter.
    """
    to_direction = -skew(u_icrs) @ np.swapaxes(R_sensor_from_icrs, -1, -2)
    return to_direction @ cov_att_rad2 @ np.swapaxes(to_direction, -1, -2)


def on_tangent_plane(u_icrs: Array, cov: Array) -> Array:
    """Return (n, 3, 3) covariances as (n, 2, 2) on `tangent_basis(u_icrs)`."""
    basis = tangent_basis(u_icrs)
    return basis @ cov @ np.swapaxes(basis, -1, -2)
