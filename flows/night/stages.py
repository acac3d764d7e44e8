"""The stages of a night, each as tasks for some sensors and spans.

Tasks take paths and small tables, and write their results as parts of the work folder. A part that
exists is not made again: the name of the folder depends on everything that parts depend on. The
rows of a night do not depend on which worker made which part, or when.
"""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl
import pyarrow as pa

from epipole.flows.night.progress import flat, results, step
from epipole.flows.night.solving import solve_linked, solve_objects
from epipole.flows.night.summary import Summary, many, summarise
from epipole.flows.night.work import Spans, Work, count_frames, spans_of_night
from epipole.io.catalogues.element_sets import KnownObjects
from epipole.io.work.parts import IDENTIFIED, Parts, write_part
from epipole.io.work.work_layout import (
    NOTHING_ADDED,
    AddedErrors,
    ReadFolder,
    SolvedParts,
    WorkFolder,
)
from epipole.schemas.arrays import Array
from epipole.schemas.bridge import array, concat, to_polars
from epipole.schemas.rejects import ObjectVerdict, Reason
from epipole.schemas.settings import EVERY_SENSOR, Settings
from epipole.schemas.spans import DAY_NS, SPAN_NS, Span, day_of
from epipole.schemas.stages import Stage
from epipole.schemas.tables import POSITIONS, REJECTS, STATES
from epipole.schemas.work_tables import OBJECT_DETECTIONS
from epipole.tasks.algorithms.sensor_faults.fault_judgement import Doubt
from epipole.tasks.check.check_sensors import (
    REASONS,
    SensorVerdict,
    add_corrections,
    check_sensors,
)
from epipole.tasks.check.correct_clock import correct_clock
from epipole.tasks.common.batches import in_batches
from epipole.tasks.identify.identify_span import Counts, SpanToIdentify, identify_spans
from epipole.tasks.name.earlier_objects import EarlierObjects, EarlierViews
from epipole.tasks.name.elements_of_night import ElementsOfNight, elements_of_night
from epipole.tasks.name.judge_times import judge_times
from epipole.tasks.name.known_objects import name_known_objects
from epipole.tasks.name.link_tracklets import OrbitLinks, link_tracklets
from epipole.tasks.name.object_ids import (
    Names,
    counted_alike,
    followed_objects,
    link_objects,
    name_objects,
    number_objects,
    outermost,
    renamed,
)
from epipole.tasks.name.sensor_residuals import SensorResidual
from epipole.tasks.publish.fitted_observations import complete_observations
from epipole.tasks.publish.night_objects import write_objects
from epipole.tasks.publish.night_parts import NightParts, publish_nights
from epipole.tasks.publish.observed_objects import with_links
from epipole.tasks.publish.orbits import OrbitRows, fit_orbits, orbit_shares, write_orbits
from epipole.tasks.publish.share_out import share_out
from epipole.tasks.publish.write_tables import SHARES, tracklets_of_night, write_tables
from epipole.tasks.read.order_frames import (
    OrderedFrames,
    order_sensors,
    ordered_logs,
    plan_order,
)
from epipole.tasks.read.read_logs import LogToRead, about_frames, read_logs
from epipole.tasks.track.join_tracklets import SensorToJoin, join_tracklets
from epipole.tasks.track.track_span import SpanToTrack, track_spans

LOGGER = logging.getLogger(__name__)

# After the first correction the views of a sensor fit objects; from these the second is exact.
MAX_CORRECTIONS = 2


def read(logs: Sequence[str], folder: ReadFolder, settings: Settings) -> OrderedFrames:
    """Read the logs, some per task, and order the frames and states of each sensor."""
    to_read = [LogToRead(number, log) for number, log in enumerate(logs)]
    batches = in_batches(to_read, [about_frames(log) for log in logs])
    futures = [read_logs.submit(folder, batch, settings.sensors.assume) for batch in batches]
    plan = plan_order(folder, flat(results(Stage.READ, futures, (0, 2))))
    futures = [order_sensors.submit(folder, batch, settings.sensors) for batch in plan.batches()]
    frames = ordered_logs(plan, flat(results(Stage.READ, futures, (1, 2))), settings.sensors)
    LOGGER.info("read %s of %s", many(frames.n_frames, "frame"), many(len(frames.sources), "log"))
    known = {EVERY_SENSOR, *frames.sensors, *frames.cameras["sensor_id"].to_pylist()}
    if unknown := sorted({each.sensor for each in settings.sensors.assume} - known):
        LOGGER.warning("`sensors.assume` names %s, of which these logs have nothing: check the id",
                       ", ".join(unknown))  # fmt: skip
    return frames


def identify(frames: OrderedFrames, spans: Spans, folder: WorkFolder, settings: Settings) -> Work:
    """Interpolate sensor states, identify stars and solve attitudes."""
    where = {sensor: folder.identified(sensor) for sensor in spans}
    n_frames = count_frames(frames, spans)
    work = Work(frames.folder, folder, spans, n_frames, frames.cameras, where)
    identify_all(Stage.IDENTIFY, work, settings)
    return work


def identify_all(stage: Stage, work: Work, settings: Settings) -> None:
    """Identify the frames of all spans of `work`; the parts go to `work.identified`."""
    pieces = [
        SpanToIdentify(sensor, span, work.identified[sensor]) for sensor, span in work.by_span()
    ]
    futures = [
        identify_spans.submit(
            work.frames, batch, work.cameras, settings.sensors, settings.identification,
            settings.tracklets.max_detections,
        )
        for batch in work.span_batches(pieces)
    ]  # fmt: skip
    counts: list[Counts] = results(stage, futures)
    frames, by_stars, stars = (
        sum(getattr(count, name) for count in counts) for name in ("frames", "by_stars", "stars")
    )
    LOGGER.info("identified %s of %s by %s", f"{by_stars:,}", many(frames, "frame"),
                many(stars, "star"))  # fmt: skip


def track(work: Work, night: str, settings: Settings) -> Work:
    """Follow detections from frame to frame, and name tracklets; return the work with counts."""
    parts = work.sensor_parts()
    again = {sensor for sensor in work.spans if work.corrected.get(sensor, 0) == work.round}
    pairs = [(sensor, span) for sensor, span in work.by_span() if sensor in again]
    to_track = [
        SpanToTrack(sensor, span, parts[sensor].identified, parts[sensor].tracked)
        for sensor, span in pairs
    ]
    futures = [
        track_spans.submit(batch, work.cameras, settings.tracklets, settings.alignment.window_s)
        for batch in work.span_batches(to_track)
    ]
    n_detections = flat(results(Stage.TRACK, futures, (0, 2)))
    to_join = [
        SensorToJoin(sensor, spans, parts[sensor].tracked, parts[sensor].names)
        for sensor, spans in work.spans.items() if sensor in again
    ]  # fmt: skip
    futures = [join_tracklets.submit(batch, night) for batch in work.sensor_batches(to_join)]
    count = sum(results(Stage.TRACK, futures, (1, 2)))
    LOGGER.info("followed %s", many(count, "tracklet"))
    found = dict(zip(pairs, n_detections, strict=True))
    return work._replace(n_detections={**work.n_detections, **found})


def solve(
    work: Work,
    settings: Settings,
    left_out: Mapping[str, Reason] | None = None,
    added: AddedErrors = NOTHING_ADDED,
) -> SolvedParts:
    """Find and solve objects, from all sensors but those left out; see `solve_objects`."""
    solved, count = solve_objects(work, settings, left_out or {}, added)
    LOGGER.info("solved %s", many(count, "position"))
    return solved


class Checked(NamedTuple):
    """The result of the check of the sensors.

    With `again`, clocks were corrected and the night goes back to `track`. `left_out` are sensors
    that stay at fault, each with its reason: the night is solved again without them. `doubt` is
    what is wrong with sensors of which none can be named.
    """

    work: Work
    again: bool
    left_out: dict[str, Reason]
    doubt: Doubt


def check(work: Work, solved: SolvedParts, settings: Settings, correct: bool = True) -> Checked:
    """Judge the sensors by all spans; `correct` wrong clocks if the settings say so too."""
    step(Stage.CHECK, 0, 1)
    viewed, spans = work.folder.viewed(work.round), work.all_spans()
    verdicts, doubt = check_sensors(solved, viewed, list(work.spans), spans)
    log_verdicts(verdicts)
    faulty = [verdict for verdict in verdicts if verdict.is_faulty]
    late = [verdict for verdict in faulty if verdict.has_wrong_clock]
    work = work._replace(verdicts=tuple(add_corrections(work.verdicts, verdicts)))
    correctable = correct and settings.alignment.correct_clocks and work.round < MAX_CORRECTIONS
    is_clear = not doubt.undecided and np.isnan(doubt.shared_s)
    if late and correctable and is_clear:
        return Checked(_correct_clocks(work, late, settings), True, {}, doubt)
    return Checked(work, False, _taking_part(work, solved, faulty), doubt)


def log_verdicts(verdicts: Sequence[SensorVerdict]) -> None:
    """Log one line for sound sensors, and a warning for each that is at fault."""
    sound = [verdict for verdict in verdicts if not verdict.is_faulty]
    if sound:
        within_s = max(max(abs(verdict.offset_s), verdict.sigma_s) for verdict in sound)
        LOGGER.info(
            "clocks of %s agree with each other within %.2g s", many(len(sound), "sensor"), within_s
        )
    for verdict in verdicts:
        if verdict.is_faulty:
            LOGGER.warning("%s", verdict)


def _taking_part(
    work: Work, solved: SolvedParts, faulty: Sequence[SensorVerdict]
) -> dict[str, Reason]:
    """Return the faulty sensors that take part in an association, and so distort it."""
    reasons = {verdict.sensor_id: REASONS[verdict.cause] for verdict in faulty}
    names = {sensor.number: sensor.sensor_id for sensor in work.spans}
    associated: set[str] = set()
    for span in work.all_spans() if reasons else []:
        members = solved.objects.read(span, "members", ["sensor"])
        associated |= reasons.keys() & {names[k] for k in members["sensor"].unique().to_pylist()}
    return {sensor: reasons[sensor] for sensor in sorted(associated)}


def _correct_clocks(work: Work, wrong: Sequence[SensorVerdict], settings: Settings) -> Work:
    """Correct the times of frames of wrong clocks, and return the work of the next round."""
    clocks = {clock.sensor_id: clock for clock in wrong}
    next_round = work.round + 1
    where = {
        sensor: work.folder.corrected(sensor, next_round)
        for sensor in work.spans
        if sensor.sensor_id in clocks
    }
    pairs = [(sensor, span) for sensor, span in work.by_span() if sensor in where]
    futures = [
        correct_clock.submit(
            work.frames, sensor, work.identified[sensor], span, clocks[sensor.sensor_id],
            settings.sensors,
            where[sensor],
        )
        for sensor, span in pairs
    ]  # fmt: skip
    results(Stage.CHECK, futures)
    entered = {sensor: _enter_spans(where[sensor], work.spans[sensor]) for sensor in where}
    spans = {
        sensor: sorted([*of_sensor, *entered.get(sensor, [])])
        for sensor, of_sensor in work.spans.items()
    }
    return work._replace(
        spans=spans,
        identified={**work.identified, **where},
        round=next_round,
        corrected={**work.corrected, **dict.fromkeys(where, next_round)},
    )


def _enter_spans(parts: Parts, spans: Sequence[Span]) -> list[Span]:
    """Return new spans that have frames at their true times; each gets an empty part.

    The frames themselves stay in the parts in which they were.
    """
    times = [array(parts.read(span, "solutions", ["time"]), "time") for span in spans]
    starts = np.unique(np.concatenate(times) // SPAN_NS * SPAN_NS).tolist()
    entered = [span for t in starts if (span := Span(t, t + SPAN_NS)) not in spans]
    for span in entered:
        tables = {name: parts.read(spans[0], name).slice(0, 0) for name in IDENTIFIED}
        write_part(parts.of(span), IDENTIFIED, tables)
    return entered


def name(
    work: Work, solved: SolvedParts, night: str, before: EarlierViews, settings: Settings
) -> Names:
    """Return, for each span, the names of its objects in the night.

    `before` is the end of the night before, as far as it is known.
    """
    step(Stage.NAME, 0, 1)
    spans = [span for span in work.all_spans() if solved.holds(span)]
    numbers = number_objects(solved, spans)
    ends: dict[str, list[pa.Table]] = {"positions": [], "states": []}
    for span in spans:
        for table, rows in ends.items():
            for piece in solved.read(span, table):
                rows.append(renamed(outermost(piece), numbers[span.folder]))
    first: dict[str, str] = link_objects(
        concat(POSITIONS, ends["positions"]), concat(STATES, ends["states"]), settings.states
    )
    linked = {
        folder: {old: first.get(number, number) for old, number in of_span.items()}
        for folder, of_span in numbers.items()
    }
    views = [
        renamed(rows, linked[span.folder])
        for span in spans
        if span.end_ns <= day_of(night) * DAY_NS
        for rows in solved.read(span, "associations", OBJECT_DETECTIONS.names)
    ]
    followed = followed_objects(views, counted_alike(before, _frames_near(work, before.frames)))
    names = name_objects(linked, spans_of_night(spans, night), night, followed)
    _log_names(names, followed, len(first))
    return names


def _frames_near(work: Work, last: pa.Table) -> dict[str, tuple[Array, Array]]:
    """Return times [ns] and numbers of the frames about the time of each sensor's in LAST_FRAMES.

    By sensor.
    """
    at_ns = dict(zip(last["sensor_id"].to_pylist(), array(last, "time").tolist(), strict=True))
    found = {}
    for sensor in work.spans:
        if sensor.sensor_id in at_ns:
            time_ns, parts = at_ns[sensor.sensor_id], work.identified[sensor]
            rows = [
                parts.read(near, "solutions", ["time", "frame_number"])
                for near in parts.near(Span(time_ns, time_ns + 1))
            ]
            times, numbers = (
                np.concatenate([np.zeros(0, np.int64), *(array(each, name) for each in rows)])
                for name in ("time", "frame_number")
            )
            found[sensor.sensor_id] = times, numbers
    return found


def _log_names(names: Names, followed: Mapping[str, str], linked: int) -> None:
    ids = {new for of_span in names.values() for new in of_span.values()}
    LOGGER.info("named %s", many(len(ids), "object"))
    if known := ids.intersection(followed.values()):
        LOGGER.info("followed %s from the night before", many(len(known), "object"))
    if linked:
        LOGGER.info("recognised %s after a gap", many(linked, "object"))


class Destination(NamedTuple):
    """Where nights go: first each to a staging folder, then all at once into the dataset."""

    dataset: str
    staged: Mapping[str, Path]
    replace: bool


def write_night(
    work: Work,
    solved: SolvedParts,
    night: str,
    names: Names,
    whole: Mapping[str, pa.Table],
    folder: Path,
    settings: Settings,
) -> pa.Table:
    """Join tracklets by orbits, and write the tables of a night to its folder.

    What an orbit joins has positions where several sensors saw it. Returns LINKED_ORBITS.

    Parameters
    ----------
    whole
        Tables of the whole run: `calibrations`, `checks`, `sources`, and `rejects` that belong to
        no span.
    """
    spans = work.all_spans()
    sensors = list(work.sensor_parts().values())
    of_night = spans_of_night(spans, night)
    parts = NightParts(night, of_night, spans, sensors, solved, names, whole, kept=settings.tables)
    parts, orbits = _link(work, parts, settings)
    futures = [write_tables.submit(tables, folder, parts) for tables in SHARES]
    results(Stage.PUBLISH, futures)
    return orbits


def determine_orbits(folder: Path, night: str, linked: pa.Table) -> dict[str, ObjectVerdict]:
    """Fit the orbits of a night whose tables are written, and write them; see `fit_orbits`.

    Returns the verdicts of objects whose observations fit no single orbit.
    """
    shares = orbit_shares(folder, night)
    results(Stage.PUBLISH, [share_out.submit(folder, night, shares)])
    futures = [fit_orbits.submit(folder, night, share, shares, linked) for share in range(shares)]
    fitted: list[OrbitRows] = results(Stage.PUBLISH, futures)
    (count,) = results(Stage.PUBLISH, [write_orbits.submit(folder, night, fitted)])
    results(Stage.PUBLISH, [complete_observations.submit(folder, night, shares)])
    LOGGER.info("fitted %s", many(count, "orbit"))
    return {name: verdict for each in fitted for name, verdict in each.verdicts.items()}


def list_objects(folder: Path, night: str, verdicts: Mapping[str, ObjectVerdict]) -> None:
    """Write the objects of a night whose other tables are written; see `write_objects`."""
    results(Stage.PUBLISH, [write_objects.submit(folder, night, verdicts)])


def _link(work: Work, parts: NightParts, settings: Settings) -> tuple[NightParts, pa.Table]:
    """Return the parts with the tracklets that an orbit joins, and LINKED_ORBITS.

    See `link_tracklets` and `solve_linked`.
    """
    taken = sorted({name for of_span in parts.names.values() for name in of_span.values()})
    tracklets = tracklets_of_night(parts)
    future = link_tracklets.submit(tracklets, parts.night, taken, settings.linking)
    links: OrbitLinks
    (links,) = results(Stage.NAME, [future])
    names = {
        folder: {old: links.renamed.get(new, new) for old, new in of_span.items()}
        for folder, of_span in parts.names.items()
    }
    parts = parts._replace(names=names, linked=links.tracklets)
    if not links.tracklets.num_rows:
        return parts, links.orbits
    LOGGER.info("linked %s by orbits", many(links.tracklets.num_rows, "tracklet"))
    rows = to_polars(tracklets).with_columns(pl.col("object_id").replace(links.renamed))
    solved, names, linked = solve_linked(
        work, parts.solved, with_links(rows, parts), links.tracklets, names, settings
    )
    return parts._replace(solved=solved, names=names, linked=linked), links.orbits


def choose_elements(
    known: KnownObjects | None, night: str, settings: Settings
) -> tuple[ElementsOfNight | None, pa.Table]:
    """Return the elements of known objects that are used in a night, and `rejects` of others."""
    if known is None:
        return None, REJECTS.empty_table()
    if known.faults:
        LOGGER.warning("%s: %s skipped, the first is %s", known.file,
                       many(len(known.faults), "invalid record"), known.faults[0])  # fmt: skip
    elements, rejects = elements_of_night(known, night, settings.known_objects.max_days)
    if not elements.sets:
        newest = np.datetime64(max(each.epoch_ns for each in known.sets), "ns")
        LOGGER.warning(
            "%s: no element set is within %g days of %s (the newest is of %s): no object is named",
            known.file, settings.known_objects.max_days, night, newest.astype("datetime64[D]"),
        )  # fmt: skip
    return elements, rejects


def name_known(
    folder: Path,
    known: ElementsOfNight | None,
    earlier: EarlierObjects,
    settings: Settings,
) -> list[SensorResidual]:
    """Name the known objects of a night whose tables are written; see `name_known_objects`.

    With a catalogue, its `checks` get rows on whether the night's times are UTC.
    """
    if known is not None:
        results(Stage.PUBLISH, [judge_times.submit(folder, known)])
    future = name_known_objects.submit(
        folder, known, earlier, settings.known_objects, settings.states.link_log_odds
    )
    (residuals,) = results(Stage.PUBLISH, [future])
    return residuals


def publish(destination: Destination, sources: pa.Table) -> Summary:
    """Publish all nights, and return their summary."""
    summary = summarise(destination.dataset, destination.staged)
    publish_nights(destination.dataset, destination.staged, sources, destination.replace)
    return summary
