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
from epipole.tasks.algorithms.star_identification.sequence import Prior, Tracker, identify_sequence
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
    counts = np.array([len(s.u) for s in spots])
    usable = np.flatnonzero(counts >= 4)
    optics = spots[0].optics
    limit = magnitude_limit
    if limit is None:
        density = 1.2 * float(np.median(counts[usable])) if len(usable) else 10.0
        limit = skies.limit_for(density / optics.solid_angle_sr)
    stated = bool(np.isfinite(np.concatenate([s.sigma_px for s in spots])).all())
    sample = (
        usable[np.unique(np.linspace(0, len(usable) - 1, N_SAMPLED).astype(int))]
        if len(usable)
        else usable
    )
    learned = _learn(
        [spots[i] for i in sample], [priors[i] for i in sample], skies, limit, how, stated
    )
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
    if is_significant(found):
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


def _learn(
    spots: list[Spots],
    priors: list[Prior | None],
    skies: Skies,
    limit: float,
    how: Search,
    stated: bool,
) -> _Learned:
    """Return centroid errors, faintest star and zero point from a sample of frames."""
    sky = skies.sky(limit)
    scale, solutions = _first_scale(spots, priors, skies, limit, how, stated)
    for _ in range(4):
        found = residual_scale(solutions)
        if found.dof < 10 or not (
            is_significant(found) or (not stated and abs(found.scale - 1) > 0.02)
        ):
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
    return _Learned(scale, limit, None if useless else how)


def _first_scale(
    spots: list[Spots],
    priors: list[Prior | None],
    skies: Skies,
    limit: float,
    how: Search,
    stated: bool,
) -> tuple[float, list[Solution | None]]:
    """Return a scale of the errors with which frames can be identified, and the solutions."""
    scales = KNOWN_SCALES if stated else UNKNOWN_SCALES_PX
    probed = sorted({int(i) for i in np.linspace(0, len(spots) - 1, N_PROBED)}) if spots else []
    best, best_count = scales[0], 0
    for scale in scales:
        found = _alone(
            [spots[i] for i in probed], [priors[i] for i in probed], skies, limit, how, scale
        )
        count = sum(s is not None for s in found)
        if count > best_count:
            best, best_count = scale, count
        if 3 * count >= 2 * len(probed):
            break
    if best_count == 0:
        return best, [None] * len(spots)
    return best, _alone(spots, priors, skies, limit, how, best)


def _alone(
    spots: list[Spots],
    priors: list[Prior | None],
    skies: Skies,
    limit: float,
    how: Search,
    scale: float,
) -> list[Solution | None]:
    """Return each frame's solution without help from the others."""
    if not spots:
        return []
    frames = [frame_of(s, scale) for s in spots]
    sky, grid = skies.sky(limit), skies.grid(limit, _grid_radius(frames, how))
    pairs = partial(skies.pairs, limit, spots[0].optics)
    tracker = Tracker(sky, grid, None, how)
    found = [tracker.step_alone(f, p) for f, p in zip(frames, priors, strict=True)]
    for i, frame in enumerate(frames):
        if found[i] is None and not (priors[i] and tracker.prior_holds):
            found[i] = Tracker(sky, grid, pairs, how).step_alone(frame, None)
    return found


def _grid_radius(frames: list[Frame], how: Search) -> float:
    """Return the widest look-up, rounded up so that like sensors share a grid [rad]."""
    sigma = np.concatenate([f.sigma_rad for f in frames]) if frames else np.empty(0)
    widest = 2.5 * how.gate_sigma * float(np.median(sigma)) if len(sigma) else 1e-3
    return float(min(2.0 ** (np.ceil(2 * np.log2(widest)) / 2), 0.1))
