"""Logs to frames, states and calibrations of all sensors, each once and in order."""

import logging
import os
from collections.abc import Iterator, Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from prefect import task
from prefect.cache_policies import NO_CACHE

from epipole.io.earth_orientation import read_earth_orientation
from epipole.io.log_reader import read_log
from epipole.io.log_rejects import STAGE
from epipole.schemas.bridge import array, concat, conform, nullable, stack, table, unstack
from epipole.schemas.errors import LogError
from epipole.schemas.log_tables import ITRF, LOG_STATES, Log, LogPart
from epipole.schemas.settings import Settings
from epipole.schemas.tables import REJECTS
from epipole.schemas.work_tables import CAMERAS, EXPOSURES, SENSOR_STATES
from epipole.tasks.algorithms.frame_order import (
    DUPLICATE_FRAME,
    DUPLICATE_NUMBER,
    DUPLICATE_TIME,
    KEEP,
    order_frames,
    order_states,
)
from epipole.tasks.algorithms.list_order import take_lists
from epipole.tasks.algorithms.reference_frames import orientation_at, to_gcrf
from epipole.tasks.retries import DELAYS_S, RETRIES, storage_failed

logger = logging.getLogger(__name__)

MOST_CENTROIDS = (1 << 31) - 1  # that Arrow's lists can count

_DUPLICATES = {
    DUPLICATE_FRAME: "duplicate_frame",
    DUPLICATE_NUMBER: "duplicate_number",
    DUPLICATE_TIME: "duplicate_time",
}


@task(
    name="read logs",
    cache_policy=NO_CACHE,
    retries=RETRIES,
    retry_delay_seconds=DELAYS_S,
    retry_condition_fn=storage_failed,
)
def read_logs(
    paths: Sequence[str | os.PathLike[str]],
    settings: Settings,
    start_ns: int | None = None,
    end_ns: int | None = None,
) -> Log:
    """What the logs hold together; the order of the paths does not matter.

    A frame that comes twice counts once; see `order_frames` for what is a repeat. A log that
    is given twice is read once. With a range of time only its frames are read, and of states
    as many more as `read_log` says; logs that have nothing in it are no sources.
    """
    parts = _distinct([read_log(path, start_ns, end_ns) for path in paths])
    if not parts:
        raise LogError("no logs given; name at least one MCAP file")
    sources = [part.source for part in parts if part.exposures.num_rows or part.states.num_rows]
    states, duplicate_states = _sorted_states(parts, settings)
    cameras = _sorted_cameras(concat(CAMERAS, [part.cameras for part in parts]))
    rejects = [part.rejects for part in parts]
    frames = {
        name: pa.chunked_array([c for part in parts for c in part.exposures[name].chunks], kind)
        for name, kind in zip(EXPOSURES.names, EXPOSURES.types, strict=True)
    }
    del parts  # so that `_sorted_frames` has the only hold on the frames
    exposures, duplicate_frames = _sorted_frames(frames)
    if not exposures.num_rows:
        raise LogError(_nothing_in_range(paths, start_ns, end_ns))
    left_out = concat(REJECTS, [*rejects, duplicate_frames, duplicate_states])
    logger.info(
        "read %d logs: %d frames, %d states, %d calibrations, %d left out",
        len(paths),
        exposures.num_rows,
        states.num_rows,
        cameras.num_rows,
        pc.sum(left_out["count"]).as_py() or 0,
    )
    return Log(exposures, states, cameras, sources, left_out)


def _nothing_in_range(
    paths: Sequence[str | os.PathLike[str]], start_ns: int | None, end_ns: int | None
) -> str:
    limits = [
        "..." if t is None else f"{np.datetime64(t, 'ns').astype('datetime64[s]')}Z"
        for t in (start_ns, end_ns)
    ]
    names = ", ".join(os.fspath(path) for path in paths)
    return f"{names}: no frames from {limits[0]} to {limits[1]}; give logs of that time"


def _distinct(parts: list[LogPart]) -> list[LogPart]:
    """Return the parts by name and content, each content once."""
    by_content: dict[str, LogPart] = {}
    for part in sorted(parts, key=lambda part: (part.source.name, part.source.sha256)):
        first = by_content.setdefault(part.source.sha256, part)
        if first is not part:
            logger.info("%s holds the same as %s: read once", part.source.name, first.source.name)
    return list(by_content.values())


def _sensor_index(sensor_id: pa.ChunkedArray) -> np.ndarray:
    """Return the sensors as integers that sort as their ids do."""
    encoded = pa.chunked_array([*sensor_id.chunks, pa.array([], pa.string())])
    encoded = encoded.combine_chunks().dictionary_encode()
    names = encoded.dictionary.to_pylist()
    rank = np.zeros(len(names), np.int64)
    rank[sorted(range(len(names)), key=names.__getitem__)] = np.arange(len(names))
    return rank[encoded.indices.to_numpy()]


def _sorted_frames(frames: dict[str, pa.ChunkedArray]) -> tuple[pa.Table, pa.Table]:
    """Return the exposures sorted and each once, and the rejects for the rest.

    The columns are taken out of `frames` one by one: there is never a second copy of all.
    """
    key = pa.table({name: frames[name] for name in ("sensor_id", "time", "frame_number", "source")})
    order, verdict = order_frames(
        _sensor_index(key["sensor_id"]), array(key, "time"), array(key, "frame_number")
    )
    rejects = [
        _repeats(key.take(pa.array(order[verdict == code])), reason)
        for code, reason in _DUPLICATES.items()
    ]
    keep = order[verdict == KEEP]
    columns = {
        name: _taken_lists(name, frames.pop(name).chunks, keep)
        if pa.types.is_list(EXPOSURES.field(name).type)
        else frames.pop(name).take(pa.array(keep)).combine_chunks()
        for name in EXPOSURES.names
    }
    return table(EXPOSURES, columns), concat(REJECTS, rejects)


def _taken_lists(name: str, chunks: list[pa.ListArray], rows: np.ndarray) -> pa.ListArray:
    """Return rows of a column of lists; `chunks` is emptied, each piece as soon as it is done."""
    nothing = [np.empty(0, np.int64)]
    lengths = np.concatenate([*nothing, *(np.diff(c.offsets.to_numpy()) for c in chunks)])
    given = np.concatenate([*nothing, *(c.is_valid().to_numpy(False) for c in chunks)]) > 0
    if lengths.sum() > MOST_CENTROIDS:
        raise LogError(f"{lengths.sum():,} centroids are too many for one run; give fewer logs")
    chunks.reverse()

    def pieces() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        while chunks:
            chunk = chunks.pop()
            yield chunk.values.to_numpy(), chunk.offsets.to_numpy()

    values, first = take_lists(pieces(), lengths, rows)
    pa.default_memory_pool().release_unused()
    missing = pa.array(~given[rows]) if not given.all() else None
    return pa.ListArray.from_arrays(
        pa.array(first, pa.int32()), pa.array(values), type=EXPOSURES.field(name).type, mask=missing
    )


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


def _sorted_states(parts: list[LogPart], settings: Settings) -> tuple[pa.Table, pa.Table]:
    """Return the states in GCRF, sorted and each once, and the rejects for the rest."""
    names = [name for part in parts for name in [part.source.name] * part.states.num_rows]
    states = concat(LOG_STATES, [part.states for part in parts])
    order, repeats = order_states(_sensor_index(states["sensor_id"]), array(states, "time"))
    named = states.select(["sensor_id", "time"])
    named = named.append_column("source", pa.array(names, pa.string()))
    rejects = _repeats(named.take(pa.array(order[repeats])), "duplicate_state")
    return _turned_to_gcrf(states.take(pa.array(order[~repeats])), settings), rejects


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


def _warn_of_orientation(turn_km: np.ndarray) -> None:
    end = np.datetime64("1858-11-17") + int(read_earth_orientation().mjd[-1])
    logger.warning(
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
