"""The log evidence of an attitude: how much better stars explain a frame than chance does.

It is the logarithm of the ratio of two probabilities of the centroids' positions: with stars where
the attitude predicts them, and with each centroid anywhere in the image. Its parts:

- a match adds ln(A / (2 pi s^2)) - d^2 / (2 s^2), s the centroid's sigma, d its distance
  from the star, A the solid angle of the image; with brightness also
  ln(g(difference) / h(magnitude)), h the magnitudes of the catalogue;
- it is unknown which k of n centroids are which of the m stars in view, and what share of these
  the sensor detects (`log_ways`);
- the attitude was chosen among all: the share of the prior's volume that the data leave. Lost in
  space, that is sqrt(det 2 pi P) / (8 pi^2).

So the log evidence does not depend on how many hypotheses were tried. The false-alarm probability
of an evidence x is below exp(-x), by Markov's inequality. `chance_margin` says how far below.
"""

import math
from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array
from epipole.tasks.algorithms.constants import LN_2PI
from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel
from epipole.tasks.algorithms.symmetric_matrices import determinant3, invert_symmetric

BIN_MAG = 0.25  # of the histogram of magnitudes, of `N_BINS` bins from `FIRST_MAG` on
FIRST_MAG = -2.0
N_BINS = 72
TYPICAL_SCATTER_MAG = 0.4  # of a sensor's magnitudes about V, with colours; until it is learned
OUTLIER_SHARE = 0.15  # of stars with another brightness: variables, blends, odd colours
MAG_RANGE = 6.0  # over which the brightness of such stars is even
# Stars per field over their mean: the sky is uneven.
DENSITIES = (0.6, 1.0, 1.4)
# Maximum share (ln) of the false alarms that a search reports: the others are refused because of a
# rival, or of matches that are not clear. Measured: a tenth (bench_false_alarms).
REPORTED = -1.5


class MatchRule(NamedTuple):
    """How matches are weighed.

    gate : a centroid is within this of its star's predicted position [sigma]
    log_density : (N_BINS,) float, ln density of the catalogue's magnitudes
    zero_point, scatter : star minus instrumental magnitude [mag], NaN while unknown, and its
        1-sigma scatter
    min_evidence, clear_evidence : log evidence that an attitude needs, and that ends a search
    """

    gate: float
    log_density: Array
    zero_point: float
    scatter: float
    min_evidence: float
    clear_evidence: float


def log_magnitude_density(magnitude: Array) -> Array:
    """Return ln of the catalogue's probability density of magnitudes [1/mag], by bins."""
    i = np.clip(((magnitude - FIRST_MAG) / BIN_MAG).astype(int), 0, N_BINS - 1)
    count = np.bincount(i, minlength=N_BINS) + 0.5  # a bin without stars is rare, not impossible
    return np.log(count / count.sum() / BIN_MAG)


@borrowing_kernel
def log_brightness_ratio(difference, magnitude, log_density, scatter):
    """Return ln(g / h) of a match, by its difference of magnitudes and 1-sigma scatter [mag]
    (compiled).

    `magnitude` [mag] is the star's, log_density (N_BINS,) as in `MatchRule`.
    """
    z = difference / scatter
    g = OUTLIER_SHARE / MAG_RANGE
    g += (1.0 - OUTLIER_SHARE) * math.exp(-0.5 * z * z) / (scatter * 2.5066282746310002)
    i = min(max(int((magnitude - FIRST_MAG) / BIN_MAG), 0), N_BINS - 1)
    return math.log(g) - log_density[i]


@kernel
def median_zero_point(star_of, instrumental, magnitude):
    """Return the median of star minus instrumental magnitude over the matches [mag] (compiled).

    NaN where fewer than three matches have a flux. star_of (n,) int64 is each centroid's star, -1
    none, `instrumental` (n,) its magnitude, NaN unknown; `magnitude` (m,) are those of the stars.
    """
    zero = np.empty(len(star_of))
    n = 0
    for k in range(len(star_of)):
        if star_of[k] >= 0 and not math.isnan(instrumental[k]):
            zero[n] = magnitude[star_of[k]] - instrumental[k]
            n += 1
    if n < 3:
        return math.nan
    return np.median(zero[:n])


@kernel
def log_ways(n, matches, in_view):
    """Return -ln of the prior probability that these matches, and no others, exist (compiled).

    That is, that these k of the n centroids are these k of the stars in view, before positions
    are known. The share p of the stars in view that the sensor detects has the prior 4 p^3, as most
    sensors detect most stars to their limit. The number f of false centroids has the prior
    1 / (f + 1), the same for every order of magnitude.
    """
    k, m = float(matches), max(in_view, float(matches))
    centroids = math.lgamma(n + 1.0) - math.lgamma(n - k + 1.0)
    centroids += math.log((n - k + 1.0) / (n + 1.0))
    detected = (
        math.log(4.0) + math.lgamma(k + 4.0) + math.lgamma(m - k + 1.0) - math.lgamma(m + 5.0)
    )
    return centroids - detected


@kernel
def chance_margin(matches, n, in_view):
    """Return how far the false-alarm probability is below Markov's bound (compiled).

    Lost in space, a starless frame reaches a log evidence x with this number k of matches with a
    probability below exp(-(x + margin)). Over such frames, the mean of exp(evidence), summed over
    all attitudes and sets of k matches, is the prior probability of k matches: that of `log_ways`,
    here with a Poisson number of stars. The volume of residuals that leave at least x then gives
    the mean number of attitudes above x: 2 k - 3 degrees of freedom, chi-square as of true stars.

    Parameters
    ----------
    matches, n : int
        Matches, at least 3, and centroids of the frame.
    in_view : float
        Stars in a field, the mean over the sky.
    """
    k, prior = matches, 0.0
    for density in DENSITIES:
        m = in_view * density
        prior += _more_than(k + 3, m) / m**4 / len(DENSITIES)
    prior *= 4.0 * (k + 1) * (k + 2) * (k + 3) * (n + 1) / (n - k + 1)
    volume = 0.5 * math.log(2.0 * math.pi * (k - 1.5))
    return volume - math.log(max(prior, 1e-300)) - REPORTED


@borrowing_kernel
def _more_than(k, mean):
    """Return the probability that a Poisson variable is more than k."""
    if mean > k + 1.0:  # the sum of the others converges, and the result does not cancel
        term = total = math.exp(-mean)
        for j in range(1, k + 1):
            term *= mean / j
            total += term
        return 1.0 - total
    term = total = math.exp((k + 1) * math.log(mean) - mean - math.lgamma(k + 2.0))
    j = k + 2
    while term > 1e-17 * total:
        term *= mean / j
        total += term
        j += 1
    return total


@borrowing_kernel
def match_evidence(star_of, chi2_of, sigma, instrumental, magnitude, rule, in_view, area):
    """Return the matches' part of the log evidence, and their number (compiled).

    Parameters
    ----------
    star_of, chi2_of, sigma, instrumental : (n,)
        Each centroid's star (-1 none), d^2 / s^2, s [rad], -2.5 log10 flux (NaN unknown).
    magnitude : (m,)
        Magnitudes of the stars, by the numbers in `star_of`.
    rule : MatchRule
        How matches are weighed.
    in_view, area : float
        Stars in the image (matched or not), and its solid angle [sr].
    """
    total, matches = 0.0, 0
    for k in range(len(star_of)):
        if star_of[k] >= 0:
            matches += 1
            total += math.log(area / (2.0 * math.pi * sigma[k] * sigma[k])) - 0.5 * chi2_of[k]
    density, zero, scatter = rule.log_density, rule.zero_point, rule.scatter
    if math.isnan(zero):
        zero = median_zero_point(star_of, instrumental, magnitude)
        if not math.isnan(zero):
            tight = _brightness(star_of, instrumental, magnitude, density, zero, 0.5 * scatter)
            loose = _brightness(star_of, instrumental, magnitude, density, zero, scatter)
            more = max(tight, loose)
            total += more + math.log(0.5 * (math.exp(tight - more) + math.exp(loose - more)))
            total -= 3.0  # one more number chosen from the data: ln(range / its error)
    else:
        total += _brightness(star_of, instrumental, magnitude, density, zero, scatter)
    return total - log_ways(len(star_of), matches, in_view), matches


@borrowing_kernel
def _brightness(star_of, instrumental, magnitude, log_density, zero, scatter):
    """Return ln of how much better stars explain the matches' brightness than chance does.

    star_of (n,) int64 is each centroid's star, -1 none, `instrumental` (n,) its magnitude, NaN
    unknown; `magnitude` (m,) are those of the stars. log_density (N_BINS,) is as in `MatchRule`,
    `zero` and `scatter` [mag] as its zero_point and `scatter`.
    """
    total = 0.0
    for k in range(len(star_of)):
        s = star_of[k]
        if s >= 0 and not math.isnan(instrumental[k]):
            difference = magnitude[s] - instrumental[k] - zero
            total += log_brightness_ratio(difference, magnitude[s], log_density, scatter)
    return total


@borrowing_kernel
def _log_determinant(P):
    """Return the log of the determinant of a covariance P (3, 3); of 1e-300 if that is smaller."""
    return math.log(max(determinant3(P), 1e-300))


@borrowing_kernel
def choice_lost(P):
    """Return the attitude's part of the log evidence, all attitudes equally likely (compiled).

    P (3, 3) is the attitude's covariance about the sensor axes [rad^2].
    """
    return 0.5 * _log_determinant(P) + 1.5 * LN_2PI - math.log(8.0 * math.pi**2)


@kernel
def choice_predicted(P, P0, R, R0):
    """Return the attitude's part of the log evidence for a prediction (compiled).

    R and R0 (3, 3) are the attitude and the predicted one, sensor from ICRS, P and P0 (3, 3) their
    covariances about the sensor axes [rad^2].
    """
    C, inverse = P + P0, np.empty((3, 3))
    determinant = invert_symmetric(C, inverse)
    if determinant <= 0.0:
        return -1e9
    # Small rotation R0 -> R: the odd part of R R0'.
    d = np.empty(3)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        kj = R[k, 0] * R0[j, 0] + R[k, 1] * R0[j, 1] + R[k, 2] * R0[j, 2]
        jk = R[j, 0] * R0[k, 0] + R[j, 1] * R0[k, 1] + R[j, 2] * R0[k, 2]
        d[i] = 0.5 * (kj - jk)
    chi2 = 0.0
    for i in range(3):
        for j in range(3):
            chi2 += d[i] * inverse[i, j] * d[j]
    return 0.5 * (_log_determinant(P) - math.log(determinant)) - 0.5 * chi2
