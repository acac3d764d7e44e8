"""What is in a log: sensors, times, counts, and what cannot be used."""

from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.logs.reader import read_log
from epipole.schemas.bridge import array, flatten
from epipole.schemas.errors import LogError
from epipole.schemas.work_tables import LogContents
from epipole.tasks.common.sightings import camera_of


def describe_found(log: str, is_named: bool) -> dict[str, Any]:
    """Return what `describe` does; of a file that was found and cannot be read, why it cannot.

    Raises
    ------
    LogError
        Where a file that was named itself cannot be read.
    """
    try:
        return describe(log)
    except LogError as error:
        if is_named:
            raise
        return {"log": log, "error": str(error)}


def describe(log: str) -> dict[str, Any]:
    """Return what a log holds, by sensor.

    Raises
    ------
    LogError
        Where the file is not a log.
    """
    contents = read_log(log)
    return {
        "log": log,
        "size": contents.source.size,
        "sha256": contents.source.sha256,
        "sensors": [
            _sensor(name, contents.exposures, contents.states, contents.cameras)
            for name in _sensors(contents)
        ],
        "left_out": [
            {"reason": row["reason"], "sensor_id": row["sensor_id"], "count": row["count_sum"]}
            for row in contents.rejects.group_by(["reason", "sensor_id"])
            .aggregate([("count", "sum")])
            .sort_by([("reason", "ascending"), ("sensor_id", "ascending")])
            .to_pylist()
        ],
    }


def _sensors(contents: LogContents) -> list[str]:
    """Return the sensors of which a log has anything; of some it may have a calibration alone."""
    rows = contents.exposures, contents.states, contents.cameras
    return sorted({name for each in rows for name in sensor_ids(each)})


def sensor_ids(rows: pa.Table) -> list[str]:
    """Return the sensors of a table, sorted."""
    return sorted(pc.unique(rows["sensor_id"]).to_pylist())


def of_sensor(rows: pa.Table, sensor_id: str) -> pa.Table:
    """Return the rows of one sensor, in their order."""
    return rows.filter(pc.field("sensor_id") == sensor_id)


def _sensor(name: str, exposures: pa.Table, states: pa.Table, cameras: pa.Table) -> dict[str, Any]:
    frames, states = of_sensor(exposures, name), of_sensor(states, name)
    time_ns = np.sort(array(frames, "time"))
    interval_ns = float(np.median(np.diff(time_ns))) if len(time_ns) > 1 else None
    stated = of_sensor(cameras, name)
    camera = camera_of(stated, 0) if stated.num_rows else None
    centroids, _ = flatten(frames, "x_px")
    return {
        "sensor_id": name,
        "frames": frames.num_rows,
        "first": _iso(time_ns[0]) if len(time_ns) else None,
        "last": _iso(time_ns[-1]) if len(time_ns) else None,
        "rate_hz": 1e9 / interval_ns if interval_ns else None,
        "centroids_per_frame": len(centroids) / max(frames.num_rows, 1),
        "states": states.num_rows,
        "state_frames": sorted(set(states["frame"].to_pylist())),
        "states_with_attitude": states.num_rows - states["qw"].null_count,
        "states_with_velocity": states.num_rows - states["vx_km_s"].null_count,
        "image_px": [camera.width, camera.height] if camera else None,
        "field_deg": list(camera.field_deg) if camera else None,
    }


def _iso(time_ns: int) -> str:
    return f"{np.datetime64(int(time_ns), 'ns')}"[:23] + "Z"


def lines(described: dict[str, Any]) -> list[str]:
    """Return what `describe_found` returned as lines for people."""
    if "error" in described:
        return [described["error"]]
    out = [f"{described['log']}: {described['size']:,} bytes"]
    for sensor in described["sensors"]:
        rate = f" at {sensor['rate_hz']:.3g} Hz" if sensor["rate_hz"] else ""
        out += [
            f"  {sensor['sensor_id']}",
            f"    frames       {sensor['frames']:,}{rate}{_times(sensor)}",
            f"    centroids    {sensor['centroids_per_frame']:.1f} per frame",
            f"    states       {_states(sensor)}",
            f"    calibration  {_calibration(sensor)}",
        ]
    for row in described["left_out"]:
        whose = f" of {row['sensor_id']}" if row["sensor_id"] else ""
        out.append(f"  left out: {row['count']:,} {row['reason']}{whose}")
    return out


def _times(sensor: dict[str, Any]) -> str:
    return f", {sensor['first']} to {sensor['last']}" if sensor["first"] else ""


def _states(sensor: dict[str, Any]) -> str:
    if not sensor["states"]:
        return "none in this log; frames without any give no positions"
    n = sensor["states"]
    return (
        f"{n:,} in {', '.join(sensor['state_frames'])}, "
        f"{_share(sensor['states_with_attitude'], n)} with attitude, "
        f"{_share(sensor['states_with_velocity'], n)} with velocity"
    )


def _share(count: int, total: int) -> str:
    return {0: "none", total: "all"}.get(count, f"{count:,}")


def _calibration(sensor: dict[str, Any]) -> str:
    if sensor["image_px"] is None:
        return "none in this log; a run leaves a sensor without any out"
    width, height = sensor["image_px"]
    return f"{width} x {height} px, {sensor['field_deg'][0]:.1f} x {sensor['field_deg'][1]:.1f} deg"
