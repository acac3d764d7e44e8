"""Order frames: those of all logs by sensor and time, each once, and states in GCRF.

Frames stay where reading put them; an index a sensor says where. So a night is never in
memory, whatever the order of its frames and the number of its logs.
"""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.catalogues.earth_orientation import read_earth_orientation
from epipole.io.logs.damage import STAGE
from epipole.io.work.files import read_part, write_part
from epipole.schemas.bridge import array, concat, conform, nullable, stack, table, unstack
from epipole.schemas.log_tables import ITRF, LOG_STATES, LogSource
from epipole.schemas.settings import Settings
from epipole.schemas.tables import REJECTS
from epipole.schemas.work_tables import CAMERAS, EXPOSURES, FRAME_INDEX, SENSOR_STATES
from epipole.tasks.algorithms.orbits.reference_frames import orientation_at, to_gcrf
from epipole.tasks.algorithms.time.frame_order import (
    DUPLICATE_FRAME,
    DUPLICATE_NUMBER,
    DUPLICATE_TIME,
    KEEP,
    order_frames,
    order_states,
)
from epipole.tasks.read.read_logs import ReadLog

LOGGER = logging.getLogger(__name__)

Indices = npt.NDArray[np.int64]

_DUPLICATES = {
    DUPLICATE_FRAME: "duplicate_frame",
    DUPLICATE_NUMBER: "duplicate_number",
    DUPLICATE_TIME: "duplicate_time",
}


class OrderedFrames(NamedTuple):
    """The frames of a run: where they lie and, in memory, what is small."""

    folder: Path
    sensors: list[str]  # sorted; a sensor's number is its place here
    time_ns: list[Indices]  # of each sensor's frames
    cameras: pa.Table
    sources: list[LogSource]
    rejects: pa.Table


def order_logs(folder: Path, logs: Sequence[ReadLog], settings: Settings) -> OrderedFrames:
    """Put what was read in order; the order of the logs does not matter.

    A frame that comes twice counts once; see `order_frames` for what is a repeat. A log that
    is given twice is used once.
    """
    logs = _distinct(logs)
    keys = _keys(logs)
    sensors = sorted(set(_names(logs, "exposures")) | set(_names(logs, "states")))
    sensor = _numbers(keys["sensor_id"], sensors)
    order, verdict = order_frames(sensor, array(keys, "time"), array(keys, "frame_number"))
    rejects = [_part_tables(logs, "rejects", REJECTS)]
    rejects += [
        _repeats(keys.take(order[verdict == code]), reason) for code, reason in _DUPLICATES.items()
    ]
    kept = order[verdict == KEEP]
    time_ns = []
    for number in range(len(sensors)):
        own = keys.take(kept[sensor[kept] == number])
        states, repeats = _sorted_states(logs, sensors[number], settings)
        rejects.append(repeats)
        index = conform(FRAME_INDEX, own)
        write_part(folder / f"sensor-{number}", {"index": index, "states": states})
        time_ns.append(array(own, "time"))
    cameras = _sorted_cameras(_part_tables(logs, "cameras", CAMERAS))
    left_out = concat(REJECTS, rejects)
    return OrderedFrames(folder, sensors, time_ns, cameras, [log.source for log in logs], left_out)


def frames_between(folder: Path, sensor: int, start_ns: int, end_ns: int) -> pa.Table:
    """Return EXPOSURES of a sensor's frames from one instant to before another, by time."""
    index = read_part(folder / f"sensor-{sensor}", "index")
    first, last = np.searchsorted(array(index, "time"), [start_ns, end_ns])
    index = index.slice(first, last - first)
    log, part, row = (array(index, name) for name in ("log", "part", "row"))
    key = log.astype(np.int64) << 32 | part
    pieces, rank = [], []
    for one in np.unique(key):
        own = np.flatnonzero(key == one)
        exposures = read_part(_part(folder, int(one >> 32), int(one & 0xFFFFFFFF)), "exposures")
        pieces.append(exposures.take(row[own]))
        rank.append(own)
    frames = concat(EXPOSURES, pieces)
    if len(pieces) < 2:
        return frames
    return frames.take(np.argsort(np.concatenate(rank), kind="stable"))


def states_between(folder: Path, sensor: int, start_ns: int, end_ns: int) -> pa.Table:
    """Return SENSOR_STATES of a sensor from one instant to before another, by time."""
    states = read_part(folder / f"sensor-{sensor}", "states")
    first, last = np.searchsorted(array(states, "time"), [start_ns, end_ns])
    return states.slice(first, last - first)


def _part(folder: Path, log: int, part: int) -> Path:
    return folder / f"log-{log}" / f"part-{part}"


def _distinct(logs: Sequence[ReadLog]) -> list[ReadLog]:
    """Return the logs by name and content, each content once."""
    by_content: dict[str, ReadLog] = {}
    for log in sorted(logs, key=lambda log: (log.source.name, log.source.sha256)):
        first = by_content.setdefault(log.source.sha256, log)
        if first is not log:
            LOGGER.info("%s holds the same as %s: used once", log.source.name, first.source.name)
    return list(by_content.values())


def _keys(logs: Sequence[ReadLog]) -> pa.Table:
    """Return a row a frame of all logs: its key, its log and where it lies."""
    names = ["sensor_id", "frame_number", "time", "source"]
    kinds = [EXPOSURES.field(name) for name in names] + [
        FRAME_INDEX.field(name) for name in ("log", "part", "row")
    ]
    rows = [pa.schema(kinds).empty_table()]
    for log in logs:
        for part in log.parts:
            own = read_part(part, "exposures", names)
            n = own.num_rows
            number, at = int(part.parent.name[4:]), int(part.name[5:])
            rows.append(
                pa.Table.from_arrays(
                    [
                        *own.columns,
                        pa.array(np.full(n, number, np.int32)),
                        pa.array(np.full(n, at, np.int32)),
                        pa.array(np.arange(n)),
                    ],
                    schema=pa.schema(kinds),
                )
            )
    return pa.concat_tables(rows)


def _names(logs: Sequence[ReadLog], name: str) -> set[str]:
    """Return the sensors that a table of the logs names."""
    found: set[str] = set()
    for log in logs:
        for part in log.parts:
            found |= set(pc.unique(read_part(part, name)["sensor_id"]).to_pylist())
    return found


def _numbers(sensor_id: pa.ChunkedArray, sensors: list[str]) -> Indices:
    found = pc.index_in(sensor_id, pa.array(sensors, pa.string()))
    return np.asarray(found.to_numpy(), np.int64)


def _part_tables(logs: Sequence[ReadLog], name: str, schema: pa.Schema) -> pa.Table:
    return concat(schema, [read_part(part, name) for log in logs for part in log.parts])


def _repeats(frames: pa.Table, reason: str) -> pa.Table:
    """Return a row of `rejects` a sensor and log: when the first repeat was, how many."""
    grouped = frames.group_by(["sensor_id", "source"], use_threads=False).aggregate(
        [("time", "min"), ("time", "count")]
    )
    n = grouped.num_rows
    return table(
        REJECTS,
        {
            "source": grouped["source"],
            "offset": [None] * n,
            "sensor_id": grouped["sensor_id"],
            "time": grouped["time_min"],
            "stage": [STAGE] * n,
            "reason": [reason] * n,
            "count": grouped["time_count"],
        },
    )


def _sorted_states(
    logs: Sequence[ReadLog], sensor_id: str, settings: Settings
) -> tuple[pa.Table, pa.Table]:
    """Return one sensor's states in GCRF, sorted and each once, and the rejects for the rest."""
    states, names = [], []
    for log in logs:
        for part in log.parts:
            own = read_part(part, "states").filter(pc.field("sensor_id") == sensor_id)
            states.append(own)
            names += [log.source.name] * own.num_rows
    rows = concat(LOG_STATES, states)
    order, repeats = order_states(np.zeros(rows.num_rows, np.int64), array(rows, "time"))
    named = rows.select(["sensor_id", "time"]).append_column("source", pa.array(names, pa.string()))
    rejects = _repeats(named.take(pa.array(order[repeats])), "duplicate_state")
    return _turned_to_gcrf(rows.take(pa.array(order[~repeats])), settings), rejects


def _turned_to_gcrf(states: pa.Table, settings: Settings) -> pa.Table:
    """Return SENSOR_STATES of LOG_STATES, row by row.

    Where the Earth-orientation table does not reach, an Earth-fixed position is less well
    known than its sigma says; the sigma returned says so.
    """
    time_ns, frame = array(states, "time"), array(states, "frame")
    r_km, v_km_s = stack(states, "{}_km"), stack(states, "v{}_km_s")
    sigma_km = array(states, "position_sigma_km").copy()
    for name in sorted(set(frame)):
        i = np.flatnonzero(frame == name)
        orientation = orientation_at(time_ns[i], *read_earth_orientation())
        r_km[i], v_km_s[i] = to_gcrf(name, time_ns[i], r_km[i], v_km_s[i], orientation)
        if name == ITRF and orientation.sigma_rad.any():
            turn_km = orientation.sigma_rad * np.linalg.norm(r_km[i], axis=1)
            own_km = np.where(sigma_km[i] > 0, sigma_km[i], settings.sensors.position_sigma_km)
            sigma_km[i] = np.where(turn_km > 0, np.hypot(own_km, turn_km), sigma_km[i])
            _warn_of_orientation(turn_km)
    values = {name: states[name] for name in SENSOR_STATES.names}
    values.update(unstack("{}_km", r_km), position_sigma_km=sigma_km)
    values.update({n: nullable(v) for n, v in unstack("v{}_km_s", v_km_s).items()})
    return table(SENSOR_STATES, values)


def _warn_of_orientation(turn_km: npt.NDArray[np.float64]) -> None:
    end = np.datetime64("1858-11-17") + int(read_earth_orientation().mjd[-1])
    LOGGER.warning(
        "%d ITRF states lie outside the Earth-orientation table (it ends %s): their positions "
        "are uncertain by up to %.3f km more; a newer astropy-iers-data helps",
        np.count_nonzero(turn_km),
        end,
        turn_km.max(),
    )


def _sorted_cameras(cameras: pa.Table) -> pa.Table:
    """Return the calibrations by sensor and time, those that say the same at one time once."""
    unique = cameras.group_by(CAMERAS.names, use_threads=False).aggregate([])
    return conform(CAMERAS, unique.sort_by([(name, "ascending") for name in CAMERAS.names]))
