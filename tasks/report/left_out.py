"""What was left out of a night, by stage, reason and sensor."""

from typing import NamedTuple

import polars as pl

from epipole.io.datasets.night_reader import NightReader
from epipole.schemas.rejects import Reason
from epipole.schemas.stages import Stage

ORDER = [stage.value for stage in Stage]


class LeftOut(NamedTuple):
    """What was left out for one reason, of one sensor; '' where it is of none or of several."""

    stage: str
    reason: str
    sensor_id: str
    number: int

    @property
    def sentence(self) -> str:
        """What the reason means."""
        known = {reason.value: reason.sentence for reason in Reason}
        return known.get(self.reason, "A reason of another version of the program.")


def read_left_out(night: NightReader) -> list[LeftOut]:
    """Return what was left out, in the order of the stages, the most frequent first."""
    key = ["stage", "reason", "sensor_id"]
    pieces = [
        rows.group_by(key).agg(pl.col("count").sum())
        for rows in night.pieces("rejects", [*key, "count"])
    ]
    if not pieces:
        return []
    counts = pl.concat(pieces).with_columns(pl.col("sensor_id").fill_null(""))
    sums = counts.group_by(key).agg(pl.col("count").sum())
    rows = [LeftOut(*row) for row in sums.select(*key, "count").iter_rows()]
    return sorted(rows, key=lambda row: (_place(row.stage), -row.number, row.reason, row.sensor_id))


def _place(stage: str) -> int:
    return ORDER.index(stage) if stage in ORDER else len(ORDER)
