"""All frames of one sensor over a span: its errors and its faintest star are learned from a sample,
then every frame is identified."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.star_identification.centroids import RawCentroids, Solutions
from epipole.tasks.algorithms.star_identification.frame import Search, Solution
from epipole.tasks.algorithms.star_identification.reidentify_poor_frames import (
    Known,
    Sample,
    Skies,
    by_quality,
    identify_sample,
    of_other_brightness,
    reidentify_poor_frames,
    sky_of,
)
from epipole.tasks.algorithms.star_identification.sensor_model import (
    USELESS_SCATTER_MAG,
    faintest_star,
    is_significant,
    likeliest_floor,
    rematch,
    residual_scale,
    scale_of,
    zero_point,
)
from epipole.tasks.algorithms.star_identification.sequence import Priors, identify_again
from epipole.tasks.algorithms.star_identification.star_grid import Sky

Array = npt.NDArray[np.float64]

# Frames, scattered over all, which are searched until any is identified; more where a frame has so
# many centroids that most are no stars.
PROBED, PROBED_CROWDED, CROWDED = 5, 8, 100
STARS_IN_CROWD, DEEPER_IN_CROWD_MAG = 25.0, 1.5  # a field shows so many stars there, or deeper ones
SAMPLED = 24  # frames around these from which a sensor is learned
# Centroids may be mostly objects or clutter: skies that are brighter by this are tried as well.
BRIGHTER_MAG = (1.0, 2.0)
MIN_IN_VIEW = 5.0  # stars in a field, on average, of a sky that is worth a try
KNOWN_SCALES = (1.0, 3.0, 0.4)  # factors to try on errors that the log or the settings state
UNKNOWN_SCALES_PX = (0.5, 1.5, 0.15)  # errors to try where none are stated
MIN_SPREAD_MAG = 0.15  # of brightness: a sample may scatter less than all
WRONG_GATE = 0.02  # a sample that misses the errors of all frames by more is corrected
DEEPER_MAG = 2.0  # how far beyond the first guess the faintest star is searched for


class IdentifiedSensor(NamedTuple):
    """A sensor's solutions.

    solutions, status : of each frame, see `identify_sequence`
    sky : the solutions' stars are rows of its catalogue
    sigma_scale : (F,) float, factor on the centroid errors as stated, or on 1 px where none are
    sigma_floor_px : the error that all have beside the stated ones, before that factor
    """

    solutions: Solutions
    status: list[str | None]
    sky: Sky
    sigma_scale: Array
    sigma_floor_px: float = 0.0


def identify_sensor(
    t_s: Array,
    spots: RawCentroids,
    priors: Priors,
    skies: Skies,
    magnitude_limit: float | None,
    how: Search,
) -> IdentifiedSensor:
    """Identify the stars of a sensor's frames, which are in order of time.

    Errors that are not stated are estimated from the residuals. Stated errors are scaled where
    residuals contradict them beyond doubt, so that reported sigmas are true; both frame by frame
    where frames differ.
    """
    spots, stated = _fill_sigmas(spots)
    usable = np.flatnonzero(spots.counts >= 4)
    density = 1.2 * float(np.median(spots.counts[usable])) if len(usable) else 10.0
    crowded = density > 1.2 * CROWDED
    limit = magnitude_limit
    if limit is None:  # of a crowd, nobody knows how many are stars
        in_view = STARS_IN_CROWD if crowded else density
        limit = skies.limit_for(in_view / spots.optics[0].solid_angle_sr)
    known = Known(1.0, limit, magnitude_limit is None, how, True, not stated)
    whole = Sample(t_s, spots, priors)
    rows = usable[scattered(len(usable), PROBED_CROWDED if crowded else PROBED)]
    known, probed = _first_scale(
        whole.take(rows), skies, known, KNOWN_SCALES if stated else UNKNOWN_SCALES_PX, crowded
    )
    hopeless = not any(probed)
    floor_px = 0.0
    if not hopeless:
        if stated:
            floor_px = likeliest_floor(
                whole.take(rows).spots, probed, skies.sky(known.limit), known.how, known.scale
            )
            spots = spots.with_floor(floor_px)
            whole = whole._replace(spots=spots)
            known = known._replace(scale=1.0 if floor_px else known.scale)
        known, whole = _learn_around(rows, probed, usable, whole, skies, known)
    solutions, status = identify_sample(whole, skies, known, hopeless)
    if hopeless and solutions.solved.any():  # the probe was poor: learn from the others
        solved = np.flatnonzero(solutions.solved)
        rows = solved[spread(len(solved), SAMPLED)]
        sampled = [solutions.frame(i) for i in rows]
        known = _learn(whole.take(rows).spots, sampled, skies, known)
        solutions, status = identify_sample(whole.anchored(rows, sampled), skies, known)
    solutions, status, known = _with_true_scale(whole, solutions, status, skies, known)
    if solutions.solved.any():
        solutions = of_other_brightness(whole, solutions, skies, known)
    quality = reidentify_poor_frames(
        spots.frames(known.scale, known.use_flux),
        solutions,
        sky_of(spots, skies, known),
        known.how,
    )
    solutions, quality = by_quality(whole, solutions, quality, skies, known)
    status = [None if solved else s for s, solved in zip(status, solutions.solved, strict=True)]
    return IdentifiedSensor(
        solutions, status, skies.sky(known.limit), known.scale * quality, floor_px
    )


def _with_true_scale(
    whole: Sample, solutions: Solutions, status: list[str | None], skies: Skies, known: Known
) -> tuple[Solutions, list[str | None], Known]:
    """Return the solutions with the errors that the residuals of all frames show."""
    spots = whole.spots
    residuals = scale_of(solutions.star, solutions.chi2, int(solutions.solved.sum()))
    if known.adjusted and abs(residuals.scale - 1) > WRONG_GATE:
        known = known._replace(scale=known.scale * residuals.scale)
        sky, frames = skies.sky(known.limit), spots.frames(known.scale, known.use_flux)
        again = identify_again(whole.t_s, frames, solutions, sky, known.how)
        if again.solved[solutions.solved].all():
            solutions = again
            status = [None if solved else s for s, solved in zip(status, again.solved, strict=True)]
            residuals = scale_of(solutions.star, solutions.chi2, int(solutions.solved.sum()))
        else:
            solutions, residuals = (
                solutions.rescaled(residuals.scale),
                residuals._replace(scale=1.0),
            )
    if residuals.dof > 0 and (known.adjusted or is_significant(residuals)):
        known = known._replace(scale=known.scale * residuals.scale)
        solutions = solutions.rescaled(residuals.scale)
    return solutions, status, known


def spread(n: int, wanted: int) -> npt.NDArray[np.int64]:
    """Return so many rows of n, spread evenly."""
    return np.unique(np.linspace(0, max(n - 1, 0), wanted).astype(np.int64))[:n]


def scattered(n: int, wanted: int) -> npt.NDArray[np.int64]:
    """Return so many rows of n, all over but in no period: every third frame may show the Earth."""
    golden = 0.5 * (np.sqrt(5.0) - 1.0)
    return np.unique((np.arange(wanted) * golden % 1.0 * n).astype(np.int64))[:n]


def _around(n: int, rows: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return `SAMPLED` rows of n in runs around these: followed, they need no search."""
    length = min(-(-SAMPLED // len(rows)), n)
    start = np.clip(rows - length // 2, 0, n - length)
    return np.unique(start[:, None] + np.arange(length))


def _fill_sigmas(spots: RawCentroids) -> tuple[RawCentroids, bool]:
    """Return the centroids with the median for missing sigmas, and whether any sigma is stated."""
    if not np.isfinite(spots.sigma_px).any():
        return spots, False
    middle = float(np.nanmedian(spots.sigma_px))
    return spots._replace(sigma_px=np.where(np.isnan(spots.sigma_px), middle, spots.sigma_px)), True


def _learn(
    spots: RawCentroids, solutions: list[Solution | None], skies: Skies, known: Known
) -> Known:
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
        spread = min(max(1.2 * scatter, MIN_SPREAD_MAG), USELESS_SCATTER_MAG)
        how = how._replace(zero_point_mag=zero, spread_mag=spread)
    known = known._replace(scale=scale, how=how, use_flux=use_flux, adjusted=adjusted)
    return known._replace(limit=_faintest(spots, solutions, skies, known))


def _faintest(
    spots: RawCentroids, solutions: list[Solution | None], skies: Skies, known: Known
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
    probe: Sample, skies: Skies, known: Known, scales: tuple[float, ...], crowded: bool
) -> tuple[Known, list[Solution | None]]:
    """Return what is known, with a scale of errors that identifies frames, and the solutions."""
    attempts = list(_attempts(probe.spots, skies, known, scales, crowded))
    # Each further attempt is one more chance of a false alarm.
    least = known.how.threshold + np.log(max(len(attempts) - 1, 1))
    quick = known.how._replace(
        time_limit_s=known.how.time_limit_s / 4, threshold=least, crowded=False
    )
    thorough = known.how._replace(threshold=least)
    for tried in attempts:
        # In a crowd, nothing less finds stars: as many as expected, or more.
        in_crowd = crowded and tried.scale == scales[0] and tried.use_flux
        how = thorough if in_crowd else quick
        found = identify_sample(probe, skies, tried._replace(how=how))[0].each()
        if any(found):
            return _likeliest_scale(probe.spots, found, skies, tried, scales)
    return known._replace(scale=scales[0]), [None] * len(probe.t_s)


def _attempts(
    probe: RawCentroids,
    skies: Skies,
    known: Known,
    scales: tuple[float, ...],
    crowded: bool,
) -> Iterator[Known]:
    """Yield what may be assumed of a sensor, the likeliest first."""
    flux = bool(np.isfinite(probe.instrumental_mag).any())
    area = probe.optics[0].solid_angle_sr
    for use_flux in [True, False] if flux else [True]:  # it may be unrelated to brightness
        tried = known._replace(scale=scales[0], use_flux=use_flux)
        yield tried
        if crowded and known.limit_is_open and use_flux:
            yield tried._replace(limit=known.limit + DEEPER_IN_CROWD_MAG)
        for brighter in BRIGHTER_MAG if known.limit_is_open and use_flux else ():
            if not crowded and skies.sky(known.limit - brighter).rho * area > MIN_IN_VIEW:
                yield tried._replace(limit=known.limit - brighter)
        for scale in scales[1:]:
            yield tried._replace(scale=scale)


def _likeliest_scale(
    spots: RawCentroids,
    solutions: list[Solution | None],
    skies: Skies,
    known: Known,
    scales: tuple[float, ...],
) -> tuple[Known, list[Solution | None]]:
    """Return what is known, with the scale of errors that explains solved frames best, and the
    solutions with it."""
    best, most, chosen = known, -np.inf, solutions
    for scale in (known.scale, *scales):
        frames = spots.frames(scale, known.use_flux).each()
        again = rematch(frames, solutions, skies.sky(known.limit), known.how)
        evidence = sum(s.evidence for s in again if s is not None)
        if any(again) and evidence > most:
            best, most, chosen = known._replace(scale=scale), evidence, again
    return best, chosen


def _learn_around(
    rows: npt.NDArray[np.int64],
    solutions: list[Solution | None],
    usable: npt.NDArray[np.int64],
    whole: Sample,
    skies: Skies,
    known: Known,
) -> tuple[Known, Sample]:
    """Return what is known, learned from the frames around solved ones, and all frames with
    these as anchors."""
    # With the errors, zero point and faintest star of the solved ones, more can be followed.
    known = _learn(whole.take(rows).spots, solutions, skies, known)
    solved = np.array([s is not None for s in solutions])
    near = usable[_around(len(usable), np.searchsorted(usable, rows[solved]))]
    anchored = whole.anchored(rows, solutions)
    sampled = identify_sample(anchored.take(near), skies, known)[0].each()
    known = _learn(whole.take(near).spots, sampled, skies, known)
    return known, whole.anchored(near, sampled) if any(sampled) else anchored
