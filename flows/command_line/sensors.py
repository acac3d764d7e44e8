"""A table of several sensors taken apart."""

import pyarrow as pa
import pyarrow.compute as pc


def sensor_ids(rows: pa.Table) -> list[str]:
    """Return the sensors of a table, sorted."""
    return sorted(pc.unique(rows["sensor_id"]).to_pylist())


def of_sensor(rows: pa.Table, sensor_id: str) -> pa.Table:
    """Return the rows of one sensor, in their order."""
    return rows.filter(pc.field("sensor_id") == sensor_id)
