"""What the report says of a night: its numbers, what was left out, and what needs a look.

`read_night_facts` computes all of it from the tables; the page and Prefect's page only show it.
"""

from collections.abc import Iterator, Mapping, Sequence
from statistics import median
from typing import NamedTuple

import numpy as np
import polars as pl

from epipole.io.datasets.night_tables import NightReader
from epipole.schemas.arrays import Flags
from epipole.schemas.log_checks import MISTAKE_COLUMNS, mistakes
from epipole.schemas.rejects import NameStatus, ObjectVerdict, Reason, Trait, sentence_of
from epipole.schemas.stages import Stage
from epipole.tasks.report.epipolar_views import (
    OPTICS,
    EpipolarViews,
    best_epoch,
    read_epipolar_views,
)
from epipole.tasks.report.frame_series import FrameSeries, Gap, read_frame_series
from epipole.tasks.report.globe import Globe, read_globe
from epipole.tasks.report.object_details import MAX_DETAILED, ObjectDetail, read_object_details
from epipole.tasks.report.objects import (
    NightNumbers,
    NightObject,
    SkyTracks,
    read_objects,
    read_sky_tracks,
    read_trend,
)
from epipole.tasks.report.solved_chi2 import SolvedChi2, read_solved_chi2
from epipole.tasks.report.stars import (
    StarMap,
    StarResiduals,
    read_frame_concerned,
    read_star_map,
    read_star_residuals,
)

# What was left out, by stage, reason and sensor.

ORDER = [stage.value for stage in Stage]


class LeftOut(NamedTuple):
    """What was left out for one reason, of one sensor; '' if unknown or several."""

    stage: str
    reason: str
    sensor_id: str
    number: int

    @property
    def sentence(self) -> str:
        """What the reason means."""
        return sentence_of(self.reason)


def read_left_out(night: NightReader) -> list[LeftOut]:
    """Return what was left out, in the order of the stages, the most frequent first."""
    key = ["stage", "reason", "sensor_id"]
    pieces = [
        rows.group_by(key).agg(pl.col("count").sum())
        for rows in night.pieces("rejects", [*key, "count"])
    ]
    if not pieces:
        return []
    counts = pl.concat(pieces).with_columns(pl.col("sensor_id").fill_null(""))
    sums = counts.group_by(key).agg(pl.col("count").sum())
    rows = [LeftOut(*row) for row in sums.select(*key, "count").iter_rows()]
    return sorted(rows, key=lambda row: (_rank(row.stage), -row.number, row.reason, row.sensor_id))


def _rank(stage: str) -> int:
    return ORDER.index(stage) if stage in ORDER else len(ORDER)


# All facts of a night.

_CALIBRATIONS = ["sensor_id", *OPTICS, "sigma_fx_px", "sigma_fy_px", "n_stars", "residual_px"]


class NightFacts(NamedTuple):
    """What the report says. None, or empty: the night has no such rows.

    `trend` ends with the night itself; `counts` are rows by table. `concerned` are frames of
    sensors that need a look, by sensor.
    """

    night: str
    dataset: str
    sources: pl.DataFrame
    counts: dict[str, int]
    series: FrameSeries | None
    left_out: list[LeftOut]
    mistakes: list[str]
    calibrations: pl.DataFrame
    residuals: StarResiduals | None
    chi2: SolvedChi2
    star_catalogue: str
    star_map: StarMap | None
    tracks: SkyTracks | None
    globe: Globe | None
    epipolar: EpipolarViews | None
    concerned: dict[str, StarMap]
    details: list[ObjectDetail]
    objects: list[NightObject]
    trend: list[NightNumbers]

    def size_px(self, sensor_id: str) -> np.ndarray:
        """Return about the size of a sensor's image."""
        if self.residuals is None:
            return np.array([1.0, 1.0])
        size: np.ndarray = self.residuals.size_px[self.residuals.sensors.index(sensor_id)]
        return size

    @property
    def anchors(self) -> dict[str, str]:
        """Where on the page an object is shown more closely, by its id."""
        return {each.object_id: f"#object-{k}" for k, each in enumerate(self.details, start=1)}


COUNTED = ("frames", "stars", "detections", "tracklets", "associations", "positions", "states",
           "observations")  # fmt: skip


def read_night_facts(
    night: NightReader, dataset: str, earlier: Sequence[NightReader] = ()
) -> NightFacts:
    """Return what the report says of a night.

    Parameters
    ----------
    dataset
        Its name for people.
    earlier
        Nights before it, in order, for the trend.
    """
    series = read_frame_series(night)
    calibrations = night.read("calibrations", _CALIBRATIONS)
    residuals = views = None
    epoch_ns = best_epoch(night)
    if series is not None:
        residuals = read_star_residuals(night, series.sensors, calibrations)
    if residuals is not None and epoch_ns is not None:
        sizes = dict(zip(residuals.sensors, residuals.size_px, strict=True))
        views = read_epipolar_views(night, epoch_ns, calibrations, sizes)
    objects = read_objects(night)
    return NightFacts(
        night=night.night,
        dataset=dataset,
        sources=night.read("sources", ["name", "size", "code_version", "settings_key"]),
        counts={name: night.count(name) for name in COUNTED},
        series=series,
        left_out=read_left_out(night),
        mistakes=mistakes(night.read("checks", MISTAKE_COLUMNS).to_dicts()),
        calibrations=calibrations.sort("sensor_id"),
        residuals=residuals,
        chi2=read_solved_chi2(night),
        star_catalogue=night.metadata("stars", "catalogue"),
        star_map=None if series is None else read_star_map(night, series),
        tracks=read_sky_tracks(night),
        globe=read_globe(night, epoch_ns),
        epipolar=views,
        concerned=_concerned(night, series, residuals),
        details=read_object_details(night, [each.object_id for each in look_first(objects)]),
        objects=objects,
        trend=read_trend([*earlier, night]),
    )


def look_first(objects: Sequence[NightObject], limit: int = MAX_DETAILED) -> list[NightObject]:
    """Return the objects that most need a look: unsound ones first, then unknown ones."""
    order = sorted(objects, key=lambda each: (
        each.verdict == ObjectVerdict.SOUND, each.status == NameStatus.KNOWN, -each.positions
    ))  # fmt: skip
    return order[:limit]


def _concerned(
    night: NightReader, series: FrameSeries | None, residuals: StarResiduals | None
) -> dict[str, StarMap]:
    """Return a frame of each sensor whose share identified or residuals need a look."""
    if series is None:
        return {}
    wrong = {series.sensors[k] for k in np.flatnonzero(_is_poor(series))}
    if residuals is not None:
        wrong |= {name for name, _ in _residuals_off(residuals)}
    share = dict(zip(series.sensors, series.identified_share.tolist(), strict=True))
    order = sorted(wrong, key=lambda name: (share[name], name))
    frames = {
        name: read_frame_concerned(night, series, series.sensors.index(name))
        for name in order[:MAX_CONCERNED]
    }
    return {name: frame for name, frame in frames.items() if frame is not None}


# What needs a look, as sentences; none where all is well.

MIN_IDENTIFIED = 0.9  # share of a sensor's frames
# A mean square over what it should be: sigmas are a fifth too large, or too small.
LOWEST, HIGHEST = 0.7, 1.4
SMALLEST = 1e-3  # ratio that is said: of a log without noise the residuals are 0
MIN_VALUES = 30  # independent values: with fewer, noise alone exceeds the bounds
MIN_NIGHTS = 5
DROP = 0.7  # of the median of the nights before
MAX_CONCERNED = 4  # frames that are drawn


class Look(NamedTuple):
    """What needs a look, as a sentence, and where on the page it is shown."""

    sentence: str
    anchor: str


def needs_look(facts: NightFacts) -> list[Look]:
    """Return what needs a look, the worst first."""
    mistakes = [Look(each, "logs") for each in facts.mistakes]
    return [*mistakes, *_faults(facts), *_nothing_found(facts), *_sensors(facts),
            *_sigmas(facts), *_damage(facts), *_changes(facts)]  # fmt: skip


def _faults(facts: NightFacts) -> Iterator[Look]:
    faults = {reason.value for reason in Reason.having(Trait.SENSOR_FAULT)}
    for row in facts.left_out:
        if row.reason in faults:
            sentence = f"{row.sensor_id or 'A sensor'} is at fault ({row.reason}): {row.sentence}"
            yield Look(sentence, "counts")


def _nothing_found(facts: NightFacts) -> Iterator[Look]:
    if facts.series is None:
        yield Look("The night has no frames.", "coverage")
    elif not (facts.series.counts[0].any() or facts.series.sends_no_stars.all()):
        yield Look("No star is identified in the whole night.", "coverage")
    elif not facts.objects:
        yield Look("No object is found.", "sky")


def _sensors(facts: NightFacts) -> Iterator[Look]:
    series = facts.series
    if series is None:
        return
    shares, failed = series.identified_share, _failed_by_sensor(series)
    for k in np.flatnonzero(_is_poor(series)).tolist():
        name, why = series.sensors[k], _why(failed.get(series.sensors[k], {}))
        identified = f"{percent(shares[k])} of its frames are identified{why}"
        yield Look(f"{name}: {identified}.", _frame_of(facts, name, "coverage"))


def _is_poor(series: FrameSeries) -> Flags:
    """Return which sensors' frames are identified more rarely than they should be."""
    return (series.identified_share < MIN_IDENTIFIED) & ~series.sends_no_stars


def _frame_of(facts: NightFacts, name: str, otherwise: str) -> str:
    shown = list(facts.concerned)
    return f"frame-{shown.index(name) + 1}" if name in shown else otherwise


def _failed_by_sensor(series: FrameSeries) -> dict[str, dict[str, int]]:
    found: dict[str, dict[str, int]] = {}
    for (sensor, status), count in series.failed.items():
        found.setdefault(sensor, {})[status] = count
    return found


def _why(failed: Mapping[str, int]) -> str:
    """Return why most frames that are not identified are not, of counts by status."""
    return f"; most others: {max(failed, key=lambda status: failed[status])}" if failed else ""


def _residuals_off(residuals: StarResiduals) -> Iterator[tuple[str, float]]:
    """Yield sensors whose star residuals do not fit their sigma, with the mean square."""
    squares = zip(residuals.sensors, residuals.mean_square, residuals.stars, strict=True)
    for name, square, stars in squares:
        if np.isfinite(square) and stars >= MIN_VALUES and not holds(square):
            yield name, float(square)


def _sigmas(facts: NightFacts) -> Iterator[Look]:
    if facts.residuals is not None:
        for name, square in _residuals_off(facts.residuals):
            sentence = f"{name}: star residuals are {_off(square)} than their sigma says."
            yield Look(sentence, _frame_of(facts, name, "sigmas"))
    for what, chi2 in (("pair distances", facts.chi2.pairs), ("positions", facts.chi2.positions),
                       ("states", facts.chi2.states)):  # fmt: skip
        if chi2 is not None and chi2.independent >= MIN_VALUES and not holds(chi2.mean):
            sentence = f"Sigmas of {what} do not hold: the residuals are {_off(chi2.mean)}."
            yield Look(sentence, "sigmas")


def holds(mean_square: float) -> bool:
    """Return whether a mean square, which should be 1, is near enough."""
    return LOWEST <= mean_square <= HIGHEST


def _off(mean_square: float) -> str:
    ratio = max(float(np.sqrt(mean_square)), SMALLEST)
    return f"{ratio:.2f} times larger" if ratio > 1 else f"{1 / ratio:.2f} times smaller"


def _damage(facts: NightFacts) -> Iterator[Look]:
    harmless = {reason.value for reason in Reason.having(Trait.HARMLESS)}
    read = [row for row in facts.left_out if row.stage == Stage.READ]
    counts: dict[str, int] = {}
    for row in read:
        if row.reason not in harmless:
            counts[row.reason] = counts.get(row.reason, 0) + row.number
    if counts:
        listed = ", ".join(f"{reason} {count:,}" for reason, count in counts.items())
        yield Look(f"Parts of the logs could not be used: {listed}.", "counts")


def _changes(facts: NightFacts) -> Iterator[Look]:
    *before, tonight = facts.trend
    if len(before) < MIN_NIGHTS:
        return
    for what, now, usual in (
        ("frames", tonight.frames, median(each.frames for each in before)),
        ("objects", tonight.objects, median(each.objects for each in before)),
        ("positions", tonight.positions, median(each.positions for each in before)),
    ):
        if now < DROP * usual:
            sentence = (
                f"Fewer {what} than usual: {now:,}. Median of the nights before: {usual:,.0f}."
            )
            yield Look(sentence, "trend")


def percent(share: float) -> str:
    """Return a share in per cent; 100 % only where it is all."""
    text = f"{100 * share:.1f}"
    if text == "100.0":
        text = "100" if share >= 1 else "99.9"
    return f"{text} %"


def duration(seconds: float) -> str:
    """Return a length of time, such as ``2 h 5 min`` or ``12 s``."""
    whole = round(seconds)
    if whole < 120:
        return f"{whole} s"
    hours, minutes = divmod(round(seconds / 60), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"


# What Prefect's page shows: the most telling pictures, and the gaps of sensors.


class PagePicture(NamedTuple):
    """A PNG, and the sentence that stands for it."""

    alt: str
    png: bytes


class ReportExtract(NamedTuple):
    """The extract of one night; `lost_s` is the length of all gaps by sensor."""

    night: str
    pictures: tuple[PagePicture, ...]
    gaps: tuple[Gap, ...]
    lost_s: dict[str, float]
