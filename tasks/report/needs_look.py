"""What of a night needs a look, as sentences; none where all is well."""

from collections.abc import Iterator
from statistics import median

import numpy as np

from epipole.schemas.rejects import Reason
from epipole.schemas.stages import Stage
from epipole.tasks.report.frame_series import FrameSeries
from epipole.tasks.report.night_facts import NightFacts

LEAST_IDENTIFIED = 0.9  # share of a sensor's frames
LONGEST_LOST = 0.02  # share of the night
# A mean square over what it should be: sigmas are a fifth too large, or too small.
LOWEST, HIGHEST = 0.7, 1.4
FEWEST = 30  # values that share no detection: with fewer, chance alone goes beyond the bounds
FEWEST_NIGHTS = 5
DROP = 0.7  # of the median of the nights before
# More than one message of these is a log that was not stored as it was recorded.
HARMLESS = (Reason.NO_MCAP, Reason.DUPLICATE_FRAME, Reason.DUPLICATE_STATE)
MOST_SENTENCES = 12


def needs_look(facts: NightFacts) -> list[str]:
    """Return a sentence for each thing that needs a look, the worst first."""
    return [*_faults(facts), *_nothing_found(facts), *_sensors(facts), *_sigmas(facts),
            *_damage(facts), *_changes(facts)]  # fmt: skip


def _faults(facts: NightFacts) -> Iterator[str]:
    for row in facts.left_out:
        if row.stage == Stage.CHECK or row.reason == Reason.SENSOR_DISAGREES:
            yield f"{row.sensor_id or 'A sensor'} is at fault ({row.reason}): {row.sentence}"


def _nothing_found(facts: NightFacts) -> Iterator[str]:
    if facts.series is None:
        yield "The night has no frames."
    elif not facts.counts["stars"]:
        yield "No star is identified in the whole night."
    elif not facts.counts["positions"]:
        yield "No object has a position."


def _sensors(facts: NightFacts) -> Iterator[str]:
    series = facts.series
    if series is None:
        return
    length_s = (series.bins.end_ns - series.bins.start_ns) / 1e9
    for k, name in enumerate(series.sensors):
        share = series.identified_share[k]
        if share < LEAST_IDENTIFIED:
            yield f"{name}: {percent(share)} of its frames are identified{_why(series, name)}."
        if series.lost_s[k] > LONGEST_LOST * length_s:
            yield f"{name} has no frames for {duration(series.lost_s[k])} of the night (gaps)."


def _why(series: FrameSeries, name: str) -> str:
    reasons = {status: n for (sensor, status), n in series.failed.items() if sensor == name}
    if not reasons:
        return ""
    status = max(reasons, key=lambda key: reasons[key])
    return f"; most others: {status}"


def _sigmas(facts: NightFacts) -> Iterator[str]:
    if facts.residuals is not None:
        for name, square, stars in zip(facts.residuals.sensors, facts.residuals.mean_square,
                                       facts.residuals.stars, strict=True):  # fmt: skip
            if np.isfinite(square) and stars >= FEWEST and not holds(square):
                yield f"{name}: star residuals are {_off(square)} than their sigma says."
    for what, chi2 in (("pair distances", facts.chi2.pairs), ("positions", facts.chi2.positions),
                       ("states", facts.chi2.states)):  # fmt: skip
        if chi2 is not None and chi2.independent >= FEWEST and not holds(chi2.mean):
            yield f"Sigmas of {what} do not hold: the residuals are {_off(chi2.mean)}."


def holds(mean_square: float) -> bool:
    """Return whether a mean square, which should be 1, is near enough."""
    return LOWEST <= mean_square <= HIGHEST


def _off(mean_square: float) -> str:
    ratio = float(np.sqrt(mean_square))
    return f"{ratio:.2f} times larger" if ratio > 1 else f"{1 / ratio:.2f} times smaller"


def _damage(facts: NightFacts) -> Iterator[str]:
    harmless = {reason.value for reason in HARMLESS}
    read = [row for row in facts.left_out if row.stage == Stage.READ]
    counts: dict[str, int] = {}
    for row in read:
        if row.reason not in harmless:
            counts[row.reason] = counts.get(row.reason, 0) + row.number
    if counts:
        listed = ", ".join(f"{reason} {count:,}" for reason, count in counts.items())
        yield f"Parts of the logs could not be used: {listed}."


def _changes(facts: NightFacts) -> Iterator[str]:
    *before, tonight = facts.trend
    if len(before) < FEWEST_NIGHTS:
        return
    for what, now, usual in (
        ("frames", tonight.frames, median(each.frames for each in before)),
        ("objects", tonight.objects, median(each.objects for each in before)),
        ("positions", tonight.positions, median(each.positions for each in before)),
    ):
        if now < DROP * usual:
            yield f"Fewer {what} than usual: {now:,}. Median of the nights before: {usual:,.0f}."


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
