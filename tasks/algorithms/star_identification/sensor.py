"""Star identification of one sensor: eight passes over its frames of a span.

What the passes learn of the sensor is a `SensorModel`: its centroid error, its faintest star, the
zero point of its brightness.

1. Probe (`_probe`): some scattered frames are searched, with one assumption after the other, until
   any is identified. Groups of centroids that move together (`moving_groups`) are searched first
   where the first frames are a crowd, last elsewhere.
2. Sample (`_learn_around`): the model is learned from frames around the identified ones.
3. All frames (`identify_sample`): followed from frame to frame, searched where that fails.
4. All frames again (`_identify_again`): only if the probe failed and pass 3 identified some. The
   model is learned from these.
5. True errors (`_with_true_scale`): the centroid error that the residuals of all frames show.
6. Other brightness (`of_other_brightness`): unidentified frames, with an unknown zero point.
7. Poor frames (`reidentify_poor_frames`): frames of which unusually few centroids are stars.
8. Error of each frame (`by_quality`): from the residuals of each; unidentified frames are searched
   as better and as worse ones.

docs/methods/passes.md says what each pass costs and what is lost without it.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Indices
from epipole.tasks.algorithms.star_identification.centroids import (
    RawCentroids,
    Solutions,
    filled_sigmas,
)
from epipole.tasks.algorithms.star_identification.frame import MatchSettings, Solution
from epipole.tasks.algorithms.star_identification.moving_groups import moving_groups
from epipole.tasks.algorithms.star_identification.reidentify_poor_frames import (
    by_quality,
    of_other_brightness,
    reidentify_poor_frames,
)
from epipole.tasks.algorithms.star_identification.search_budget import SearchBudget
from epipole.tasks.algorithms.star_identification.sensor_model import (
    SensorModel,
    Skies,
    evenly_spaced,
    is_significant,
    learn,
    likeliest_floor,
    rematch,
    scale_of,
)
from epipole.tasks.algorithms.star_identification.sequence import (
    FrameSample,
    Priors,
    identify_again,
    identify_sample,
    no_priors,
    sky_of,
)
from epipole.tasks.algorithms.star_identification.star_grid import Sky

Statuses = list[str | None]

MIN_CENTROIDS = 4  # of a frame that takes part in the probe and the sample
# Number of frames of the probe; more where frames are crowded: with more than `CROWDED` centroids
# in the typical frame, most centroids are not stars.
PROBED, PROBED_CROWDED, CROWDED = 5, 8, 100
# With more centroids in the typical frame, most of them may be satellites. The first `FIRST` probed
# frames show it, at this share of the searches' budget.
MANY, FIRST, FIRST_SHARE = 40, 2, 0.05
# The number of stars in a crowded field is unknown: the first number is assumed, then a sky that is
# deeper by the second.
STARS_IN_CROWD, DEEPER_IN_CROWD_MAG = 25.0, 1.5
# Frames from which the model is learned; 12 and 48 do as well (docs/methods/passes.md).
SAMPLED = 24
# First guess of the number of stars in a field: per centroid, more than one as the sensor misses
# some; and where no frame has enough centroids.
STARS_PER_CENTROID, ASSUMED_IN_VIEW = 1.2, 10.0
# Centroids may be mostly objects or clutter. So skies with a faintest star that is brighter by this
# are tried as well, if they still have `MIN_IN_VIEW` stars per field on average.
BRIGHTER_MAG, MIN_IN_VIEW = (1.0, 2.0), 5.0
# Centroid errors that are tried: factors on stated ones, or pixels where none are stated.
KNOWN_SCALES, UNKNOWN_SCALES_PX = (1.0, 3.0, 0.4), (0.5, 1.5, 0.15)
# Range of the median stated error [px] in which `KNOWN_SCALES` are enough: from a third of the
# least error of a camera to the blur of a lens. Outside it, `UNKNOWN_SCALES_PX` are tried too.
CREDIBLE_PX = (0.02, 3.0)
# Relative error of the learned centroid error above which all frames are matched again. With half
# or twice of it the same frames are identified, and squared errors over covariance change by 0.03.
WRONG_GATE = 0.02
# Frames that are spread over this time [s] are too far apart to be followed one from another.
APART_S = 1e9
# Maximum cost of the probe, as a share of the searches' budget; of the pass over all frames, and of
# any other pass, as a share of what is left when it begins.
PROBE_SHARE, ALL_SHARE, SHARE = 0.4, 0.7, 0.4
THOROUGH = 12.0  # maximum cost of a thorough attempt of the probe, over that of a quick one


class IdentifiedSensor(NamedTuple):
    """A sensor's solutions.

    solutions, status : of each frame, see `identify_sequence`
    sky : the solutions' stars are rows of its catalogue
    sigma_scale : (F,) float, factor on the stated centroid errors; pixels where none are stated
    sigma_floor_px : error added in quadrature to the stated ones, before that factor
    """

    solutions: Solutions
    status: Statuses
    sky: Sky
    sigma_scale: Array
    sigma_floor_px: float = 0.0


class _Probe(NamedTuple):
    """The probed frames.

    rows : (n,) int64, which frames
    solutions : one for each of these, None where it is not identified
    usable : (m,) int64, all frames with enough centroids, probed or not
    """

    rows: Indices
    solutions: list[Solution | None]
    usable: Indices

    @property
    def failed(self) -> bool:
        """Whether no frame was identified."""
        return not any(self.solutions)


def identify_sensor(
    t_s: Array,
    centroids: RawCentroids,
    priors: Priors,
    skies: Skies,
    magnitude_limit: float | None,
    matching: MatchSettings,
) -> IdentifiedSensor:
    """Identify the stars of a sensor's frames.

    Centroid errors that are not stated are estimated from the residuals. Stated errors are scaled
    where residuals contradict them beyond doubt. Both are done frame by frame where frames differ.

    Parameters
    ----------
    t_s : (F,) float
        Times of the frames [s], ascending.
    centroids, priors
        Of the F frames.
    magnitude_limit
        Faintest star that the sensor detects; None: it is learned.
    matching
        How frames are judged before anything is known of the sensor.
    """
    centroids, stated = _fill_sigmas(centroids)
    n, floor_px = len(t_s), 0.0
    budget = SearchBudget(n, matching.time_limit_s, matching.budget_share)
    frames = FrameSample(t_s, centroids, priors, budget=budget, rows=np.arange(n, dtype=np.int64))
    frames, model, probe = _probe(frames, skies, magnitude_limit, matching, stated)
    if not probe.failed:
        if stated:
            frames, model, floor_px = _with_floor(frames, probe, skies, model)
        frames, model = _learn_around(frames, probe, skies, model)
    solutions, status = identify_sample(frames, skies, model, probe.failed, ALL_SHARE)
    if probe.failed and solutions.solved.any():
        solutions, status, model = _identify_again(frames, solutions, skies, model)
    solutions, status, model = _with_true_scale(frames, solutions, status, skies, model)
    solutions = of_other_brightness(frames, solutions, skies, model)
    quality = reidentify_poor_frames(
        frames.scaled(model), solutions, sky_of(frames.centroids, skies, model), model.matching,
        frames.allowance(SHARE),
    )  # fmt: skip
    solutions, quality = by_quality(frames, solutions, quality, skies, model)
    return IdentifiedSensor(
        solutions, _status_now(status, solutions), skies.sky(model.limit), model.scale * quality,
        floor_px,
    )  # fmt: skip


def _fill_sigmas(centroids: RawCentroids) -> tuple[RawCentroids, bool]:
    """Return the centroids with the median for missing sigmas, and whether any sigma is stated."""
    sigma_px = filled_sigmas(centroids.sigma_px)
    return centroids._replace(sigma_px=sigma_px), bool(np.isfinite(sigma_px).any())


def _status_now(status: Statuses, solutions: Solutions) -> Statuses:
    """Return the status of each frame: None where it has been solved since."""
    return [None if solved else s for s, solved in zip(status, solutions.solved, strict=True)]


# Pass 1: the probe.


def _probe(
    frames: FrameSample,
    skies: Skies,
    magnitude_limit: float | None,
    matching: MatchSettings,
    stated: bool,
) -> tuple[FrameSample, SensorModel, _Probe]:
    """Return the frames, a first model, and the probed frames with what it identifies of them.

    Frames with a moving group of stars have its solution as a prior.
    """
    centroids = frames.centroids
    usable = np.flatnonzero(centroids.counts >= MIN_CENTROIDS)
    typical = float(np.median(centroids.counts[usable])) if len(usable) else 0.0
    crowded = typical > CROWDED
    limit = magnitude_limit
    if limit is None:
        limit = _assumed_limit(centroids, typical, crowded, skies)
    first = SensorModel(1.0, limit, magnitude_limit is None, matching, True, not stated)
    rows = usable[aperiodic_rows(len(usable), PROBED_CROWDED if crowded else PROBED)]
    scales = _tried_scales(centroids, stated)
    # The groups of a crowd are searched sooner than its frames; most other frames need none.
    if typical > MANY and not _are_stars(frames.take(rows[:FIRST]), skies, first, scales[0]):
        frames = _anchored_by_motion(frames, rows, skies, first, scales)
    model, solutions = _first_scale(frames.take(rows), skies, first, scales, crowded)
    if typical <= MANY and not any(solutions):
        anchored = _anchored_by_motion(frames, rows, skies, first, scales)
        if anchored is not frames:
            frames = anchored
            model, solutions = _first_scale(frames.take(rows), skies, first, scales, crowded)
    return frames, model, _Probe(rows, solutions, usable)


def _tried_scales(centroids: RawCentroids, stated: bool) -> tuple[float, ...]:
    """Return the scales of centroid errors that are tried, the likeliest first.

    They are factors on stated errors, or pixels where none are stated, as `SensorModel.scale` is.
    """
    if not stated:
        return UNKNOWN_SCALES_PX
    stated_px = float(np.nanmedian(centroids.sigma_px))
    if CREDIBLE_PX[0] <= stated_px <= CREDIBLE_PX[1]:
        return KNOWN_SCALES
    return (*KNOWN_SCALES, *(scale_px / stated_px for scale_px in UNKNOWN_SCALES_PX))


def _are_stars(frames: FrameSample, skies: Skies, model: SensorModel, scale: float) -> bool:
    """Return whether a short search identifies all of these frames: then they are not a crowd."""
    tried = model._replace(scale=scale, matching=_quick(model.matching))
    return bool(identify_sample(frames, skies, tried, share=FIRST_SHARE)[0].solved.all())


def _assumed_limit(centroids: RawCentroids, typical: float, crowded: bool, skies: Skies) -> float:
    """Return the magnitude of the faintest star to search for in frames of which nothing is known.

    `typical` is the number of centroids of the typical frame.
    """
    in_view = STARS_IN_CROWD if crowded else STARS_PER_CENTROID * typical or ASSUMED_IN_VIEW
    return skies.limit_for(in_view / centroids.optics[0].solid_angle_sr)


def _anchored_by_motion(
    frames: FrameSample, rows: Indices, skies: Skies, model: SensorModel, scales: tuple[float, ...]
) -> FrameSample:
    """Return the frames; where moving groups of these rows are stars, with solutions as priors."""
    groups, of_frame = moving_groups(frames.centroids, frames.t_s, rows)
    if not len(of_frame):
        return frames
    apart_s = np.linspace(0.0, APART_S, len(of_frame))
    parts = FrameSample(
        apart_s, groups, no_priors(len(of_frame)), budget=frames.budget, rows=of_frame
    )
    if model.limit_is_open:
        model = model._replace(limit=_assumed_limit(groups, 0.0, True, skies))
    _, solutions = _first_scale(parts, skies, model, scales, crowded=False)
    return frames.anchored(of_frame, solutions) if any(solutions) else frames


def aperiodic_rows(n: int, wanted: int) -> Indices:
    """Return `wanted` of n rows, spread without a period: every third frame may show the Earth.

    They are multiples of the golden ratio, modulo 1.
    """
    golden = 0.5 * (np.sqrt(5.0) - 1.0)
    return np.unique((np.arange(wanted) * golden % 1.0 * n).astype(np.int64))[:n]


class _Attempt(NamedTuple):
    """One search of the probed frames.

    model : what is assumed of the sensor
    thorough : whether the search may take long, and looks for stars in a crowd
    """

    model: SensorModel
    thorough: bool


def _first_scale(
    probe: FrameSample, skies: Skies, model: SensorModel, scales: tuple[float, ...], crowded: bool
) -> tuple[SensorModel, list[Solution | None]]:
    """Return the model of the first attempt that identifies frames, with the likeliest scale, and
    the solutions.

    If none does: the given model with the first scale, and None for each frame.
    """
    attempts = _attempts(probe.centroids, skies, model, scales, crowded)
    matching = model.matching
    # Each attempt may give a false alarm.
    threshold = matching.threshold + np.log(len(attempts))
    thorough = matching._replace(threshold=threshold)
    quick = _quick(thorough)
    weights = np.where([attempt.thorough for attempt in attempts], THOROUGH, 1.0)
    shares = _shares_of_rest(weights, _probe_share(len(probe.t_s)))
    for attempt, share in zip(attempts, shares, strict=True):
        tried = attempt.model._replace(matching=thorough if attempt.thorough else quick)
        solutions, _ = identify_sample(
            probe, skies, tried, share=share, one_will_do=attempt.thorough
        )
        found = solutions.each()
        if any(found):
            return _likeliest_scale(probe.centroids, found, skies, attempt.model, scales)
    return model._replace(scale=scales[0]), [None] * len(probe.t_s)


def _shares_of_rest(weights: Array, of_all: float) -> list[float]:
    """Return the share of what is left of a budget that each of n attempts may spend.

    Together they may spend the part `of_all` of the budget, each in proportion to its weight. So
    attempt k may spend ``p[k] = of_all * weights[k] / weights.sum()`` of the whole budget. If those
    before it have spent all of theirs, ``1 - p[:k].sum()`` is left: its share is the ratio.
    """
    total = weights.sum()
    return [of_all * weights[k] / (total - of_all * weights[:k].sum()) for k in range(len(weights))]


def _quick(matching: MatchSettings) -> MatchSettings:
    """Return the settings of a short search, not of crowds."""
    return matching._replace(time_limit_s=matching.time_limit_s / 4, crowded=False)


def _probe_share(n_probed: int) -> float:
    """Return the share of the budget that the probe may cost: nearly all of it for few frames."""
    return max(PROBE_SHARE, 1.0 - 0.1 * n_probed)


def _attempts(
    probe: RawCentroids, skies: Skies, model: SensorModel, scales: tuple[float, ...], crowded: bool
) -> list[_Attempt]:
    """Return the attempts, the likeliest first, and all quick ones before the thorough ones.

    Unless the brightest centroids of a crowd are stars, only a thorough search finds stars. It is
    tried with the first scale, and with either depth of the sky.
    """
    models = list(_models(probe, skies, model, scales, crowded))
    quick = [_Attempt(tried, thorough=False) for tried in models]
    if not crowded:
        return quick
    thorough = [tried for tried in models if tried.scale == scales[0] and tried.use_flux]
    return [*quick, *(_Attempt(tried, thorough=True) for tried in thorough)]


def _models(
    probe: RawCentroids, skies: Skies, model: SensorModel, scales: tuple[float, ...], crowded: bool
) -> Iterator[SensorModel]:
    """Yield models to try, the likeliest first."""
    flux = bool(np.isfinite(probe.instrumental_mag).any())
    area = probe.optics[0].solid_angle_sr
    for use_flux in [True, False] if flux else [True]:  # fluxes may be unrelated to brightness
        tried = model._replace(scale=scales[0], use_flux=use_flux)
        yield tried
        if crowded and model.limit_is_open and use_flux:
            yield tried._replace(limit=model.limit + DEEPER_IN_CROWD_MAG)
        for brighter in BRIGHTER_MAG if model.limit_is_open and use_flux else ():
            if not crowded and skies.sky(model.limit - brighter).rho * area > MIN_IN_VIEW:
                yield tried._replace(limit=model.limit - brighter)
        for scale in scales[1:]:
            yield tried._replace(scale=scale)


def _likeliest_scale(
    centroids: RawCentroids,
    solutions: list[Solution | None],
    skies: Skies,
    model: SensorModel,
    scales: tuple[float, ...],
) -> tuple[SensorModel, list[Solution | None]]:
    """Return the model with the scale that explains the solved frames best, and the solutions with
    it."""
    best, best_evidence, chosen = model, -np.inf, solutions
    for scale in dict.fromkeys((model.scale, *scales)):
        frames = centroids.frames(scale, model.use_flux).each()
        again = rematch(frames, solutions, skies.sky(model.limit), model.matching)
        evidence = sum(s.evidence for s in again if s is not None)
        if any(again) and evidence > best_evidence:
            best, best_evidence, chosen = model._replace(scale=scale), evidence, again
    return best, chosen


# Pass 2: the sample.


def _with_floor(
    frames: FrameSample, probe: _Probe, skies: Skies, model: SensorModel
) -> tuple[FrameSample, SensorModel, float]:
    """Return the frames and the model with an error added in quadrature to the stated ones, and
    that error [px]; 0 where it is not needed."""
    floor_px = likeliest_floor(
        frames.take(probe.rows).centroids, probe.solutions, skies.sky(model.limit), model.matching,
        model.scale,
    )  # fmt: skip
    frames = frames._replace(centroids=frames.centroids.with_floor(floor_px))
    return frames, model._replace(scale=1.0 if floor_px else model.scale), floor_px


def _learn_around(
    frames: FrameSample, probe: _Probe, skies: Skies, model: SensorModel
) -> tuple[FrameSample, SensorModel]:
    """Return all frames with the sample's solutions as anchors, and the model that was learned."""
    # With the errors, zero point and faintest star of the probed frames, more can be followed.
    model = learn(frames.take(probe.rows).centroids, probe.solutions, skies, model)
    solved = np.array([s is not None for s in probe.solutions])
    at = np.searchsorted(probe.usable, probe.rows[solved])
    near = probe.usable[_runs_around(len(probe.usable), at)]
    anchored = frames.anchored(probe.rows, probe.solutions)
    sampled = identify_sample(anchored.take(near), skies, model, share=SHARE)[0].each()
    model = learn(frames.take(near).centroids, sampled, skies, model)
    return frames.anchored(near, sampled) if any(sampled) else anchored, model


def _runs_around(n: int, rows: Indices) -> Indices:
    """Return about `SAMPLED` of n rows, in runs around these: runs can be followed."""
    length = min(-(-SAMPLED // len(rows)), n)
    start = np.clip(rows - length // 2, 0, n - length)
    return np.unique(start[:, None] + np.arange(length))


# Pass 4: all frames again.


def _identify_again(
    frames: FrameSample, solutions: Solutions, skies: Skies, model: SensorModel
) -> tuple[Solutions, Statuses, SensorModel]:
    """Return the solutions of all frames with a model learned from those so far, and the model."""
    solved = np.flatnonzero(solutions.solved)
    rows = solved[evenly_spaced(len(solved), SAMPLED)]
    sampled = [solutions.frame(i) for i in rows]
    model = learn(frames.take(rows).centroids, sampled, skies, model)
    return *identify_sample(frames.anchored(rows, sampled), skies, model, share=SHARE), model


# Pass 5: the true errors.


def _with_true_scale(
    frames: FrameSample, solutions: Solutions, status: Statuses, skies: Skies, model: SensorModel
) -> tuple[Solutions, Statuses, SensorModel]:
    """Return the solutions and the model with the centroid error that all residuals show.

    If it differs much from the one so far, all frames are matched again with it. Where that loses
    a frame, the matches stay, and only their errors are scaled.
    """
    residuals = scale_of(solutions.star, solutions.chi2, int(solutions.solved.sum()))
    if model.adjusted and abs(residuals.scale - 1) > WRONG_GATE:
        model = model._replace(scale=model.scale * residuals.scale)
        again = identify_again(
            frames.t_s, frames.scaled(model), solutions, skies.sky(model.limit), model.matching
        )
        if again.solved[solutions.solved].all():
            solutions, status = again, _status_now(status, again)
            residuals = scale_of(solutions.star, solutions.chi2, int(solutions.solved.sum()))
        else:
            solutions = solutions.rescaled(residuals.scale)
            residuals = residuals._replace(scale=1.0)  # it is applied
    if residuals.dof > 0 and (model.adjusted or is_significant(residuals)):
        model = model._replace(scale=model.scale * residuals.scale)
        solutions = solutions.rescaled(residuals.scale)
    return solutions, status, model
