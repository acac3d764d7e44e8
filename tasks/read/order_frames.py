"""Order frames: those of all logs by sensor and time, each once; states are converted to GCRF.

Frames stay in the parts of their logs; an index per sensor says where. So a night is never in
memory as a whole, whatever the order of its frames and the number of its logs.
"""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.logs.left_out import frames_left_out, stray_rejects
from epipole.io.work.parts import READ_SENSOR, read_part, write_part
from epipole.io.work.work_layout import ReadFolder
from epipole.schemas.bridge import array, concat, conform, table, unstack_covariance
from epipole.schemas.columns import OPTICS_AXES
from epipole.schemas.rejects import Reason
from epipole.schemas.settings import SensorSettings
from epipole.schemas.tables import REJECTS
from epipole.schemas.work_tables import CAMERAS, EXPOSURES, FRAME_INDEX, LOG_STATES, LogSource
from epipole.tasks.algorithms.times import (
    DUPLICATE_FRAME,
    DUPLICATE_NUMBER,
    DUPLICATE_TIME,
    KEEP,
    order_frames,
    order_states,
)
from epipole.tasks.read.read_logs import ReadLog
from epipole.tasks.read.states_to_gcrf import states_to_gcrf

LOGGER = logging.getLogger(__name__)

Indices = npt.NDArray[np.int64]

_DUPLICATES = {
    DUPLICATE_FRAME: Reason.DUPLICATE_FRAME,
    DUPLICATE_NUMBER: Reason.DUPLICATE_NUMBER,
    DUPLICATE_TIME: Reason.DUPLICATE_TIME,
}


class OrderedFrames(NamedTuple):
    """The frames of a run: where they are, and in memory only their times and small tables."""

    folder: ReadFolder
    sensors: list[str]  # sorted; a sensor's number is its index here
    time_ns: list[Indices]  # of each sensor's frames
    cameras: pa.Table
    sources: list[LogSource]
    rejects: pa.Table


def order_logs(
    folder: ReadFolder, logs: Sequence[ReadLog], settings: SensorSettings
) -> OrderedFrames:
    """Order the content of logs; the order of the logs does not matter.

    A frame that occurs twice counts once; `order_frames` says what a repeat is. Of two logs with
    the same content one is used.
    """
    logs = _distinct(logs)
    pieces = {(log.number, k): folder.piece(log.number, k) for log in logs
              for k in range(log.n_pieces)}  # fmt: skip
    keys, strays = _without_strays(_keys(pieces), logs)
    sensors = sorted(_names(pieces, "exposures") | _names(pieces, "states"))
    sensor = _numbers(keys["sensor_id"], sensors)
    order, verdict = order_frames(sensor, array(keys, "time"), array(keys, "frame_number"))
    rejects = [_piece_tables(pieces, "rejects", REJECTS), stray_rejects(strays)]
    rejects += [
        frames_left_out(keys.take(order[verdict == code]), reason)
        for code, reason in _DUPLICATES.items()
    ]
    kept = order[verdict == KEEP]
    time_ns = []
    for number in range(len(sensors)):
        index = conform(FRAME_INDEX, keys.take(kept[sensor[kept] == number]))
        states, repeats = _sorted_states(folder, logs, sensors[number], settings)
        rejects.append(repeats)
        write_part(folder.sensor(number), READ_SENSOR, {"index": index, "states": states})
        time_ns.append(array(index, "time"))
    cameras = with_uncertain_principal_points(
        _sorted_cameras(_piece_tables(pieces, "cameras", CAMERAS)),
        settings.principal_point_sigma_px or 0.0,
    )
    left_out = concat(REJECTS, rejects)
    sources = _dated([log.source for log in logs], array(keys, "time"))
    return OrderedFrames(folder, sensors, time_ns, cameras, sources, left_out)


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
    if len(tables) < 2:
        return frames
    return frames.take(np.argsort(np.concatenate(rank), kind="stable"))


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


def _keys(pieces: Mapping[tuple[int, int], Path]) -> pa.Table:
    """Return a row per frame of all pieces: its key, its log, its piece and its row."""
    names = ["sensor_id", "frame_number", "time", "source"]
    located = ("log", "piece", "row")
    schema = pa.schema(
        [EXPOSURES.field(name) for name in names] + [FRAME_INDEX.field(name) for name in located]
    )
    rows = [schema.empty_table()]
    for (log, piece), part in pieces.items():
        keys = read_part(part, "exposures", names)
        n = keys.num_rows
        located_columns = (
            pa.array(np.full(n, log, np.int32)),
            pa.array(np.full(n, piece, np.int32)),
            pa.array(np.arange(n)),
        )
        rows.append(pa.Table.from_arrays([*keys.columns, *located_columns], schema=schema))
    return pa.concat_tables(rows)


def _names(pieces: Mapping[tuple[int, int], Path], name: str) -> set[str]:
    """Return the ids of the sensors in one table of all pieces."""
    tables = (read_part(part, name, ["sensor_id"]) for part in pieces.values())
    return {sensor for rows in tables for sensor in pc.unique(rows["sensor_id"]).to_pylist()}


def _numbers(sensor_id: pa.ChunkedArray, sensors: list[str]) -> Indices:
    numbers = pc.index_in(sensor_id, pa.array(sensors, pa.string()))
    return np.asarray(numbers.to_numpy(), np.int64)


def _piece_tables(pieces: Mapping[tuple[int, int], Path], name: str, schema: pa.Schema) -> pa.Table:
    return concat(schema, [read_part(part, name) for part in pieces.values()])


def _without_strays(keys: pa.Table, logs: Sequence[ReadLog]) -> tuple[pa.Table, pa.Table]:
    """Return the keys of frames within the time range of their log, and those of strays."""
    n_logs = max((log.number for log in logs), default=-1) + 1
    first, last = np.zeros(n_logs, np.int64), np.zeros(n_logs, np.int64)
    for log in logs:
        first[log.number] = log.source.first_time_ns or 0
        last[log.number] = log.source.last_time_ns or 0
    log_of, time_ns = array(keys, "log"), array(keys, "time")
    inside = (time_ns >= first[log_of]) & (time_ns <= last[log_of])
    return keys.filter(pa.array(inside)), keys.filter(pa.array(~inside))


def _dated(sources: Sequence[LogSource], time_ns: Indices) -> list[LogSource]:
    """Return the sources; one without any time is part of the whole run."""
    if not len(time_ns):
        return list(sources)
    first, last = int(time_ns.min()), int(time_ns.max())
    return [
        source._replace(first_time_ns=first, last_time_ns=last)
        if source.first_time_ns is None
        else source
        for source in sources
    ]


def _sorted_states(
    folder: ReadFolder, logs: Sequence[ReadLog], sensor_id: str, settings: SensorSettings
) -> tuple[pa.Table, pa.Table]:
    """Return one sensor's states in GCRF, sorted, each time once; and the rejects of repeats."""
    states, names = [], []
    for log in logs:
        for k in range(log.n_pieces):
            all_states = read_part(folder.piece(log.number, k), "states")
            states.append(all_states.filter(pc.field("sensor_id") == sensor_id))
            names += [log.source.name] * states[-1].num_rows
    rows = concat(LOG_STATES, states)
    order, repeats = order_states(np.zeros(rows.num_rows, np.int64), array(rows, "time"))
    named = rows.select(["sensor_id", "time"]).append_column("source", pa.array(names, pa.string()))
    rejects = frames_left_out(named.take(pa.array(order[repeats])), Reason.DUPLICATE_STATE)
    return states_to_gcrf(rows.take(pa.array(order[~repeats])), settings.position_sigma_km), rejects


def _sorted_cameras(cameras: pa.Table) -> pa.Table:
    """Return the calibrations sorted by sensor and time; equal rows count once."""
    unique = cameras.group_by(CAMERAS.names, use_threads=False).aggregate([])
    return conform(CAMERAS, unique.sort_by([(name, "ascending") for name in CAMERAS.names]))


def with_uncertain_principal_points(cameras: pa.Table, sigma_px: float) -> pa.Table:
    """Return CAMERAS with principal points that have this 1-sigma error per axis."""
    is_centre = np.isin(OPTICS_AXES, ["cx", "cy"])
    cov = np.broadcast_to(
        np.diag(is_centre * sigma_px**2), (cameras.num_rows, len(is_centre), len(is_centre))
    )
    columns = unstack_covariance("cov_{}", cov, OPTICS_AXES)
    return table(CAMERAS, {name: cameras[name] for name in CAMERAS.names} | columns)
