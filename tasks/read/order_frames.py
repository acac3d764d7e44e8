"""Order frames: those of all logs by sensor and time, each once; states are converted to GCRF.

Frames stay in the parts of their logs; an index per sensor says where. So a night is never in
memory as a whole, whatever the order of its frames and the number of its logs. Each sensor is
ordered by itself, from the pieces of logs that have something of it.
"""

import itertools
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.logs.left_out import frames_left_out, stray_rejects
from epipole.io.work.parts import READ_SENSOR, read_part, write_part
from epipole.io.work.work_layout import ReadFolder
from epipole.schemas.arrays import Indices
from epipole.schemas.bridge import (
    array,
    concat,
    conform,
    from_polars,
    rows_with,
    table,
    to_polars,
    unstack_covariance,
)
from epipole.schemas.columns import OPTICS_AXES
from epipole.schemas.rejects import Reason, reject_rows
from epipole.schemas.settings import SensorSettings
from epipole.schemas.spans import DAY_NS, SPAN_NS, Span
from epipole.schemas.stages import Stage
from epipole.schemas.tables import REJECTS
from epipole.schemas.work_tables import CAMERAS, EXPOSURES, FRAME_INDEX, LOG_STATES, LogSource
from epipole.tasks.algorithms.times import (
    DUPLICATE_FRAME,
    DUPLICATE_NUMBER,
    DUPLICATE_TIME,
    KEEP,
    order_frames,
    order_states,
    restart_shifts,
)
from epipole.tasks.common.batches import Batch, in_batches
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.read.read_logs import ReadLog
from epipole.tasks.read.states_to_gcrf import states_to_gcrf

LOGGER = logging.getLogger(__name__)


_DUPLICATES = {
    DUPLICATE_FRAME: Reason.DUPLICATE_FRAME,
    DUPLICATE_NUMBER: Reason.DUPLICATE_NUMBER,
    DUPLICATE_TIME: Reason.DUPLICATE_TIME,
}


class SpanFrames(NamedTuple):
    """The frames of one sensor in a span: how many, and the time of the first and the last [ns]."""

    span: Span
    n_frames: int
    first_ns: int
    last_ns: int


class OrderedFrames(NamedTuple):
    """The frames of a run: where they are, and in memory only their counts and small tables."""

    folder: ReadFolder
    sensors: list[str]  # sorted; a sensor's number is its index here
    spans: list[list[SpanFrames]]  # of each sensor, in order
    cameras: pa.Table
    sources: list[LogSource]  # logs that gave something
    rejects: pa.Table
    pieces: list[list[Path]]  # of each sensor: parts of logs that have something of it

    @property
    def starts_ns(self) -> Indices:
        """The starts of all spans with frames."""
        return np.array([each.span.start_ns for found in self.spans for each in found], np.int64)

    @property
    def n_frames(self) -> int:
        """The number of frames."""
        return sum(each.n_frames for of_sensor in self.spans for each in of_sensor)


class SensorPieces(NamedTuple):
    """Where a sensor's frames and states are: pieces of logs, in the order of the logs."""

    number: int
    sensor_id: str
    pieces: list[tuple[LogSource, int, int]]  # the log's content, its number, and the piece

    def __str__(self) -> str:
        """Return the sensor's id."""
        return self.sensor_id


class _OrderedSensor(NamedTuple):
    """One sensor's frames; `rejects` are strays, each kind of duplicates, and repeated states."""

    spans: list[SpanFrames]
    rejects: list[pa.Table]


class OrderPlan(NamedTuple):
    """What there is to order: the logs, each content once, and the sensors in them."""

    folder: ReadFolder
    logs: list[ReadLog]
    sensors: list[SensorPieces]

    def batches(self) -> list[Batch[SensorPieces]]:
        """Return the sensors in batches, for `order_sensors`."""
        n_frames = dict.fromkeys((sensor.sensor_id for sensor in self.sensors), 0)
        for log in self.logs:
            for sensor_id, found in log.sensors.items():
                n_frames[sensor_id] += found.n_frames
        return in_batches(self.sensors, list(n_frames.values()))


def plan_order(folder: ReadFolder, logs: Sequence[ReadLog]) -> OrderPlan:
    """Return what there is to order. Of two logs with the same content one is used."""
    logs = _distinct(logs)
    pieces: dict[str, list[tuple[LogSource, int, int]]] = {}
    for log in logs:
        for sensor_id, found in log.sensors.items():
            of_log = [(log.source, log.number, piece) for piece in found.pieces]
            pieces.setdefault(sensor_id, []).extend(of_log)
    sensors = [SensorPieces(k, name, pieces[name]) for k, name in enumerate(sorted(pieces))]
    return OrderPlan(folder, logs, sensors)


@stage_task(Stage.READ, "{sensors}")
def order_sensors(
    folder: ReadFolder, sensors: Batch[SensorPieces], settings: SensorSettings
) -> list[_OrderedSensor]:
    """Order the frames and states of some sensors; each becomes a part, `READ_SENSOR`.

    A frame that occurs twice counts once; `order_frames` says what a repeat is.
    """
    return [_order_sensor(folder, sensor, settings) for sensor in sensors]


def ordered_logs(
    plan: OrderPlan, ordered: Sequence[_OrderedSensor], settings: SensorSettings
) -> OrderedFrames:
    """Return the frames of all sensors of the plan, which `order_sensors` has ordered."""
    parts = [plan.folder.piece(log.number, k) for log in plan.logs for k in range(log.n_pieces)]
    cameras = with_uncertain_principal_points(
        _sorted_cameras(parts), settings.principal_point_sigma_px or 0.0
    )
    rejects = [_piece_tables(parts, "rejects", REJECTS)]
    rejects += [rows for of_kind in zip(*(each.rejects for each in ordered), strict=True)
                for rows in of_kind]  # fmt: skip
    rejects.append(_without_anything(plan.logs))
    spans = [each.spans for each in ordered]
    sources = [log.source for log in plan.logs if log.is_source]
    return OrderedFrames(
        plan.folder,
        [sensor.sensor_id for sensor in plan.sensors],
        spans,
        cameras,
        _dated(sources, [each for found in spans for each in found]),
        concat(REJECTS, rejects),
        [[plan.folder.piece(log, k) for _, log, k in sensor.pieces] for sensor in plan.sensors],
    )


def order_logs(
    folder: ReadFolder, logs: Sequence[ReadLog], settings: SensorSettings
) -> OrderedFrames:
    """Order the content of logs, without tasks; the order of the logs does not matter."""
    plan = plan_order(folder, logs)
    ordered = [_order_sensor(folder, sensor, settings) for sensor in plan.sensors]
    return ordered_logs(plan, ordered, settings)


def frame_times(folder: ReadFolder, sensor: int) -> Indices:
    """Return the times [ns] of a sensor's frames, in order."""
    return array(read_part(folder.sensor(sensor), "index"), "time")


def frames_between(folder: ReadFolder, sensor: int, start_ns: int, end_ns: int) -> pa.Table:
    """Return EXPOSURES of a sensor from one instant to before another, sorted by time."""
    index = read_part(folder.sensor(sensor), "index")
    first, last = np.searchsorted(array(index, "time"), [start_ns, end_ns])
    index = index.slice(first, last - first)
    log, piece, row = (array(index, name) for name in ("log", "piece", "row"))
    tables, rank = [], []
    for number, k in sorted(set(zip(log.tolist(), piece.tolist(), strict=True))):
        rows = np.flatnonzero((log == number) & (piece == k))
        exposures = read_part(folder.piece(number, k), "exposures")
        tables.append(exposures.take(row[rows]))
        rank.append(rows)
    frames = concat(EXPOSURES, tables)
    if len(tables) > 1:
        frames = frames.take(np.argsort(np.concatenate(rank), kind="stable"))
    in_night = folder.day is None or array(index, "time") // DAY_NS == folder.day
    shift = np.where(in_night, array(index, "shift"), array(index, "shift_beside"))
    return _numbered_on(frames, shift)


def _numbered_on(frames: pa.Table, shift: Indices) -> pa.Table:
    """Return EXPOSURES with numbers that go on where the counter restarted."""
    if not shift.any():
        return frames
    number = pa.array(array(frames, "frame_number") + shift)
    return frames.set_column(
        frames.schema.get_field_index("frame_number"), EXPOSURES.field("frame_number"), number
    )


def states_between(folder: ReadFolder, sensor: int, start_ns: int, end_ns: int) -> pa.Table:
    """Return SENSOR_STATES of a sensor from one instant to before another, sorted by time."""
    states = read_part(folder.sensor(sensor), "states")
    first, last = np.searchsorted(array(states, "time"), [start_ns, end_ns])
    return states.slice(first, last - first)


def _distinct(logs: Sequence[ReadLog]) -> list[ReadLog]:
    """Return the logs sorted by name, each content once."""
    by_content: dict[str, ReadLog] = {}
    for log in sorted(logs, key=lambda log: (log.source.name, log.source.sha256)):
        first = by_content.setdefault(log.source.sha256, log)
        if first is not log:
            LOGGER.info(
                "%s has the same content as %s: used once", log.source.name, first.source.name
            )
    return list(by_content.values())


def _order_sensor(
    folder: ReadFolder, sensor: SensorPieces, settings: SensorSettings
) -> _OrderedSensor:
    keys, strays = _without_strays(_keys(folder, sensor), sensor)
    time_ns, number = array(keys, "time"), array(keys, "frame_number")
    shift, beside = _night_shifts(time_ns, number)
    day = time_ns // DAY_NS  # numbers may come again in another night
    order, verdict = order_frames(day, time_ns, number + shift)
    keys = keys.append_column("shift", pa.array(shift))
    keys = keys.append_column("shift_beside", pa.array(beside))
    index = conform(FRAME_INDEX, keys.take(order[verdict == KEEP]))
    states, repeats = _sorted_states(folder, sensor, settings)
    write_part(folder.sensor(sensor.number), READ_SENSOR, {"index": index, "states": states})
    duplicates = [
        frames_left_out(keys.take(order[verdict == code]), reason)
        for code, reason in _DUPLICATES.items()
    ]
    renumbered = order[(verdict == KEEP) & (shift[order] != 0)]
    restarted = [
        frames_left_out(keys.take(renumbered[day[renumbered] == night]), Reason.RESTARTED_COUNTER)
        for night in np.unique(day[renumbered]).tolist()
    ]
    duplicates.append(concat(REJECTS, restarted))
    return _OrderedSensor(by_span(array(index, "time")), [stray_rejects(strays), *duplicates,
                                                           repeats])  # fmt: skip


def _night_shifts(time_ns: Indices, number: Indices) -> tuple[Indices, Indices]:
    """Return what to add to the numbers of frames in their nights, and in the nights beside these.

    A night is numbered by its frames and those half an hour before and after it, so that its
    numbers do not depend on which other nights are read. In the nights beside, numbers are those of
    the frames that these take from this one; 0 of all others.
    """
    in_night, beside = np.zeros((2, len(time_ns)), np.int64)
    day = time_ns // DAY_NS
    for night in np.unique(day).tolist():
        span = Span(night * DAY_NS, (night + 1) * DAY_NS).widened(SPAN_NS)
        rows = np.flatnonzero(span.holds(time_ns))
        shift, inside = restart_shifts(time_ns[rows], number[rows]), day[rows] == night
        in_night[rows[inside]] = shift[inside]
        beside[rows[~inside]] = shift[~inside]
    return in_night, beside


def by_span(time_ns: Indices) -> list[SpanFrames]:
    """Return the frames, which are in order of time, by span."""
    number = time_ns // SPAN_NS
    bounds = np.flatnonzero(np.diff(number, prepend=-1, append=-1)).tolist()
    return [
        SpanFrames(
            Span(int(number[a]) * SPAN_NS, (int(number[a]) + 1) * SPAN_NS),
            b - a,
            int(time_ns[a]),
            int(time_ns[b - 1]),
        )
        for a, b in itertools.pairwise(bounds)
    ]


def _keys(folder: ReadFolder, sensor: SensorPieces) -> pa.Table:
    """Return a row per frame of a sensor: its key, its log, its piece and its row."""
    names = ["sensor_id", "frame_number", "time", "source"]
    located = ("log", "piece", "row")
    schema = pa.schema(
        [EXPOSURES.field(name) for name in names] + [FRAME_INDEX.field(name) for name in located]
    )
    rows = [schema.empty_table()]
    for _, log, piece in sensor.pieces:
        keys = read_part(folder.piece(log, piece), "exposures", names)
        row = np.flatnonzero(pc.equal(keys["sensor_id"], sensor.sensor_id).to_numpy())
        located_columns = (
            pa.array(np.full(len(row), log, np.int32)),
            pa.array(np.full(len(row), piece, np.int32)),
            pa.array(row),
        )
        columns = [*keys.take(row).columns, *located_columns]
        rows.append(pa.Table.from_arrays(columns, schema=schema))
    return pa.concat_tables(rows)


def _piece_tables(parts: Sequence[Path], name: str, schema: pa.Schema) -> pa.Table:
    return concat(schema, [read_part(part, name) for part in parts])


def _without_strays(keys: pa.Table, sensor: SensorPieces) -> tuple[pa.Table, pa.Table]:
    """Return the keys of frames within the time range of their log, and those of strays."""
    ranges: Mapping[int, tuple[int, int]] = {
        log: (source.first_time_ns or 0, source.last_time_ns or 0)
        for source, log, _ in sensor.pieces
    }
    logs, of_log = np.unique(array(keys, "log"), return_inverse=True)
    limits = np.array([ranges[log] for log in logs.tolist()], np.int64).reshape(-1, 2)[of_log]
    time_ns = array(keys, "time")
    inside = (time_ns >= limits[:, 0]) & (time_ns <= limits[:, 1])
    return keys.filter(pa.array(inside)), keys.filter(pa.array(~inside))


def _without_anything(logs: Sequence[ReadLog]) -> pa.Table:
    """Return a row of `rejects` for each log in which nothing can be used; no time is known."""
    empty = [log.source for log in logs if not log.is_source]
    for log in empty:
        LOGGER.warning("%s: %s", log.name, Reason.NOTHING_READ.sentence)
    return reject_rows(
        Reason.NOTHING_READ,
        source=[log.name for log in empty],
        offset=[log.size for log in empty],
        time=[0] * len(empty),
        count=[1] * len(empty),
    )


def _dated(sources: Sequence[LogSource], spans: Sequence[SpanFrames]) -> list[LogSource]:
    """Return the sources; one that has calibrations alone is part of the whole run."""
    if not spans:
        return list(sources)
    first, last = min(each.first_ns for each in spans), max(each.last_ns for each in spans)
    return [
        source._replace(first_time_ns=first, last_time_ns=last)
        if source.first_time_ns is None
        else source
        for source in sources
    ]


def _sorted_states(
    folder: ReadFolder, sensor: SensorPieces, settings: SensorSettings
) -> tuple[pa.Table, pa.Table]:
    """Return one sensor's states in GCRF, sorted, each time once; and the rejects of repeats."""
    states, names = [], []
    for source, log, piece in sensor.pieces:
        all_states = read_part(folder.piece(log, piece), "states")
        states.append(rows_with(all_states, "sensor_id", sensor.sensor_id))
        names += [source.name] * states[-1].num_rows
    rows = concat(LOG_STATES, states)
    order, repeats = order_states(
        np.zeros(rows.num_rows, np.int64),
        array(rows, "time"),
        pc.is_valid(rows["qx"]).to_numpy(),
        array(rows, "position_sigma_km"),
    )
    named = rows.select(["sensor_id", "time"]).append_column("source", pa.array(names, pa.string()))
    rejects = frames_left_out(named.take(pa.array(order[repeats])), Reason.DUPLICATE_STATE)
    return states_to_gcrf(rows.take(pa.array(order[~repeats])), settings.position_sigma_km), rejects


def _sorted_cameras(parts: Sequence[Path]) -> pa.Table:
    """Return the calibrations sorted by sensor and time, without those that repeat the one before.

    Each log of a sensor states its calibration again, and a recorder may with each frame. So all
    of them are in memory only of sensors that have several different ones.
    """
    pieces = [_first_of_each(to_polars(read_part(part, "cameras"))) for part in parts]
    different = _first_of_each(pl.concat([to_polars(CAMERAS.empty_table()), *pieces]))
    changing = different.filter(pl.col("sensor_id").is_duplicated())["sensor_id"].unique()
    again = [
        to_polars(read_part(part, "cameras")).filter(pl.col("sensor_id").is_in(changing.implode()))
        for part in (parts if len(changing) else ())
    ]
    rows = pl.concat([different, *again]).sort(CAMERAS.names)
    run = pl.struct(pl.exclude("time")).rle_id()
    return from_polars(CAMERAS, rows.filter(run.is_first_distinct()))


def _first_of_each(cameras: pl.DataFrame) -> pl.DataFrame:
    """Return the earliest of equal calibrations: rows of CAMERAS, in any order."""
    optics = [name for name in CAMERAS.names if name != "time"]
    return cameras.group_by(optics).agg(pl.col("time").min()).select(CAMERAS.names)


def with_uncertain_principal_points(cameras: pa.Table, sigma_px: float) -> pa.Table:
    """Return CAMERAS with principal points that have this 1-sigma error per axis."""
    is_centre = np.isin(OPTICS_AXES, ["cx", "cy"])
    cov = np.broadcast_to(
        np.diag(is_centre * sigma_px**2), (cameras.num_rows, len(is_centre), len(is_centre))
    )
    columns = unstack_covariance("cov_{}", cov, OPTICS_AXES)
    return table(CAMERAS, {name: cameras[name] for name in CAMERAS.names} | columns)
