"""A log copied with other values in it: what a broken sensor or recorder would have written."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from epipole.io.logs.reader import read_log
from epipole.io.logs.writer import LogWriter
from epipole.schemas.bridge import array

Row = Mapping[str, Any]
Change = Callable[[Row], Mapping[str, Any]]


def altered(
    source: Path,
    to: Path,
    *,
    frame: Change = lambda row: {},
    state: Change = lambda row: {},
    camera: Change = lambda row: {},
) -> Path:
    """Copy a log; each function returns what to change in a row, as `LogWriter` names it.

    Rows have `sensor_id`, `time_ns`, their `number` in the log, and what `LogWriter` takes.
    """
    log = read_log(source)
    with LogWriter(to) as out:
        for row in table_rows(log.cameras):
            row |= camera(row)
            out.camera(row["sensor_id"], row["time_ns"], row)
        for kind, rows, change in (
            ("state", map(state_values, table_rows(log.states)), state),
            ("frame", map(frame_values, table_rows(log.exposures)), frame),
        ):
            for number, row in enumerate(rows):
                row |= change({**row, "number": number})
                getattr(out, kind)(row.pop("sensor_id"), row.pop("time_ns"), **row)
    return to


def table_rows(table: Any) -> Any:
    """Return the rows of a table of a log, with `time_ns` for their time."""
    time_ns = array(table, "time").tolist()
    rows = table.drop_columns("time").to_pylist()
    return [{**row, "time_ns": t} for row, t in zip(rows, time_ns, strict=True)]


def state_values(row: Row) -> dict[str, Any]:
    """Return a row of states as `LogWriter` takes it."""
    v = [row[f"v{a}_km_s"] for a in "xyz"]
    q = [row[f"q{a}"] for a in "xyzw"]
    return {
        "sensor_id": row["sensor_id"],
        "time_ns": row["time_ns"],
        "frame": row["frame"],
        "position_km": [row[f"{a}_km"] for a in "xyz"],
        "velocity_km_s": None if v[0] is None else v,
        "position_sigma_km": row["position_sigma_km"],
        "attitude_xyzw": None if q[0] is None else q,
        "attitude_sigma_arcsec": row["attitude_sigma_arcsec"],
    }


def frame_values(row: Row) -> dict[str, Any]:
    """Return a row of exposures as `LogWriter` takes it."""
    names = ("sensor_id", "time_ns", "frame_number", "exposure_s")
    arrays = ("x_px", "y_px", "flux", "sigma_px")
    return {name: row[name] for name in (*names, *arrays)}
