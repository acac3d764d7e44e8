"""All frames of one sensor over a span: its errors and its faintest star are learned from a sample,
then every frame is identified."""

from functools import partial
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.star_identification.frames.frame import FieldOfView, Search, Solution
from epipole.tasks.algorithms.star_identification.frames.spots import (
    SensorCentroids,
    Solutions,
    UnscaledCentroids,
    unsolved,
)
from epipole.tasks.algorithms.star_identification.sensor_limits import (
    USELESS_SCATTER_MAG,
    faintest_star,
    is_significant,
    rematch,
    residual_scale,
    scale_of,
    zero_point,
)
from epipole.tasks.algorithms.star_identification.sequence import Priors, identify_sequence
from epipole.tasks.algorithms.star_identification.sky.camera_sky import Sky
from epipole.tasks.algorithms.star_identification.sky.pair_table import PairTable
from epipole.tasks.algorithms.star_identification.sky.sky_grid import SkyGrid

Array = npt.NDArray[np.float64]

SAMPLED = (4, 6)  # number of runs of frames, and their length, from which a sensor is learned
PROBED = (3, 2)  # the same, of this sample, to try scales of the errors until one works
KNOWN_SCALES = (1.0, 3.0, 0.4)  # factors to try on errors that the log or the settings state
UNKNOWN_SCALES_PX = (0.5, 1.5, 0.15)  # errors to try where none are stated
LEAST_SPREAD_MAG = 0.15  # of brightness: a sample may scatter less than all
DEEPER_MAG = 2.0  # how far beyond the first guess the faintest star is searched for


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


class IdentifiedSensor(NamedTuple):
    """A sensor's solutions.

    solutions, status : of each frame, see `identify_sequence`
    sky : the solutions' stars are rows of its catalogue
    sigma_scale : factor on the centroid errors as stated, or on 1 px where none are
    """

    solutions: Solutions
    status: list[str | None]
    sky: Sky
    sigma_scale: float


def identify_sensor(
    t_s: Array,
    spots: UnscaledCentroids,
    priors: Priors,
    skies: Skies,
    magnitude_limit: float | None,
    how: Search,
) -> IdentifiedSensor:
    """Identify the stars of a sensor's frames, which are in order of time.

    Errors that are not stated are estimated from the residuals. Stated errors are scaled where
    residuals contradict them beyond doubt, so that reported sigmas are true.
    """
    spots, stated = _fill_sigmas(spots)
    usable = np.flatnonzero(spots.counts >= 4)
    limit = magnitude_limit
    if limit is None:
        density = 1.2 * float(np.median(spots.counts[usable])) if len(usable) else 10.0
        limit = skies.limit_for(density / spots.optics[0].solid_angle_sr)
    known = _Known(1.0, limit, magnitude_limit is None, how, True, not stated)
    whole = _Sample(t_s, spots, priors)
    sample = whole.take(usable[_runs(len(usable), SAMPLED)])
    known, sampled = _first_scale(
        sample, skies, known, KNOWN_SCALES if stated else UNKNOWN_SCALES_PX
    )
    known = _learn(sample.spots, sampled, skies, known)
    solutions, status = _identify(whole, skies, known)
    if not any(sampled) and solutions.solved.any():  # the sample was poor: learn from the others
        solved = np.flatnonzero(solutions.solved)
        rows = solved[_runs(len(solved), SAMPLED)]
        known = _learn(whole.take(rows).spots, [solutions.frame(i) for i in rows], skies, known)
        solutions, status = _identify(whole, skies, known)
    residuals = scale_of(solutions.star, solutions.chi2, int(solutions.solved.sum()))
    if residuals.dof > 0 and (known.adjusted or is_significant(residuals)):
        known = known._replace(scale=known.scale * residuals.scale)
        solutions = solutions.rescaled(residuals.scale)
    return IdentifiedSensor(solutions, status, skies.sky(known.limit), known.scale)


class _Known(NamedTuple):
    """What has been learned of a sensor."""

    scale: float  # on the errors as stated, or on 1 px
    limit: float  # faintest star searched for
    limit_is_open: bool  # the settings do not state it
    how: Search
    use_flux: bool  # brightness is compared
    adjusted: bool  # errors are not as stated, or not stated


class _Sample(NamedTuple):
    t_s: Array
    spots: UnscaledCentroids
    priors: Priors

    def take(self, rows: npt.NDArray[np.int64]) -> "_Sample":
        priors = Priors(self.priors.R_sensor_from_icrs[rows], self.priors.sigma_rad[rows])
        return _Sample(self.t_s[rows], self.spots.take(rows), priors)


def _runs(n: int, wanted: tuple[int, int]) -> npt.NDArray[np.int64]:
    """Return rows of n in runs (number, length), spread evenly: the first frame of a run has to be
    searched, the others can be followed."""
    count, length = wanted
    starts = np.linspace(0, max(n - length, 0), count).astype(np.int64)
    rows = np.unique(starts[:, None] + np.arange(length))
    return rows[rows < n]


def _fill_sigmas(spots: UnscaledCentroids) -> tuple[UnscaledCentroids, bool]:
    """Return the centroids with the median for missing sigmas, and whether any sigma is stated."""
    if not np.isfinite(spots.sigma_px).any():
        return spots, False
    middle = float(np.nanmedian(spots.sigma_px))
    return spots._replace(sigma_px=np.where(np.isnan(spots.sigma_px), middle, spots.sigma_px)), True


def _learn(
    spots: UnscaledCentroids, solutions: list[Solution | None], skies: Skies, known: _Known
) -> _Known:
    """Return what is known, with errors, zero point and faintest star from solved frames."""
    if not any(solutions):
        return known
    sky, scale, adjusted = skies.sky(known.limit), known.scale, known.adjusted
    for _ in range(12):  # too narrow a gate cuts residuals off: it takes more than a few steps
        residuals = residual_scale(solutions)
        adjusted |= is_significant(residuals)
        if residuals.dof < 10 or not adjusted or abs(residuals.scale - 1) < 0.01:
            break
        again = rematch(spots.frames(scale * residuals.scale).each(), solutions, sky, known.how)
        if not any(again):
            break
        scale, solutions = scale * residuals.scale, again
    zero, scatter = zero_point(spots.frames(scale).each(), solutions, sky)
    use_flux = not scatter > USELESS_SCATTER_MAG
    how = known.how
    if use_flux and not np.isnan(zero):
        spread = min(max(1.2 * scatter, LEAST_SPREAD_MAG), USELESS_SCATTER_MAG)
        how = how._replace(zero_point_mag=zero, spread_mag=spread)
    known = known._replace(scale=scale, how=how, use_flux=use_flux, adjusted=adjusted)
    return known._replace(limit=_faintest(spots, solutions, skies, known))


def _faintest(
    spots: UnscaledCentroids, solutions: list[Solution | None], skies: Skies, known: _Known
) -> float:
    """Return the magnitude of the faintest star that the sensor detects, or that settings state."""
    if not known.limit_is_open:
        return known.limit
    frames = spots.frames(known.scale, known.use_flux).each()
    sky, deep = skies.sky(known.limit), skies.sky(known.limit + DEEPER_MAG)
    matched = [sky.catalogue.magnitude[s.star[s.star >= 0]] for s in solutions if s is not None]
    least = float(np.floor(4 * np.median(np.concatenate(matched))) / 4)
    deeper = rematch(frames, solutions, deep, known.how)
    return faintest_star(frames, deeper, deep, known.how.gate_sigma, least)


def _first_scale(
    sample: _Sample, skies: Skies, known: _Known, scales: tuple[float, ...]
) -> tuple[_Known, list[Solution | None]]:
    """Return what is known, with a scale of errors that identifies frames, and the solutions."""
    probe = sample.take(_runs(len(sample.t_s), PROBED))
    quick = known.how._replace(time_limit_s=known.how.time_limit_s / 4)
    flux = bool(np.isfinite(probe.spots.instrumental_mag).any())
    best, best_count = known._replace(scale=scales[0]), 0
    # Flux may be unrelated to brightness; then it misleads.
    for use_flux, scale in [(f, s) for f in ([True, False] if flux else [True]) for s in scales]:
        if not use_flux and best_count:
            break
        tried = known._replace(scale=scale, how=quick, use_flux=use_flux)
        count = int(_identify(probe, skies, tried)[0].solved.sum())
        if count > best_count:
            best, best_count = known._replace(scale=scale, use_flux=use_flux), count
        if 3 * count >= 2 * len(probe.t_s):
            break
    if best_count == 0:
        return best, [None] * len(sample.t_s)
    return best, _identify(sample, skies, best)[0].each()


def _identify(sample: _Sample, skies: Skies, known: _Known) -> tuple[Solutions, list[str | None]]:
    """Return the frames' solutions and status."""
    if not len(sample.t_s):
        return unsolved(sample.spots.first), []
    frames = sample.spots.frames(known.scale, known.use_flux)
    sky, grid = skies.sky(known.limit), skies.grid(known.limit, _grid_radius(frames, known.how))
    pairs = partial(skies.pairs, known.limit, frames.optics[0])
    return identify_sequence(sample.t_s, frames, sample.priors, sky, grid, pairs, known.how)


def _grid_radius(frames: SensorCentroids, how: Search) -> float:
    """Return the widest look-up [rad], rounded up so that similar sensors share a grid."""
    sigma = frames.sigma_rad
    widest = 2.5 * how.gate_sigma * float(np.median(sigma)) if len(sigma) else 1e-3
    return float(min(2.0 ** (np.ceil(2 * np.log2(widest)) / 2), 0.1))
