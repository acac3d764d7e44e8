"""Leave out sensors that the check found at fault."""

from collections.abc import Mapping
from typing import NamedTuple

import polars as pl
import pyarrow as pa
import pyarrow.compute as pc

from epipole.schemas.rejects import Reason, reject_rows


class Remaining(NamedTuple):
    """The views that remain, the views left out, and rows of `rejects` for the latter."""

    views: pa.Table
    left_out: pa.Table
    rejects: pa.Table


def leave_out_sensors(views: pa.Table, sensors: Mapping[str, Reason]) -> Remaining:
    """Return the views, without those of some sensors, each left out for a reason."""
    wrong = pc.is_in(views["sensor_id"], pa.array(list(sensors), pa.string()))
    left_out = views.filter(wrong)
    by_sensor = pl.DataFrame(left_out).group_by("sensor_id").agg(
        time=pl.col("epoch").min(), count=pl.len().cast(pl.Int64)
    ).sort("sensor_id")  # fmt: skip
    rejects = reject_rows(
        [sensors[name] for name in by_sensor["sensor_id"]],
        sensor_id=by_sensor["sensor_id"].to_arrow(),
        time=by_sensor["time"].to_arrow(),
        count=by_sensor["count"].to_arrow(),
    )
    return Remaining(views.filter(pc.invert(wrong)), left_out, rejects)
