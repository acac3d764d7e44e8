"""Logs as tables, in and out."""

import heapq
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import polars as pl
import pyarrow as pa

from epipole.io.logs import reader
from epipole.io.logs.messages.batches import valid_sensor_id
from epipole.io.logs.writer import LogWriter
from epipole.schemas.bridge import rows_of, table, table_name, to_polars
from epipole.schemas.errors import LogWarning
from epipole.schemas.log_checks import mistakes
from epipole.schemas.log_messages import SENSOR_ID_RULE
from epipole.schemas.rejects import left_out
from epipole.schemas.settings import SensorSettings
from epipole.schemas.work_tables import CAMERAS, EXPOSURES, SENSOR_STATES
from epipole.tasks.algorithms.geometry.camera import Camera
from epipole.tasks.read.judge_sensor import judge_log
from epipole.tasks.read.states_to_gcrf import states_to_gcrf


class LogTables(NamedTuple):
    """The content of a log.

    Attributes
    ----------
    frames : polars.DataFrame
        One row per frame: `sensor_id`, `frame_number`, `time` (middle of the exposure, UTC),
        `exposure_s`, and the lists `x_px`, `y_px`, `flux`, `sigma_px` of its centroids. The last
        two are null if missing.
    states : polars.DataFrame
        One row per state of a sensor: `sensor_id`, `time`, position `x_km`, `y_km`, `z_km` and
        velocity `vx_km_s`, `vy_km_s`, `vz_km_s` (GCRF), `position_sigma_km` (0: unknown), the
        prior attitude `qx`, `qy`, `qz`, `qw` (sensor from ICRS, null if missing) and
        `attitude_sigma_arcsec` (0: unknown).
    cameras : polars.DataFrame
        One row per calibration: `sensor_id`, `time` (from when on it holds), and the fields of
        `Camera`.
    rejects : polars.DataFrame
        One row per thing that could not be used, with its reason.
    """

    frames: pl.DataFrame
    states: pl.DataFrame
    cameras: pl.DataFrame
    rejects: pl.DataFrame


Table: TypeAlias = pl.DataFrame | pl.LazyFrame | pa.Table | Mapping[str, Any]

_FRAMES = pa.schema([f for f in EXPOSURES if f.name not in ("source", "offset")],
                    {"table": "frames"})  # fmt: skip
_UNKNOWN_IS_0 = ("position_sigma_km", "attitude_sigma_arcsec")
_STATES = pa.schema([f.with_nullable(f.nullable or f.name in _UNKNOWN_IS_0) for f in SENSOR_STATES],
                    {"table": "states"})  # fmt: skip
_CAMERAS = pa.schema([f for f in CAMERAS if not f.name.startswith("cov_")], {"table": "cameras"})
_VECTORS = (("vx_km_s", "vy_km_s", "vz_km_s"), ("qx", "qy", "qz", "qw"))  # null or whole
# What a column has that is left out.
_DEFAULTS: dict[str, Any] = {
    "exposure_s": 0.0, "flux": None, "sigma_px": None,
    "vx_km_s": None, "vy_km_s": None, "vz_km_s": None, "position_sigma_km": 0.0,
    "qx": None, "qy": None, "qz": None, "qw": None, "attitude_sigma_arcsec": 0.0,
    "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0, "k4": 0.0, "fisheye": False,
    "line_time_s": 0.0,
}  # fmt: skip


def read_log(path: str | os.PathLike[str]) -> LogTables:
    """Return what a log holds, as tables.

    Parameters
    ----------
    path
        An MCAP file, or an fsspec URL such as ``s3://bucket/night.mcap``.

    Returns
    -------
    LogTables
        Frames, states (in GCRF, whatever the frame of the log), cameras, and what could not be
        used, in the order of the log. The whole log is in memory.

    Raises
    ------
    LogError
        Where there is no such file, or it is not MCAP. It is a `ValueError`.

    Examples
    --------
    >>> from epipole.flows import api
    >>> log = api.read_log("examples/four_sensor_geo.mcap")
    >>> log.frames.height, log.states.height, log.cameras["sensor_id"].to_list()
    (240, 260, ['sat1', 'sat2', 'sat3', 'sat4'])
    >>> log.frames["x_px"].list.len().median()
    18.0
    """
    found = reader.read_log(path)
    states = states_to_gcrf(found.states, SensorSettings().position_sigma_km)
    return LogTables(
        to_polars(found.exposures.select(_FRAMES.names)),
        to_polars(states.select(_STATES.names)),
        to_polars(found.cameras.select(_CAMERAS.names)),
        to_polars(found.rejects),
    )


def write_log(
    path: str | os.PathLike[str],
    frames: Table,
    states: Table,
    cameras: Table,
    *,
    encoding: str = "protobuf",
) -> None:
    """Write a log from tables like those of `read_log`, and say what is wrong with it.

    Parameters
    ----------
    path
        The MCAP file to write. It gets its name when it is complete.
    frames, states, cameras
        Polars or Arrow tables, or columns by name, as `LogTables` has them, in any order of rows.
        These columns may be
        left out: `exposure_s`, `flux`, `sigma_px`; velocities, sigmas and attitudes of states;
        distortions `k1`, `k2`, `p1`, `p2`, `k3`, `k4`, `fisheye` and `line_time_s` of cameras.
        Times are UTC, positions GCRF. A sensor's id has 1 to 63 letters of A-Z and a-z, digits, -
        and _; the first is a letter or digit. A null sigma of a state is unknown, as 0 is.
    encoding
        Of the messages: protobuf, json or ros2.

    Raises
    ------
    ValueError
        Where a column is missing, unknown, of the wrong type, or null where it may not be; where a
        velocity or an attitude has a part of its components; where
        the lists of a frame differ in length; where a sensor's id is invalid; where a pinhole has
        `k4`, or a fisheye `p1` or `p2`; where the encoding is unknown, or ros2 where
        the tables have a time after 2038 or a `line_time_s`, which its messages cannot hold.

    Warns
    -----
    LogWarning
        For each mistake that `epipole doctor` names in the log, and for each reason why a reader
        leaves something out. The log is written all the same.

    Examples
    --------
    >>> from epipole.flows import api
    >>> log = api.read_log("examples/four_sensor_geo.mcap")
    >>> api.write_log("copy.mcap", log.frames, log.states, log.cameras)
    >>> copy = api.read_log("copy.mcap")
    >>> copy.frames.equals(log.frames.sort("time", "sensor_id"))
    True
    """
    messages = heapq.merge(
        _messages("camera", _checked(_CAMERAS, cameras)),
        _messages("state", _checked(_STATES, states)),
        _messages("frame", _same_lengths(_checked(_FRAMES, frames))),
        key=lambda message: message[0],
    )
    with LogWriter(path, encoding=encoding) as log:
        for time_ns, kind, row in messages:
            _write(log, kind, time_ns, row)
    for found in _found_in(path):
        warnings.warn(f"{os.fspath(path)}: {found}", LogWarning, stacklevel=2)


def _found_in(path: str | os.PathLike[str]) -> Iterator[str]:
    """Yield a sentence for each mistake in a log, and for each reason in its rejects."""
    log = reader.read_log(path)
    yield from mistakes(judge_log(log, SensorSettings().state_gap_s).to_pylist())
    yield from (f"rejects of a reader: {each}" for each in left_out(log.rejects))


def _frame(schema: pa.Schema, rows: Any) -> pl.DataFrame:
    """Return a table of any common kind as a frame."""
    name = table_name(schema)
    try:
        if isinstance(rows, pl.LazyFrame):
            rows = rows.collect()
        elif isinstance(rows, pa.Table):
            rows = to_polars(rows)
        elif isinstance(rows, Mapping):
            rows = pl.DataFrame(rows)
    except (TypeError, pl.exceptions.PolarsError) as error:
        raise ValueError(f"table {name}: cannot be made of these columns: {error}") from error
    if not isinstance(rows, pl.DataFrame):
        raise TypeError(
            f"table {name}: is a {type(rows).__name__}, expected a polars DataFrame or LazyFrame, "
            "an Arrow table or columns by name"
        )
    return rows


def _checked(schema: pa.Schema, rows: Any) -> pl.DataFrame:
    """Return the rows with all columns of the schema, in order of time."""
    rows = _frame(schema, rows)
    columns: dict[str, Any] = {name: rows[name].to_arrow() for name in rows.columns}
    for name in schema.names:
        if name not in columns and name in _DEFAULTS:
            columns[name] = [_DEFAULTS[name]] * rows.height
    checked = to_polars(table(schema, columns))
    for sensor_id in checked["sensor_id"].unique().sort():
        if not valid_sensor_id(sensor_id):
            raise ValueError(
                f"table {table_name(schema)}: sensor_id {sensor_id!r}: expected {SENSOR_ID_RULE}"
            )
    _check_written(table_name(schema), checked)
    for names in _VECTORS if schema is _STATES else ():
        _check_whole(names, checked)
    if schema is _CAMERAS:
        _check_terms(checked)
    unknown = [pl.col(name).fill_null(0.0) for name in _UNKNOWN_IS_0 if name in schema.names]
    return checked.with_columns(unknown).sort("time", "sensor_id", maintain_order=True)


def _check_written(name: str, rows: pl.DataFrame) -> None:
    """Raise where a time or a number cannot be written at all."""
    for column in {"time", "frame_number"} & set(rows.columns):
        below = rows.filter(pl.col(column).cast(pl.Int64) < 0)
        if below.height:
            value, sensor_id = below[column][0], below["sensor_id"][0]
            lowest = "1970" if column == "time" else "0"
            raise ValueError(
                f"table {name}: {column} of {sensor_id} is {value}, expected {lowest} or later"
            )


def _check_whole(names: Sequence[str], states: pl.DataFrame) -> None:
    """Raise where a vector has a part of its components."""
    missing = pl.sum_horizontal(pl.col(name).is_null() for name in names)
    partly = states.filter((missing > 0) & (missing < len(names)))
    if partly.height:
        row = partly.row(0, named=True)
        absent = ", ".join(name for name in names if row[name] is None)
        raise ValueError(
            f"table states: {absent} of {row['sensor_id']} is null in {partly.height} rows that "
            f"have the rest of {', '.join(names)}; give all of them or none"
        )


def _check_terms(cameras: pl.DataFrame) -> None:
    """Raise where a distortion has a term that the messages of its model cannot hold."""
    for fisheye, lens, absent in ((False, "pinhole", ("k4",)), (True, "fisheye", ("p1", "p2"))):
        of_lens = cameras.filter(pl.col("fisheye") == fisheye)
        for term in absent:
            wrong = of_lens.filter(pl.col(term) != 0.0)
            if wrong.height:
                value, sensor_id = wrong[term][0], wrong["sensor_id"][0]
                raise ValueError(
                    f"table cameras: {term} of {sensor_id} is {value}; the distortion of a {lens} "
                    f"in a log is without {' and '.join(absent)}"
                )


def _same_lengths(frames: pl.DataFrame) -> pl.DataFrame:
    n = frames["x_px"].list.len()
    for name in ("y_px", "flux", "sigma_px"):
        differs = frames.filter((frames[name].list.len() != n).fill_null(value=False))
        if differs.height:
            row = differs.row(0, named=True)
            raise ValueError(
                f"table frames: x_px and {name} differ in length in frame {row['frame_number']} "
                f"of {row['sensor_id']}: {len(row['x_px'])} and {len(row[name])}"
            )
    return frames


def _messages(kind: str, rows: pl.DataFrame) -> Iterator[tuple[int, str, dict[str, Any]]]:
    for row in rows_of(rows.to_arrow()):
        yield row.pop("time"), kind, row


def _write(log: LogWriter, kind: str, time_ns: int, row: dict[str, Any]) -> None:
    sensor_id = row.pop("sensor_id")
    if kind == "camera":
        log.camera(sensor_id, time_ns, Camera(**row))
    elif kind == "frame":
        log.frame(sensor_id, time_ns, **row)
    else:
        log.state(
            sensor_id,
            time_ns,
            position_km=[row[name] for name in ("x_km", "y_km", "z_km")],
            velocity_km_s=_vector(row, *_VECTORS[0]),
            position_sigma_km=row["position_sigma_km"],
            attitude_xyzw=_vector(row, *_VECTORS[1]),
            attitude_sigma_arcsec=row["attitude_sigma_arcsec"],
        )


def _vector(row: dict[str, Any], *names: str) -> list[float] | None:
    values = [row[name] for name in names]
    return None if None in values else values
