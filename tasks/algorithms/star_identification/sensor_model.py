"""What a sensor's stars tell about it: centroid error, faintest star, zero point of brightness."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq
from scipy.special import polygamma, psi

from epipole.tasks.algorithms.star_identification.centroids import RawCentroids
from epipole.tasks.algorithms.star_identification.frame import (
    FrameCentroids,
    Search,
    Solution,
    identify_predicted,
)
from epipole.tasks.algorithms.star_identification.star_grid import Sky

# -- What a sensor's stars tell about it: centroid error, faintest star, zero point of brightness.

Array = npt.NDArray[np.float64]

# Flux that scatters more than this about the catalogue is not used [mag].
USELESS_SCATTER_MAG = 1.0
MAGNITUDE_STEP = 0.25
# Errors beside stated ones that are tried, over the median of these, which must differ by this
# share; and the log evidence that proves one.
FLOORS, UNLIKE, CLEARLY = (0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 8.0), 0.2, 12.0


class Scale(NamedTuple):
    """Residuals over stated errors: their rms, and its degrees of freedom."""

    scale: float
    dof: int


def residual_scale(solutions: list[Solution | None]) -> Scale:
    """Return the rms per axis of normalised residuals over all solutions."""
    solved = [s for s in solutions if s is not None]
    star = np.concatenate([np.empty(0, np.int64), *[s.star for s in solved]])
    chi2 = np.concatenate([np.empty(0), *[s.chi2 for s in solved]])
    return scale_of(star, chi2, len(solved))


def scale_of(star: npt.NDArray[np.int64], chi2: Array, n_solved: int) -> Scale:
    """Return the rms per axis of normalised residuals of n_solved frames.

    star, chi2 : (N,), (N,), each centroid's star (-1 none) and squared distance over sigma squared
    """
    matched = star >= 0
    dof = 2 * int(matched.sum()) - 3 * n_solved
    return Scale(float(np.sqrt(chi2[matched].sum() / dof)) if dof > 0 else 1.0, dof)


def is_significant(residuals: Scale) -> bool:
    """Tell whether residuals contradict the stated errors, by 5 % and by three sigma."""
    return abs(residuals.scale - 1) > max(0.05, 3 / np.sqrt(2 * max(residuals.dof, 1)))


def zero_point(
    frames: list[FrameCentroids], solutions: list[Solution | None], sky: Sky
) -> tuple[float, float]:
    """Return the median of star minus instrumental magnitude, and its scatter; NaN without flux."""
    differences = []
    for frame, solution in zip(frames, solutions, strict=True):
        if solution is not None:
            at = solution.star >= 0
            differences.append(
                sky.catalogue.magnitude[solution.star[at]] - frame.instrumental_mag[at]
            )
    known = np.concatenate(differences) if differences else np.empty(0)
    known = known[np.isfinite(known)]
    if len(known) < 8:
        return np.nan, np.nan
    middle = float(np.median(known))
    return middle, 1.4826 * float(np.median(np.abs(known - middle)))


def rematch(
    frames: list[FrameCentroids], solutions: list[Solution | None], sky: Sky, how: Search
) -> list[Solution | None]:
    """Return the frames identified again near known attitudes, as with other errors or a deeper
    sky."""
    out: list[Solution | None] = []
    for frame, solution in zip(frames, solutions, strict=True):
        if solution is None:
            out.append(None)
            continue
        near = solution.cov_rad2 + np.eye(3) * float(np.median(frame.sigma_rad)) ** 2
        out.append(identify_predicted(frame, sky, solution.R_sensor_from_icrs, near, how, True))
    return out


def likeliest_floor(
    spots: RawCentroids, solutions: list[Solution | None], sky: Sky, how: Search, scale: float
) -> float:
    """Return the error [px] to add in quadrature to the stated sigmas.

    0 where none is needed, or where the stated sigmas times `scale` explain the frames as well.

    Stated errors of photons alone leave out those of pixels, of the lens and of the catalogue. So
    the brightest stars lie many of their sigmas off. The evidence of solved frames decides.

    Parameters
    ----------
    spots
        The frames, with stated errors.
    solutions, sky, scale
        Of these frames, with the stated errors times `scale`. With a floor, these are not scaled.
    """
    known = spots.sigma_px[np.isfinite(spots.sigma_px)]
    if not len(known) or np.ptp(np.quantile(known, [0.1, 0.9])) < UNLIKE * np.median(known):
        return 0.0
    floors_px = np.concatenate([[0.0], np.multiply(FLOORS, np.median(known))])
    evidence = []
    for floor_px in floors_px:
        frames = spots.with_floor(floor_px).frames(1.0 if floor_px else scale).each()
        again = rematch(frames, solutions, sky, how)
        evidence.append(sum(s.evidence for s in again if s is not None))
    best = int(np.argmax(evidence))
    return float(floors_px[best]) if evidence[best] > evidence[0] + CLEARLY else 0.0


def faintest_star(
    frames: list[FrameCentroids],
    solutions: list[Solution | None],
    deep: Sky,
    gate_sigma: float,
    least: float,
) -> float:
    """Return the magnitude to which matches stand out from chance.

    `solutions` are of the deep sky. In steps of a quarter magnitude, the sensor detects the stars
    of a step if more than a tenth of those in view are matched, and three times as many as by
    chance.

    Parameters
    ----------
    least
        The magnitude to start at: brighter stars are needed for identification in any case.
    """
    edges = np.arange(least, deep.catalogue.magnitude[-1] + MAGNITUDE_STEP, MAGNITUDE_STEP)
    if len(edges) < 2:
        return least
    in_view, matched, by_chance = np.zeros((3, len(edges) - 1))
    for frame, solution in zip(frames, solutions, strict=True):
        if solution is None:
            continue
        R = solution.R_sensor_from_icrs
        x0, x1, y0, y1 = frame.optics.box
        ahead = deep.catalogue.u_icrs @ R[2] > np.cos(frame.optics.half_diagonal_rad)
        v = deep.catalogue.u_icrs[ahead] @ R.T
        x, y = v[:, 0] / v[:, 2], v[:, 1] / v[:, 2]
        inside = (x > x0) & (x < x1) & (y > y0) & (y < y1)
        n = np.histogram(deep.catalogue.magnitude[ahead][inside], edges)[0]
        star = solution.star[solution.star >= 0]
        in_view += n
        matched += np.histogram(deep.catalogue.magnitude[star], edges)[0]
        disc = np.pi * gate_sigma**2 * np.median(frame.sigma_rad) ** 2
        by_chance += n * (len(frame.u) - len(star)) * disc / frame.optics.solid_angle_sr
    good = (matched > 0.1 * in_view) & (matched > 3 * by_chance)
    # A step without a star in a narrow field is skipped. One with few stars may fail by chance.
    last, poor = -1, 0
    for i in np.flatnonzero(in_view):
        poor = 0 if good[i] else poor + 1
        if good[i]:
            last = int(i)
        if poor == 3:
            break
    return float(edges[last + 1])


# -- How good the centroids of each frame are, where a log does not say: from the stars' residuals.
#
# Frames of one sensor may differ: it turns faster, the image is blurred, exposures change. A
# frame's residuals say so, but with few stars the estimate is noisy. So each frame's variance is
# shrunk towards the sensor's mean (empirical Bayes: Smyth, Statistical Applications in Genetics
# and Molecular Biology 3, 2004, article 3, sections 4 and 6.2).

MIN_FRAMES = 10  # of which the scatter is known
SIGNIFICANT = 4.0  # sigma by which residuals of frames differ more than chance makes them
MIN_SCALE = 0.02  # of a frame: rounding is not measured
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
    if told.sum() < MIN_FRAMES:
        return common
    half = dof[told] / 2.0
    variance = np.maximum(square_sum[told] / dof[told], (MIN_SCALE * common[0]) ** 2)
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
