"""The model of a sensor, learned from its identified frames.

The stars of identified frames tell the sensor's centroid error (the residuals against the stated
errors), the zero point of its brightness, and its faintest star; `learn` puts them into a
`SensorModel`. `frame_scales` tells the centroid error of each frame by itself.
"""

from typing import NamedTuple, Protocol

import numpy as np
from scipy.optimize import brentq
from scipy.special import polygamma, psi

from epipole.schemas.arrays import Array, Integers
from epipole.tasks.algorithms.star_identification.centroids import RawCentroids
from epipole.tasks.algorithms.star_identification.frame import (
    FieldOfView,
    FrameCentroids,
    MatchSettings,
    Solution,
    identify_predicted,
)
from epipole.tasks.algorithms.star_identification.star_grid import Sky, SkyGrid
from epipole.tasks.algorithms.star_identification.star_pairs import PairTable

USELESS_SCATTER_MAG = 1.0  # flux that scatters more about the catalogue is not used
MIN_SCATTER_MAG = 0.15  # assumed of brightness: a sample may scatter less than all frames
MAGNITUDE_STEP = 0.25  # in which the faintest star is searched for
DEEPER_MAG = 2.0  # how far beyond the first guess it is searched for
# Solved frames in which the faintest star is searched for: a match in the deep sky takes five times
# as long as in that of the sensor, and neighbouring frames show the same stars.
LIMIT_FRAMES = 8
TURNED_RAD = 0.05  # stars are chosen anew for a frame that is turned by more than this
MIN_FLUXES = 8  # matches with a flux from which a zero point is taken
# Floors that are tried, as factors on the median of the stated errors.
FLOORS = (0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 8.0)
# They are tried only if the stated errors differ: their 10 % and 90 % quantiles, by this share of
# the median. A floor is added if it gains this much log evidence.
MIN_ERROR_RANGE, MIN_FLOOR_GAIN = 0.2, 12.0
# `learn` rescales the errors until they change by less than this share, or this often: too narrow a
# gate cuts residuals off, so that each step corrects only a part.
SETTLED_SCALE, MAX_RESCALINGS = 0.01, 12
MIN_LEARN_DOF = 10  # degrees of freedom of residuals from which errors are rescaled


class Skies(Protocol):
    """The source of skies; it may cache them, as sensors share them."""

    def limit_for(self, stars_per_sr: float) -> float:
        """Return the magnitude limit with this mean density."""

    def sky(self, limit: float) -> Sky:
        """Return the sky to a magnitude."""

    def grid(self, limit: float, radius_rad: float) -> SkyGrid:
        """Return its grid."""

    def pairs(self, limit: float, optics: FieldOfView) -> PairTable:
        """Return its pattern pairs for a camera."""


class SensorModel(NamedTuple):
    """What has been learned of a sensor.

    scale : factor on the stated centroid errors; pixels where none are stated
    limit : magnitude of the faintest star that is searched for
    limit_is_open : the settings do not give it
    matching : how frames are judged, with the zero point of brightness and its scatter
    use_flux : brightness is compared
    adjusted : centroid errors are not the stated ones, or none are stated
    """

    scale: float
    limit: float
    limit_is_open: bool
    matching: MatchSettings
    use_flux: bool
    adjusted: bool


# Centroid error.


class Scale(NamedTuple):
    """Rms of residuals over stated errors, per axis, and its degrees of freedom."""

    scale: float
    dof: int


def residual_scale(solutions: list[Solution | None]) -> Scale:
    """Return the rms per axis of normalised residuals over all solutions."""
    solved = [s for s in solutions if s is not None]
    star = np.concatenate([np.empty(0, np.int64), *[s.star for s in solved]])
    chi2 = np.concatenate([np.empty(0), *[s.chi2 for s in solved]])
    return scale_of(star, chi2, len(solved))


def scale_of(star: Integers, chi2: Array, n_solved: int) -> Scale:
    """Return the rms per axis of normalised residuals of n_solved frames.

    star, chi2 : (N,), (N,), each centroid's star (-1 none) and squared distance over sigma squared
    """
    matched = star >= 0
    dof = 2 * int(matched.sum()) - 3 * n_solved
    return Scale(float(np.sqrt(chi2[matched].sum() / dof)) if dof > 0 else 1.0, dof)


def is_significant(residuals: Scale) -> bool:
    """Return whether residuals contradict the stated errors, by 5 % and by three sigma."""
    return abs(residuals.scale - 1) > max(0.05, 3 / np.sqrt(2 * max(residuals.dof, 1)))


# Brightness.


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
    if len(known) < MIN_FLUXES:
        return np.nan, np.nan
    middle = float(np.median(known))
    return middle, 1.4826 * float(np.median(np.abs(known - middle)))


# Errors beside the stated ones.


def rematch(
    frames: list[FrameCentroids],
    solutions: list[Solution | None],
    sky: Sky,
    matching: MatchSettings,
) -> list[Solution | None]:
    """Return the frames identified again near known attitudes, as with other errors or a deeper
    sky."""
    out: list[Solution | None] = []
    for frame, solution in zip(frames, solutions, strict=True):
        if solution is None:
            out.append(None)
            continue
        near = solution.cov_rad2 + np.eye(3) * float(np.median(frame.sigma_rad)) ** 2
        out.append(
            identify_predicted(frame, sky, solution.R_sensor_from_icrs, near, matching, True)
        )
    return out


def likeliest_floor(
    centroids: RawCentroids,
    solutions: list[Solution | None],
    sky: Sky,
    matching: MatchSettings,
    scale: float,
) -> float:
    """Return the error [px] to add in quadrature to the stated sigmas.

    0 where none is needed, or where the stated sigmas times `scale` explain the frames as well.

    Stated errors of photons alone leave out those of pixels, of the lens and of the catalogue. So
    the brightest stars lie many of their sigmas off. The evidence of solved frames decides.

    Parameters
    ----------
    centroids
        Of the frames, with stated errors.
    solutions, sky, scale
        Of these frames, with the stated errors times `scale`. With a floor, these are not scaled.
    """
    known = centroids.sigma_px[np.isfinite(centroids.sigma_px)]
    if not len(known) or np.ptp(np.quantile(known, [0.1, 0.9])) < MIN_ERROR_RANGE * np.median(
        known
    ):
        return 0.0
    floors_px = np.concatenate([[0.0], np.multiply(FLOORS, np.median(known))])
    evidence = []
    for floor_px in floors_px:
        frames = centroids.with_floor(floor_px).frames(1.0 if floor_px else scale).each()
        again = rematch(frames, solutions, sky, matching)
        evidence.append(sum(s.evidence for s in again if s is not None))
    best = int(np.argmax(evidence))
    return float(floors_px[best]) if evidence[best] > evidence[0] + MIN_FLOOR_GAIN else 0.0


# Faintest star.


def faintest_star(
    frames: list[FrameCentroids],
    solutions: list[Solution | None],
    deep: Sky,
    gate_sigma: float,
    start: float,
) -> float:
    """Return the magnitude to which matches stand out from chance.

    `solutions` are of the `deep` sky. Stars are counted in steps of a quarter magnitude. The sensor
    detects those of a step if more than a tenth of the stars in view are matched, and more than
    three times as many as expected of false matches.

    Parameters
    ----------
    start
        Magnitude to start at: brighter stars are needed for identification in any case.
    """
    edges = np.arange(start, deep.catalogue.magnitude[-1] + MAGNITUDE_STEP, MAGNITUDE_STEP)
    if len(edges) < 2:
        return start
    in_view, matched, expected_false = np.zeros((3, len(edges) - 1))
    axis, u, magnitude = np.empty(0), np.empty((0, 3)), np.empty(0)  # the stars around an axis
    for frame, solution in zip(frames, solutions, strict=True):
        if solution is None:
            continue
        R = solution.R_sensor_from_icrs
        x0, x1, y0, y1 = frame.optics.box
        if not len(axis) or R[2] @ axis < np.cos(TURNED_RAD):
            axis, reach = R[2], min(frame.optics.half_diagonal_rad + TURNED_RAD, np.pi)
            around = np.flatnonzero(deep.catalogue.u_icrs @ axis > np.cos(reach))
            u, magnitude = deep.catalogue.u_icrs[around], deep.catalogue.magnitude[around]
        ahead = u @ R[2] > np.cos(frame.optics.half_diagonal_rad)
        v = u[ahead] @ R.T
        x, y = v[:, 0] / v[:, 2], v[:, 1] / v[:, 2]
        inside = (x > x0) & (x < x1) & (y > y0) & (y < y1)
        n = np.histogram(magnitude[ahead][inside], edges)[0]
        star = solution.star[solution.star >= 0]
        in_view += n
        matched += np.histogram(deep.catalogue.magnitude[star], edges)[0]
        disc = np.pi * gate_sigma**2 * np.median(frame.sigma_rad) ** 2
        expected_false += n * (len(frame.u) - len(star)) * disc / frame.optics.solid_angle_sr
    good = (matched > 0.1 * in_view) & (matched > 3 * expected_false)
    # A step without a star in a narrow field is skipped. One with few stars may fail accidentally.
    last, poor = -1, 0
    for i in np.flatnonzero(in_view):
        poor = 0 if good[i] else poor + 1
        if good[i]:
            last = int(i)
        if poor == 3:
            break
    return float(edges[last + 1])


# The whole model.


def learn(
    centroids: RawCentroids, solutions: list[Solution | None], skies: Skies, model: SensorModel
) -> SensorModel:
    """Return the model with centroid error, zero point and faintest star from solved frames."""
    if not any(solutions):
        return model
    sky, scale, adjusted = skies.sky(model.limit), model.scale, model.adjusted
    for _ in range(MAX_RESCALINGS):
        residuals = residual_scale(solutions)
        adjusted |= is_significant(residuals)
        settled = abs(residuals.scale - 1) < SETTLED_SCALE
        if residuals.dof < MIN_LEARN_DOF or not adjusted or settled:
            break
        frames = centroids.frames(scale * residuals.scale).each()
        again = rematch(frames, solutions, sky, model.matching)
        if not any(again):
            break
        scale, solutions = scale * residuals.scale, again
    zero, scatter = zero_point(centroids.frames(scale).each(), solutions, sky)
    use_flux = not scatter > USELESS_SCATTER_MAG
    matching = model.matching
    if use_flux and not np.isnan(zero):
        # The scatter is that of the sample; all frames may scatter by a fifth more.
        scatter = min(max(1.2 * scatter, MIN_SCATTER_MAG), USELESS_SCATTER_MAG)
        matching = matching._replace(zero_point_mag=zero, scatter_mag=scatter)
    model = model._replace(scale=scale, matching=matching, use_flux=use_flux, adjusted=adjusted)
    return model._replace(limit=_learned_limit(centroids, solutions, skies, model))


def _learned_limit(
    centroids: RawCentroids, solutions: list[Solution | None], skies: Skies, model: SensorModel
) -> float:
    """Return the magnitude of the faintest star that the sensor detects, or that settings give."""
    if not model.limit_is_open:
        return model.limit
    every = np.flatnonzero([s is not None for s in solutions])
    rows = every[evenly_spaced(len(every), LIMIT_FRAMES)]
    frames = centroids.frames(model.scale, model.use_flux).each()
    frames, solutions = [frames[i] for i in rows], [solutions[i] for i in rows]
    sky, deep = skies.sky(model.limit), skies.sky(model.limit + DEEPER_MAG)
    matched = [sky.catalogue.magnitude[s.star[s.star >= 0]] for s in solutions if s is not None]
    start = float(np.floor(4 * np.median(np.concatenate(matched))) / 4)
    deeper = rematch(frames, solutions, deep, model.matching)
    return faintest_star(frames, deeper, deep, model.matching.gate_sigma, start)


def evenly_spaced(n: int, wanted: int) -> Integers:
    """Return `wanted` of n rows, evenly spaced; all where there are fewer."""
    return np.unique(np.linspace(0, max(n - 1, 0), wanted).astype(np.int64))[:n]


# Centroid error of each frame.
#
# Frames of one sensor may differ: it turns faster, the image is blurred, exposures change. A
# frame's residuals say so, but with few stars the estimate is noisy. So each frame's variance is
# shrunk towards the sensor's mean (empirical Bayes: Smyth, Statistical Applications in Genetics
# and Molecular Biology 3, 2004, article 3, sections 4 and 6.2).

MIN_FRAMES = 10  # from which the scatter between frames is estimated
SIGNIFICANT = 4.0  # [sigma] by which the scatter between frames exceeds that of chance
MIN_SCALE = 0.02  # lowest error of a frame over the sensor's: residuals may be rounded to 0
# Frames do not differ if the others tell a frame's error as well as this number of residuals of
# its stars would.
MAX_PRIOR_DOF = 200.0


def frame_scales(square_sum: Array, dof: Integers) -> Array:
    """Return each frame's rms of residuals per axis; one for all where frames do not differ.

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
    has_attitude = dof > 0
    if not has_attitude.any():
        return np.ones(len(dof))
    common = np.full(len(dof), np.sqrt(square_sum[has_attitude].sum() / dof[has_attitude].sum()))
    if has_attitude.sum() < MIN_FRAMES:
        return common
    half = dof[has_attitude] / 2.0
    variance = np.maximum(
        square_sum[has_attitude] / dof[has_attitude], (MIN_SCALE * common[0]) ** 2
    )
    log_variance = np.log(variance) - psi(half) + np.log(half)  # without the bias of few stars
    sampling = polygamma(1, half)
    middle = log_variance.mean()
    excess = float(np.mean((log_variance - middle) ** 2 - sampling))
    # The variance of a squared log chi-square variable includes its fourth cumulant.
    excess_sigma = np.sqrt(np.mean(2.0 * sampling**2 + polygamma(3, half)) / len(half))
    if excess < SIGNIFICANT * excess_sigma:
        return common
    prior_dof = _inverse_trigamma(excess)
    if prior_dof > MAX_PRIOR_DOF:
        return common
    prior = np.exp(middle + psi(prior_dof / 2.0) - np.log(prior_dof / 2.0))
    scales = np.full(len(dof), np.exp(0.5 * middle))
    scales[has_attitude] = np.sqrt(
        (prior_dof * prior + square_sum[has_attitude]) / (prior_dof + dof[has_attitude])
    )
    return scales


def _inverse_trigamma(value: float) -> float:
    """Return twice the number whose trigamma function has this value."""
    return float(2.0 * brentq(lambda x: polygamma(1, x) - value, 1e-3, 1e6))
