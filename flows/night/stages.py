"""The stages of a night, each shared out over tasks of a sensor and a span of time.

Tasks take paths and small tables and leave their own in the work folder, whole or not at all.
A part that is there is not made again: the folder's name tells what it was made of. What is
made of the parts does not depend on which worker made which, or when.
"""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from epipole.flows.night.summary import many
from epipole.flows.night.work import DAY_NS, Spans, Work
from epipole.flows.prefect.progress import results, step
from epipole.io.work.files import is_written, read_part, write_part
from epipole.schemas.bridge import array, concat
from epipole.schemas.settings import Settings
from epipole.schemas.tables import CALIBRATIONS, POSITIONS, STATES
from epipole.schemas.work_tables import CAMERAS
from epipole.tasks.calibrate.calibrate_sensors import Calibrated, calibrate_sensor
from epipole.tasks.check.correct_clock import correct_clock
from epipole.tasks.check.estimate_clocks import Clock
from epipole.tasks.common.spans import SPAN_NS, Span
from epipole.tasks.identify.identify_span import identify_span
from epipole.tasks.name.link_objects import link_objects, outermost, renamed
from epipole.tasks.name.name_objects import name_objects
from epipole.tasks.publish.stage_night import SHARES, stage_night
from epipole.tasks.read.order_frames import OrderedFrames, order_logs
from epipole.tasks.read.read_logs import read_log_into
from epipole.tasks.solve.align_epochs import EpochGrid, frames_that_serve, grid_of
from epipole.tasks.solve.solve_span import SensorParts, solve_span
from epipole.tasks.track.join_tracklets import join_tracklets
from epipole.tasks.track.track_span import track_span

LOGGER = logging.getLogger(__name__)

Names = Mapping[str, Mapping[str, str]]


def read(logs: Sequence[str], folder: Path, settings: Settings) -> OrderedFrames:
    """Read the logs, a task a log, and order what they hold."""
    futures = [read_log_into.submit(folder / f"log-{k}", log) for k, log in enumerate(logs)]
    frames = order_logs(folder, results("read logs", futures), settings)
    count = sum(len(time_ns) for time_ns in frames.time_ns)
    LOGGER.info("read %s of %s", many(count, "frame"), many(len(frames.sources), "log"))
    return frames


def identify(frames: OrderedFrames, spans: Spans, folder: Path, settings: Settings) -> Work:
    """Place sensors, tell stars from the rest and solve attitudes, a task a sensor and span."""
    return _identify(Work(frames.folder, folder, spans, frames.cameras, {}), settings, "identified")


def _identify(work: Work, settings: Settings, stage: str) -> Work:
    where = {sensor: work.parts(stage, sensor) for sensor in work.spans}
    futures = [
        identify_span.submit(work.frames, sensor, span, work.cameras, settings, where[sensor])
        for sensor, span in work.by_span()
    ]
    frames, by_stars, stars = map(sum, zip(*results("identify stars", futures), strict=True))
    LOGGER.info("identified %s of %s by %s", f"{by_stars:,}", many(frames, "frame"),
                many(stars, "star"))  # fmt: skip
    return work._replace(identified={**work.identified, **where})


def calibrate(work: Work, settings: Settings) -> tuple[Work, pa.Table]:
    """Fit each sensor's optics to its stars; identify again those whose calibration is off."""
    mode = settings.identification.calibrate
    calibrations = CALIBRATIONS.empty_table()
    for number in range(2 if mode == "use" else 1):  # with better optics more stars take part
        if mode == "off":
            break
        futures = [
            calibrate_sensor.submit(sensor, work.identified[sensor], spans, work.cameras)
            for sensor, spans in work.spans.items()
        ]
        fits: list[Calibrated] = results("calibrate sensors", futures)
        calibrations = concat(CALIBRATIONS, [fit.calibrations for fit in fits])
        departed = {name for fit in fits for name in fit.departed}
        if mode == "report" or not departed:
            break
        LOGGER.info("optics of %s depart from the calibration", ", ".join(sorted(departed)))
        known = work.cameras.filter(
            pc.invert(pc.is_in(work.cameras["sensor_id"], pa.array(sorted(departed))))
        )
        found = [fit.cameras for fit in fits if fit.departed]
        cameras = concat(CAMERAS, [known, *found]).sort_by(
            [("sensor_id", "ascending"), ("time", "ascending")]
        )
        again = {s: spans for s, spans in work.spans.items() if s.sensor_id in departed}
        some = work._replace(cameras=cameras, spans=again)
        identified = _identify(some, settings, f"identified-{number + 2}").identified
        work = work._replace(cameras=cameras, identified=identified)
    return work, calibrations


def track(work: Work, settings: Settings, attempt: str) -> list[SensorParts]:
    """Follow detections from frame to frame, a task a sensor and span, and name tracklets."""
    parts = {
        sensor: SensorParts(
            work.identified[sensor],
            work.parts(f"tracked{attempt}", sensor),
            work.parts(f"named{attempt}", sensor),
        )
        for sensor in work.spans
    }
    futures = [
        track_span.submit(
            sensor, parts[sensor].identified, span, work.cameras, settings, parts[sensor].tracked
        )
        for sensor, span in work.by_span()
    ]
    results("build tracklets", futures)
    futures = [
        join_tracklets.submit(sensor, parts[sensor].tracked, spans, parts[sensor].named)
        for sensor, spans in work.spans.items()
    ]
    count = sum(results("join tracklets", futures))
    LOGGER.info("followed %s", many(count, "tracklet"))
    return list(parts.values())


def epoch_grid(work: Work, settings: Settings) -> EpochGrid:
    """Return the grid of epochs of the night."""
    columns = ["time", "attitude_source", "x_km"]
    times = []
    for sensor, spans in work.spans.items():
        rows = [
            read_part(work.identified[sensor] / span.folder, "solutions", columns) for span in spans
        ]
        serving = [array(frames_that_serve(part), "time") for part in rows]
        times.append(np.concatenate([np.zeros(0, np.int64), *serving]))
    return grid_of(times, settings)


def solve(
    work: Work,
    parts: Sequence[SensorParts],
    settings: Settings,
    attempt: str,
    left_out: Sequence[str] = (),
) -> Path:
    """Find and solve objects, a task a span of all sensors but those left out."""
    grid = epoch_grid(work, settings)
    where = work.folder / f"solved{attempt}"
    futures = [
        solve_span.submit(parts, span, grid, work.cameras, left_out, settings, where)
        for span in work.all_spans()
    ]
    count = sum(results("solve objects", futures))
    LOGGER.info("solved %s", many(count, "position"))
    return where


def name(work: Work, solved: Path, settings: Settings) -> Names:
    """Return, for each span, what its objects are called in the night."""
    step("link objects", 0, 1)
    spans = [span for span in work.all_spans() if is_written(solved / span.folder)]
    names = name_objects(solved, spans)
    ends: dict[str, list[pa.Table]] = {"positions": [], "states": []}
    for span in spans:
        for table, found in ends.items():
            rows = outermost(read_part(solved / span.folder, table))
            found.append(renamed(rows, names[span.folder]))
    new_id: dict[str, str] = link_objects(
        concat(POSITIONS, ends["positions"]), concat(STATES, ends["states"]), settings
    )
    objects = {new_id.get(one, one) for own in names.values() for one in own.values()}
    LOGGER.info("named %s, knew %s again", many(len(objects), "object"), len(new_id))
    return {
        span: {old: new_id.get(one, one) for old, one in own.items()} for span, own in names.items()
    }


def set_clocks_right(work: Work, clocks: Sequence[Clock], settings: Settings, attempt: str) -> Work:
    """Put the frames of clocks that are off at their true times."""
    off = {clock.sensor_id: clock for clock in clocks if clock.is_off}
    where = {s: work.parts(f"identified{attempt}", s) for s in work.spans if s.sensor_id in off}
    futures = [
        correct_clock.submit(
            work.frames, sensor, work.identified[sensor], span, off[sensor.sensor_id], settings,
            where[sensor],
        )
        for sensor, span in work.by_span()
        if sensor in where
    ]  # fmt: skip
    results("correct clocks", futures)
    entered = {s: _entered(where[s], work.spans[s]) for s in where}
    spans = {s: sorted([*own, *entered.get(s, [])]) for s, own in work.spans.items()}
    return work._replace(spans=spans, identified={**work.identified, **where})


def _entered(parts: Path, spans: Sequence[Span]) -> list[Span]:
    """Return the spans that frames at their true times have entered; each gets an empty part.

    The frames stay in the parts they were in.
    """
    times = [array(read_part(parts / s.folder, "solutions", ["time"]), "time") for s in spans]
    starts = np.unique(np.concatenate(times) // SPAN_NS * SPAN_NS).tolist()
    entered = [span for t in starts if (span := Span(t, t + SPAN_NS)) not in spans]
    for span in entered:
        names = ("solutions", "stars", "detections", "rejects")
        empty = {name: read_part(parts / spans[0].folder, name).slice(0, 0) for name in names}
        write_part(parts / span.folder, empty)
    return entered


def stage(
    work: Work,
    parts: Sequence[SensorParts],
    solved: Path,
    names: Names,
    whole: Mapping[str, pa.Table],
    staged: Mapping[str, Path],
) -> None:
    """Put the parts together as the tables of each night, three tasks a night."""
    futures = []
    for night, folder in staged.items():
        day = int(np.datetime64(night, "D").astype(np.int64))
        own = [span for span in work.all_spans() if span.start_ns // DAY_NS == day]
        futures += [
            stage_night.submit(tables, folder, night, own, parts, solved, names, whole)
            for tables in SHARES
        ]
    results("publish", futures)
