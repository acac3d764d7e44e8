"""A night's tables cut by sensor and span of time, and the sensors that cannot take part."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from epipole.schemas.bridge import array, concat, table
from epipole.schemas.tables import REJECTS


def sensor_ids(rows: pa.Table) -> list[str]:
    """Return the sensors of a table, sorted."""
    return sorted(pc.unique(rows["sensor_id"]).to_pylist())


def of_sensor(rows: pa.Table, sensor_id: str) -> pa.Table:
    """Return the rows of one sensor, in their order."""
    return rows.filter(pc.field("sensor_id") == sensor_id)


def spans(rows: pa.Table, span_ns: int) -> Iterator[np.ndarray]:
    """Yield row numbers of one sensor and one span of time each.

    Spans are counted from 1970, not from the first frame, so another log of the same night
    does not shift them.
    """
    times = array(rows, "time")
    for sensor_id in sensor_ids(rows):
        of_this = np.flatnonzero(pc.equal(rows["sensor_id"], sensor_id).to_numpy())
        span = times[of_this] // span_ns
        for one in np.unique(span):
            yield of_this[span == one]


def calibrated(exposures: pa.Table, cameras: pa.Table) -> tuple[pa.Table, pa.Table]:
    """Return the exposures of sensors with a calibration, and a reject a sensor without."""
    known = set(sensor_ids(cameras))
    rejects = [
        _reject(of_sensor(exposures, name), "identify_stars", "no_calibration")
        for name in sensor_ids(exposures)
        if name not in known
    ]
    kept = exposures.filter(pc.is_in(exposures["sensor_id"], pa.array(sorted(known), pa.string())))
    return kept, concat(REJECTS, rejects)


def unplaced(places: pa.Table) -> pa.Table:
    """Return a reject a sensor with frames that have no state near: they give no position."""
    lost = places.filter(pc.is_null(places["x_km"]))
    return concat(
        REJECTS,
        [_reject(of_sensor(lost, name), "place_sensors", "no_state") for name in sensor_ids(lost)],
    )


def _reject(frames: pa.Table, stage: str, reason: str) -> pa.Table:
    """Return one row for frames of one sensor that a stage leaves out."""
    values: dict[str, Any] = {
        "source": None,
        "offset": None,
        "sensor_id": frames["sensor_id"][0].as_py(),
        "time": int(array(frames, "time").min()),
        "stage": stage,
        "reason": reason,
        "count": frames.num_rows,
    }
    return table(REJECTS, {name: [value] for name, value in values.items()})
