"""Rows by night: to which UTC date the rows of a table belong, and their order in it."""

import datetime

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from epipole.schemas.bridge import array
from epipole.schemas.columns import TIME
from epipole.schemas.spans import DAY_NS, day_of

# The time column that decides to which night a row belongs, where it is not its epoch or `time`.
# Calibrations, checks and sources belong to a whole night.
_NIGHT_COLUMN = {"tracklets": "start_time"}
_WHOLE_NIGHT = {
    "calibrations", "checks", "identifications", "nights", "objects", "sensor_errors", "sources",
}  # fmt: skip


def nights_of(time_ns: np.ndarray) -> list[str]:
    """Return the UTC dates, ``YYYY-MM-DD``, of these times, each once and in order."""
    return [_date(day) for day in np.unique(time_ns // DAY_NS)]


def rows_of_night(name: str, rows: pa.Table, night: str) -> pa.Table:
    """Return the rows of a table that belong to a night.

    A row belongs to the UTC date of its epoch or, without an epoch, of its time. A log belongs
    to every night between its first and last frame. A calibration belongs to all nights.
    """
    day = day_of(night)
    if name == "sources":
        first, last = array(rows, "first_time") // DAY_NS, array(rows, "last_time") // DAY_NS
        return rows.filter(pa.array((first <= day) & (day <= last)))
    if name in _WHOLE_NIGHT:
        return rows
    usual = "epoch" if "epoch" in rows.column_names else "time"
    column = _NIGHT_COLUMN.get(name, usual)
    return rows.filter(pa.array(array(rows, column) // DAY_NS == day))


def in_order(rows: pa.Table) -> pa.Table:
    """Return the rows sorted by time, then by the columns that identify them.

    Rows that are equal in all of these keep their order.
    """
    times = [field.name for field in rows.schema if field.type == TIME]
    keys = [f.name for f in rows.schema if pa.types.is_integer(f.type) or f.type == pa.string()]
    by = [(name, "ascending") for name in (*times, *keys)]
    return rows.take(pc.sort_indices(rows, sort_keys=by)) if rows.num_rows else rows


def _date(day: int) -> str:
    return (datetime.date(1970, 1, 1) + datetime.timedelta(days=int(day))).isoformat()
