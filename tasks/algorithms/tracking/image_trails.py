"""Trails of a sensor that turns: the error of detections along their motion through the image.

What moves through the image during an exposure leaves a trail, also a slow object while the sensor
turns. The middle of its light is less certain along the trail than across it. Other than the error
in time that `trails` finds, this is along the motion in the image, not along that in the sky. The
scatter of a sensor's detections about smooth motions shows it, beyond that other error.
"""

import numpy as np

from epipole.schemas.arrays import Array

# Least number of residuals, and the largest weight of a detection in the fitted motion.
MIN_RESIDUALS, MAX_LEVERAGE = 50, 0.8
# The excess counts if it is this many of its sigmas, and this share of the median variance.
SIGNIFICANT, MIN_SHARE = 5.0, 0.1
# Squared residuals beyond this many variances are of other objects or false: they do not count.
MAX_SQUARE = 25.0
ROUNDS = 5  # of the variance along the motion, which decides what is beyond


def trail_time2(residual: Array, moves: Array, cov: Array, leverage: Array) -> float:
    """Return the variance of detections along their motion, over the square of their rate [s^2].

    Parameters
    ----------
    residual : (n, 3) float
        Directions minus smooth motions that were fitted to them [rad].
    moves : (n, 3) float
        Rates at which the directions move in the sensor's axes, in those of `residual` [rad/s].
    cov : (n, 3, 3) float
        Covariances of the directions without these trails [rad^2].
    leverage : (n,) float
        Weight of each direction in its fitted value; it makes the residual smaller.

    Returns
    -------
    float
        0 where the scatter along the motion is not significantly larger than across it.
    """
    rate2 = np.sum(moves**2, axis=1)
    kept = (leverage < MAX_LEVERAGE) & (rate2 > 0.0) & np.isfinite(rate2)
    if np.count_nonzero(kept) < MIN_RESIDUALS:
        return 0.0
    residual, moves, rate2, cov = residual[kept], moves[kept], rate2[kept], cov[kept]
    shrunk = 1.0 - leverage[kept]
    along2 = np.einsum("ni,ni->n", residual, moves) ** 2 / rate2
    across2 = np.maximum(np.sum(residual**2, axis=1) - along2, 0.0) / shrunk
    along2 = along2 / shrunk
    stated_along = np.einsum("ni,nij,nj->n", moves, cov, moves) / rate2
    stated_across = np.trace(cov, axis1=1, axis2=2) - stated_along
    excess = along2 - stated_along - (across2 - stated_across)
    time2 = 0.0
    for _ in range(ROUNDS):
        expected = stated_along + time2 * rate2
        fit = (along2 < MAX_SQUARE * expected) & (across2 < MAX_SQUARE * stated_across)
        # A squared residual has the variance 2 sigma^4.
        weight = np.where(fit, rate2 / (2 * expected**2 + 2 * stated_across**2), 0.0)
        total = float(np.sum(weight * rate2))
        if not total > 0.0:
            return 0.0
        time2 = max(float(np.sum(weight * excess)) / total, 0.0)
    if time2 * np.sqrt(total) < SIGNIFICANT:
        return 0.0
    return time2 if time2 * np.median(rate2) > MIN_SHARE * np.median(stated_across) else 0.0
