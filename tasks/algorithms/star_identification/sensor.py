"""All frames of one sensor over a span: what it can see is learned first, then every frame
identified with that."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.star_identification.calibration import (
    USELESS_SCATTER_MAG,
    faintest_star,
    is_significant,
    rematch,
    residual_scale,
    zero_point,
)
from epipole.tasks.algorithms.star_identification.frame import Frame, Optics, Search, Solution
from epipole.tasks.algorithms.star_identification.pair_table import PairTable
from epipole.tasks.algorithms.star_identification.sequence import Prior, identify_sequence
from epipole.tasks.algorithms.star_identification.sky import Sky
from epipole.tasks.algorithms.star_identification.sky_grid import SkyGrid

Array = npt.NDArray[np.float64]

N_SAMPLED = 24  # frames from which a sensor's errors and depth are learned
N_PROBED = 6  # of these, tried with each scale of the errors until one works
KNOWN_SCALES = (1.0, 3.0, 0.4)  # of errors that the log or the settings state
UNKNOWN_SCALES_PX = (0.5, 1.5, 0.15)
DEEPER_MAG = 2.0  # how far beyond the first guess of the faintest star is looked


class Skies(Protocol):
    """Where skies come from (and are kept, as sensors share them)."""

    def limit_for(self, stars_per_sr: float) -> float:
        """Return the magnitude limit with this mean density."""

    def sky(self, limit: float) -> Sky:
        """Return the sky to a magnitude."""

    def grid(self, limit: float, radius_rad: float) -> SkyGrid:
        """Return its grid."""

    def pairs(self, limit: float, optics: Optics) -> PairTable:
        """Return its pattern pairs for a camera."""


class Spots(NamedTuple):
    """Centroids of one frame, brightest first, before their errors are settled.

    u, pixel_rad : (n, 3), (n,) float, directions, and the angle a pixel spans there
    sigma_px : (n,) float, NaN where unknown
    instrumental_mag : (n,) float, NaN where unknown
    beta, optics : as in `Frame`
    """

    u: Array
    pixel_rad: Array
    sigma_px: Array
    instrumental_mag: Array
    beta: Array
    optics: Optics


class Identified(NamedTuple):
    """What was found.

    solutions, status : one a frame, see `identify_sequence`
    sky : whose rows the solutions' stars are
    sigma_scale : factor on the centroid errors as stated (or, where not stated, on 1 px)
    """

    solutions: list[Solution | None]
    status: list[str | None]
    sky: Sky
    sigma_scale: float


def frame_of(spots: Spots, scale: float, use_flux: bool = True) -> Frame:
    """Return the frame with its errors scaled; 1 px stands where none is stated."""
    sigma_px = np.where(np.isnan(spots.sigma_px), 1.0, spots.sigma_px) * scale
    mag = spots.instrumental_mag if use_flux else np.full(len(sigma_px), np.nan)
    return Frame(spots.u, sigma_px * spots.pixel_rad, mag, spots.beta, spots.optics)


def identify_sensor(
    t_s: Array,
    spots: Sequence[Spots],
    priors: list[Prior | None],
    skies: Skies,
    magnitude_limit: float | None,
    how: Search,
) -> Identified:
    """Identify the stars of a sensor's frames, which are in order of time.

    Errors that are not stated are estimated from the residuals; those that are get scaled
    where residuals contradict them beyond doubt, so that reported sigmas are honest.
    """
    spots, stated = _fill_sigmas(spots)
    counts = np.array([len(s.u) for s in spots])
    usable = np.flatnonzero(counts >= 4)
    optics = spots[0].optics
    limit = magnitude_limit
    if limit is None:
        density = 1.2 * float(np.median(counts[usable])) if len(usable) else 10.0
        limit = skies.limit_for(density / optics.solid_angle_sr)
    sample = usable[_evenly(len(usable), N_SAMPLED)]
    learned = _learn(_Sample(t_s, spots, priors).take(sample), skies, limit, how, stated)
    use_flux = learned.how is not None
    how = learned.how or how
    if magnitude_limit is None:
        limit = learned.limit
    frames = [frame_of(s, learned.scale, use_flux) for s in spots]
    sky = skies.sky(limit)
    grid = skies.grid(limit, _grid_radius(frames, how))
    pairs = partial(skies.pairs, limit, optics)
    solutions, status = identify_sequence(t_s, frames, priors, sky, grid, pairs, how)
    found = residual_scale(solutions)
    scale = learned.scale
    if is_significant(found) or (learned.adjusted and found.dof > 0):
        scale *= found.scale
        solutions = [
            s and s._replace(cov_rad2=s.cov_rad2 * found.scale**2, chi2=s.chi2 / found.scale**2)
            for s in solutions
        ]
    return Identified(solutions, status, sky, scale)


class _Learned(NamedTuple):
    scale: float
    limit: float
    how: Search | None  # with the zero point; none: flux is of no use
    adjusted: bool  # errors as stated do not hold, or none are


class _Sample(NamedTuple):
    t_s: Array
    spots: Sequence[Spots]
    priors: Sequence[Prior | None]

    def take(self, rows: npt.NDArray[np.int64]) -> "_Sample":
        return _Sample(
            self.t_s[rows], [self.spots[i] for i in rows], [self.priors[i] for i in rows]
        )


def _evenly(n: int, wanted: int) -> npt.NDArray[np.int64]:
    """Return at most `wanted` of n rows, spread evenly."""
    return np.unique(np.linspace(0, n - 1, wanted).astype(np.int64)) if n else np.empty(0, np.int64)


def _fill_sigmas(spots: Sequence[Spots]) -> tuple[list[Spots], bool]:
    """Return spots with no sigma missing where any is stated (the median stands in), and
    whether any is."""
    sigma_px = np.concatenate([s.sigma_px for s in spots])
    if not np.isfinite(sigma_px).any():
        return list(spots), False
    middle = float(np.nanmedian(sigma_px))
    return [
        s._replace(sigma_px=np.where(np.isnan(s.sigma_px), middle, s.sigma_px)) for s in spots
    ], True


def _learn(sample: _Sample, skies: Skies, limit: float, how: Search, stated: bool) -> _Learned:
    """Return centroid errors, faintest star and zero point from a sample of frames."""
    sky, spots = skies.sky(limit), sample.spots
    scale, solutions = _first_scale(sample, skies, limit, how, stated)
    adjusting = not stated
    for _ in range(5):
        found = residual_scale(solutions)
        adjusting |= is_significant(found)
        if found.dof < 10 or not adjusting or abs(found.scale - 1) < 0.01:
            break
        scale *= found.scale
        again = rematch([frame_of(s, scale) for s in spots], solutions, sky, how)
        if not any(again):
            break
        solutions = again
    frames = [frame_of(s, scale) for s in spots]
    zero, scatter = zero_point(frames, solutions, sky)
    useless = scatter > USELESS_SCATTER_MAG
    how = how._replace(zero_point_mag=np.nan if useless else zero)
    if useless:
        frames = [frame_of(s, scale, False) for s in spots]
    if any(solutions):
        magnitudes = [
            sky.catalogue.magnitude[s.star[s.star >= 0]] for s in solutions if s is not None
        ]
        least = np.floor(4 * np.median(np.concatenate(magnitudes))) / 4
        deep = skies.sky(limit + DEEPER_MAG)
        limit = faintest_star(
            frames, rematch(frames, solutions, deep, how), deep, how.gate_sigma, least
        )
    return _Learned(scale, limit, None if useless else how, adjusting)


def _first_scale(
    sample: _Sample, skies: Skies, limit: float, how: Search, stated: bool
) -> tuple[float, list[Solution | None]]:
    """Return a scale of the errors with which frames can be identified, and the solutions."""
    scales = KNOWN_SCALES if stated else UNKNOWN_SCALES_PX
    probe = sample.take(_evenly(len(sample.spots), N_PROBED))
    quick = how._replace(time_limit_s=how.time_limit_s / 4)
    best, best_count = scales[0], 0
    for scale in scales:
        count = sum(s is not None for s in _with_scale(probe, skies, limit, quick, scale))
        if count > best_count:
            best, best_count = scale, count
        if 3 * count >= 2 * len(probe.spots):
            break
    if best_count == 0:
        return best, [None] * len(sample.spots)
    return best, _with_scale(sample, skies, limit, how, best)


def _with_scale(
    sample: _Sample, skies: Skies, limit: float, how: Search, scale: float
) -> list[Solution | None]:
    """Return the sample's solutions with the errors scaled so."""
    if not sample.spots:
        return []
    frames = [frame_of(s, scale) for s in sample.spots]
    sky, grid = skies.sky(limit), skies.grid(limit, _grid_radius(frames, how))
    pairs = partial(skies.pairs, limit, sample.spots[0].optics)
    return identify_sequence(sample.t_s, frames, list(sample.priors), sky, grid, pairs, how)[0]


def _grid_radius(frames: list[Frame], how: Search) -> float:
    """Return the widest look-up, rounded up so that like sensors share a grid [rad]."""
    sigma = np.concatenate([f.sigma_rad for f in frames]) if frames else np.empty(0)
    widest = 2.5 * how.gate_sigma * float(np.median(sigma)) if len(sigma) else 1e-3
    return float(min(2.0 ** (np.ceil(2 * np.log2(widest)) / 2), 0.1))
