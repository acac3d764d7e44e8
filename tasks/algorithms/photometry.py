"""Magnitudes from fluxes: each frame's zero point from its stars, with honest errors.

A sensor's passband is not V: a star's magnitude differs by about 0.1 with its colour, the same in
all frames. That scatter is an error of the zero point. The error of a measured flux is estimated
from stars that are measured repeatedly.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from epipole.schemas.arrays import Array, Indices
from epipole.tasks.algorithms.kernels import kernel

MIN_VALUES = 20  # minimum number of residuals for an estimate of the variance
MIN_PER_BIN = 25  # minimum number of residuals per bin of flux
MAX_BINS = 8  # maximum number of bins of flux
UNKNOWN_STAR_MAG2 = 0.3**2  # variance of a star with too few residuals: colours, variables
MIN_MAG2 = 1e-8  # minimum of a variance: weights stay finite
CLIP_SIGMA = 3.5  # larger residuals: variable, blended or wrong in the catalogue
REJECTED_WEIGHT = 1e-6  # factor of the weight beyond `CLIP_SIGMA`
ITERATIONS = 3  # of zero points and their variance model
MAX_LEVERAGE = 0.8  # largest share of a star image in the means that are subtracted from it
MAX_IMAGES = 5000  # star images that show the error of fluxes, and the rest of the frame: enough
SWEEPS = 10  # each subtracts the mean residuals of frames, then those of stars
GAUSSIAN = 1.4826  # standard deviation over median absolute deviation


class FluxScale(NamedTuple):
    """How fluxes of one sensor become magnitudes, a row per frame or per flux.

    zero_mag : (n,) float
        Magnitude of a flux of 1; NaN for a frame without measured stars.
    zero_variance_mag2 : (n,) float
        Its variance.
    floor_mag2, photon_mag2 : (n,) float
        The variance of one measured magnitude is ``floor_mag2 + photon_mag2 / flux``.
    """

    zero_mag: Array
    zero_variance_mag2: Array
    floor_mag2: Array
    photon_mag2: Array

    def magnitudes(self, flux: Array) -> tuple[Array, Array]:
        """Return the magnitude of a flux in each row, and its 1-sigma error [mag].

        NaN without a zero point or a flux.
        """
        known = np.where((flux > 0) & np.isfinite(flux), flux, np.nan)
        variance = self.zero_variance_mag2 + self.floor_mag2 + self.photon_mag2 / known
        return self.zero_mag - 2.5 * np.log10(known), np.sqrt(variance)


def flux_scale(
    frame: Indices, star: Indices, magnitude: Array, flux: Array, n_frames: int
) -> FluxScale:
    """Return how fluxes become magnitudes, from the identified stars of one sensor.

    Parameters
    ----------
    frame, star : (n,) int
        Frame and catalogue number of each star image.
    magnitude, flux : (n,) float
        V in the catalogue, and the measured flux; NaN where unknown.
    """
    usable = np.isfinite(magnitude) & (flux > 0) & np.isfinite(flux)
    frame, star, magnitude = frame[usable], star[usable], magnitude[usable]
    offset = magnitude + 2.5 * np.log10(flux[usable])
    count = np.bincount(frame, minlength=n_frames)
    zero = medians(frame, offset, n_frames)
    # The expected flux: a star with a wrong flux must not be among the bright ones.
    flux = 10 ** (-0.4 * (magnitude - zero[frame]))
    of_star = (UNKNOWN_STAR_MAG2, 0.0)
    for _ in range(ITERATIONS):
        residual = offset - zero[frame]
        of_star = _variance_by_flux(*_with_others(residual, flux, count[frame]))
        weight = 1.0 / _variance(of_star, flux)
        # Not zero: a rejected star still counts in a frame without others.
        weight[np.abs(residual) > CLIP_SIGMA / np.sqrt(weight)] *= REJECTED_WEIGHT
        total = np.bincount(frame, weight, n_frames)
        with np.errstate(invalid="ignore", divide="ignore"):
            zero, variance = np.bincount(frame, weight * offset, n_frames) / total, 1.0 / total
    zero[count == 0] = variance[count == 0] = np.nan
    of_fluxes = _repeat_variance(frame, star, offset, flux, n_frames) or of_star
    return FluxScale(zero, variance, *(np.full(n_frames, value) for value in of_fluxes))


def _repeat_variance(
    frame: Indices, star: Indices, offset: Array, flux: Array, n_frames: int
) -> tuple[float, float] | None:
    """Return (floor, photon) of a flux's variance, from stars that are measured repeatedly.

    It is the scatter about an offset of each star plus one of each frame. None if too few stars are
    measured repeatedly. `offset` (n,) [mag] is the magnitude in the catalogue less that of the flux
    alone.
    """
    some = frame <= np.sort(frame)[: MAX_IMAGES + 1].max(initial=-1)  # whole frames
    frame, offset, flux = frame[some], offset[some], flux[some]
    _, star = np.unique(star[some], return_inverse=True)
    often = (np.bincount(star)[star] > 1) & (np.bincount(frame, minlength=n_frames)[frame] > 1)
    frame, star, offset, flux = frame[often], star[often], offset[often], flux[often]
    if len(offset) - len(np.unique(star)) - len(np.unique(frame)) < MIN_VALUES:
        return None
    model = (1.0, 0.0)  # equal weights first
    for _ in range(ITERATIONS):
        weight = 1.0 / _variance(model, flux)
        total = [np.maximum(np.bincount(group, weight), REJECTED_WEIGHT) for group in (frame, star)]
        residual = offset
        for _ in range(SWEEPS):
            for group, of_group in zip((frame, star), total, strict=True):
                mean = np.bincount(group, weight * residual) / of_group
                residual = residual - mean[group]
        share = weight / total[0][frame] + weight / total[1][star]
        free = share < MAX_LEVERAGE
        residual = residual[free] / np.sqrt(1.0 - share[free])
        model = _variance_by_flux(residual, flux[free])
    return model


def _with_others(residual: Array, flux: Array, count: Indices) -> tuple[Array, Array]:
    """Return the residuals, corrected for the star's share in its frame's mean, and the fluxes."""
    others = count > 1
    n = count[others]
    return residual[others] * np.sqrt(n / (n - 1)), flux[others]


def medians(group: Indices, value: Array, n: int) -> Array:
    """Return the median of the values of each of n groups, (n,); NaN for a group without values."""
    order = np.argsort(group, kind="stable")
    first = np.searchsorted(group[order], np.arange(n + 1))
    out = np.full(n, np.nan)
    _write_medians(first, value[order].astype(float), out)
    return out


@kernel
def _write_medians(first, value, out):
    """Write the median of the values first[k]:first[k + 1] of `value` (m,) to row k of `out` (n,).

    `first` is (n + 1,). A row without values is not written.
    """
    for k in range(len(out)):
        if first[k + 1] > first[k]:
            out[k] = np.median(value[first[k] : first[k + 1]])


def _variance_by_flux(residual: Array, flux: Array) -> tuple[float, float]:
    """Return (floor, photon) of the variance ``floor + photon / flux``, by bins of flux."""
    if len(residual) < MIN_VALUES:
        return UNKNOWN_STAR_MAG2, 0.0
    n_bins = int(np.clip(len(residual) // MIN_PER_BIN, 1, MAX_BINS))
    order = np.argsort(flux, kind="stable")
    variance = (GAUSSIAN * _medians_of_parts(np.abs(residual[order]), n_bins)) ** 2
    variance = np.maximum(variance, MIN_MAG2)
    if n_bins < 3:
        return float(np.mean(variance)), 0.0
    unit = np.median(flux)
    typical = _medians_of_parts(flux[order], n_bins) / unit
    terms = np.stack([np.ones(n_bins), 1.0 / typical], axis=1)
    expected = variance
    for _ in range(ITERATIONS):  # weights by the measured variances alone would favour small ones
        (floor, photon), _ = nnls(terms / expected[:, None], variance / expected)
        expected = np.maximum(terms @ [floor, photon], MIN_MAG2)
    return max(float(floor), MIN_MAG2), float(photon * unit)


def _medians_of_parts(values: Array, n_parts: int) -> Array:
    """Return the medians of parts of about the same length, as of `numpy.array_split`."""
    length, longer = divmod(len(values), n_parts)  # `longer` parts have one more
    head, tail = np.split(values, [longer * (length + 1)])
    rows = head.reshape(longer, length + 1), tail.reshape(n_parts - longer, length)
    return np.concatenate([np.median(part, axis=1) for part in rows])


def _variance(model: tuple[float, float], flux: Array) -> Array:
    return np.asarray(model[0] + model[1] / flux)
