"""How good the centroids of each frame are, where a log does not say: from the stars' residuals.

Frames of one sensor may differ: it turns faster, the image is blurred, exposures change. A frame's
residuals say so, but with few stars the estimate is noisy. So each frame's variance is shrunk
towards the sensor's mean (empirical Bayes: Smyth, Statistical Applications in Genetics and
Molecular Biology 3, 2004, article 3, sections 4 and 6.2).
"""

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq
from scipy.special import polygamma, psi

Array = npt.NDArray[np.float64]

LEAST_FRAMES = 10  # of which the scatter is known
SIGNIFICANT = 4.0  # sigma by which residuals of frames differ more than chance makes them
LEAST_SCALE = 0.02  # of a frame: rounding is not measured
ALIKE_DOF = 200.0  # frames that are worth so many residuals to each other are alike


def frame_scales(square_sum: Array, dof: npt.NDArray[np.int64]) -> Array:
    """Return each frame's rms of residuals per axis; the same for all where they are alike.

    Parameters
    ----------
    square_sum : (F,) float
        Sum of the squared residuals of a frame's stars, both axes.
    dof : (F,) int64
        Degrees of freedom: 2 for each star less 3 for the attitude; 0 or less where there is no
        attitude.

    Returns
    -------
    (F,) float. Frames without an attitude get the sensor's scale.
    """
    told = dof > 0
    if not told.any():
        return np.ones(len(dof))
    common = np.full(len(dof), np.sqrt(square_sum[told].sum() / dof[told].sum()))
    if told.sum() < LEAST_FRAMES:
        return common
    half = dof[told] / 2.0
    variance = np.maximum(square_sum[told] / dof[told], (LEAST_SCALE * common[0]) ** 2)
    log_variance = np.log(variance) - psi(half) + np.log(half)  # without the bias of few stars
    by_chance = polygamma(1, half)
    middle = log_variance.mean()
    excess = float(np.mean((log_variance - middle) ** 2 - by_chance))
    # Of the square of a log chi-square variable, the variance has the fourth cumulant as well.
    spread = np.sqrt(np.mean(2.0 * by_chance**2 + polygamma(3, half)) / len(half))
    if excess < SIGNIFICANT * spread:
        return common
    prior_dof = _inverse_trigamma(excess)
    if prior_dof > ALIKE_DOF:
        return common
    prior = np.exp(middle + psi(prior_dof / 2.0) - np.log(prior_dof / 2.0))
    scales = np.full(len(dof), np.exp(0.5 * middle))
    scales[told] = np.sqrt((prior_dof * prior + square_sum[told]) / (prior_dof + dof[told]))
    return scales


def _inverse_trigamma(value: float) -> float:
    """Return twice the number whose trigamma function has this value."""
    return float(2.0 * brentq(lambda x: polygamma(1, x) - value, 1e-3, 1e6))
