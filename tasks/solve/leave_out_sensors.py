"""Leave out sensors whose clocks are wrong and were not corrected."""

from collections.abc import Sequence
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


def leave_out_sensors(views: pa.Table, sensors: Sequence[str]) -> Remaining:
    """Return the views, without those of some sensors."""
    wrong = pc.is_in(views["sensor_id"], pa.array(list(sensors), pa.string()))
    left_out = views.filter(wrong)
    by_sensor = pl.DataFrame(left_out).group_by("sensor_id").agg(
        time=pl.col("epoch").min(), count=pl.len().cast(pl.Int64)
    ).sort("sensor_id")  # fmt: skip
    rejects = reject_rows(
        Reason.CLOCK_OFF,
        sensor_id=by_sensor["sensor_id"].to_arrow(),
        time=by_sensor["time"].to_arrow(),
        count=by_sensor["count"].to_arrow(),
    )
    return Remaining(views.filter(pc.invert(wrong)), left_out, rejects)
