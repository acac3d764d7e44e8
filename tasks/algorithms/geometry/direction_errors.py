"""Errors of a direction from errors of the centroid and of the attitude."""

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.geometry.rotations import skew
from epipole.tasks.algorithms.geometry.sky import tangent_basis

Array = npt.NDArray[np.float64]

MOST_LEVERAGE = 0.8  # a direction that decides its own fit has no residual
OUTLIER = 20.0  # variances: a product of two residuals beyond is of another object
FEWEST_RESIDUALS = 20  # their variance is then known to a third


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


def attitude_covariance(u_icrs: Array, cov_icrs_rad2: Array) -> Array:
    """Return (n, 3, 3) covariances of directions due to attitude errors.

    Parameters
    ----------
    u_icrs : (n, 3) float
        Unit vectors.
    cov_icrs_rad2 : (n, 3, 3) float
        Covariance of the small rotation of their frame, about the axes of the ICRS [rad^2].

    Notes
    -----
    A small rotation phi moves a direction by phi x u; the sign of phi does not matter.
    """
    across = skew(u_icrs)
    return across @ cov_icrs_rad2 @ np.swapaxes(across, -1, -2)


def on_tangent_plane(u_icrs: Array, cov: Array) -> Array:
    """Return (n, 3, 3) covariances as (n, 2, 2) on `tangent_basis(u_icrs)`."""
    basis = tangent_basis(u_icrs)
    return basis @ cov @ np.swapaxes(basis, -1, -2)


def scatter_beyond(
    residual_rad: Array, sigma_rad: Array, leverage: Array, follows: npt.NDArray[np.bool_]
) -> float:
    """Return the variance, per axis, by which directions scatter beyond their own errors [rad^2].

    So the error of a prior attitude is divided into one that changes from frame to frame and one
    that stays: only the former scatters about a smooth motion.

    Parameters
    ----------
    residual_rad : (n, 3) float
        Directions minus those of the smooth motion that was fitted to them.
    sigma_rad : (n,) float
        1-sigma errors of the directions, per axis.
    leverage : (n,) float
        Weight of each direction in its own fitted one; it makes the residual smaller.
    follows : (n,) bool
        Whether a direction is the next one of the same object after the row before.

    Returns
    -------
    float
        0 where too few residuals can tell. Where neighbours correlate, because attitudes were
        interpolated, it is the variance of independent errors with the same mean over many frames.

    Notes
    -----
    From the median, so that detections of another object do not count: half the square of a
    Gaussian residual on two axes is exponentially distributed, and its median is ln 2 variances.
    """
    telling = leverage < MOST_LEVERAGE
    if np.count_nonzero(telling) < FEWEST_RESIDUALS:
        return 0.0
    half_square = np.sum(residual_rad[telling] ** 2, axis=1) / 2
    variance = np.median(half_square / (1.0 - leverage[telling])) / np.log(2.0)
    beyond = variance - np.median(sigma_rad[telling] ** 2)
    pairs = follows & telling
    pairs[1:] &= telling[:-1]
    if beyond > 0.0 and np.count_nonzero(pairs) >= FEWEST_RESIDUALS:
        later = np.flatnonzero(pairs)
        product = np.sum(residual_rad[later] * residual_rad[later - 1], axis=1) / 2
        usual = np.abs(product) < OUTLIER * variance
        # The fit alone makes neighbours correlate by minus the weight that one has in the other.
        beyond += 2 * max(np.mean((product + leverage[later] * variance)[usual]), 0.0)
    return float(max(beyond, 0.0))
