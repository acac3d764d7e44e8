"""What reading a log leaves out, and the frames whose times are far from all others."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa

from epipole.schemas.arrays import Nanoseconds
from epipole.schemas.bridge import array
from epipole.schemas.log_bounds import FAR_FROM_LOG_NS
from epipole.schemas.rejects import Reason, reject_rows
from epipole.schemas.spans import DAY_NS

# Rows of `rejects`, collected.

ROWS_ALIKE = 100  # a log that is damaged throughout does not need a row per message
# Maximum number of rows of one log. It bounds the memory: a row takes about half a kilobyte until
# it is written. Each reason then has one more row, which counts the rest.
MAX_ROWS = 50_000

_Key = tuple[int | None, str | None, Reason]


@dataclass
class RejectList:
    """The rows of `rejects` of one log, while it is read."""

    source: str
    _rows: list[tuple[int | None, str | None, int, Reason, int]] = field(default_factory=list)
    _alike: dict[_Key, tuple[int, int]] = field(default_factory=dict)  # how many rows, the last

    def add(
        self,
        reason: Reason,
        *,
        time_ns: int,
        offset: int | None = None,
        sensor_id: str | None = None,
        count: int = 1,
    ) -> None:
        """Add a row; a time of 0 is unknown.

        Rows with the same chunk, sensor and reason are alike. Only `ROWS_ALIKE` of them are kept;
        the last of these counts the others too. After `MAX_ROWS` rows, all with one reason are
        alike.
        """
        key: _Key = (offset, sensor_id, reason)
        is_full = len(self._rows) >= MAX_ROWS
        if is_full and key not in self._alike:
            key = (None, None, reason)
        n, last = self._alike.get(key, (0, 0))
        if n == 0 or (n < ROWS_ALIKE and not is_full):
            self._alike[key] = n + 1, len(self._rows)
            self._rows.append((key[0], key[1], time_ns, reason, count))
        else:
            self._rows[last] = (*self._rows[last][:-1], self._rows[last][-1] + count)

    def table(self, range_ns: tuple[int, int] | None) -> pa.Table:
        """Return the rows of `rejects`; `range_ns`: the log's time range.

        A row gets the time of the first frame if its time is unknown, or a day or more outside
        the log, which only damage can explain. With such a time it would be in no night that is
        made. In a log without any valid time, rows get their night when those of the run are
        known.
        """
        first_ns, last_ns = range_ns or (0, 0)
        near_ns = range(first_ns - DAY_NS + 1, last_ns + DAY_NS)
        rows = self._rows
        return reject_rows(
            [reason for *_, reason, _ in rows],
            source=self.source,
            offset=[offset for offset, *_ in rows],
            sensor_id=[sensor_id for _, sensor_id, *_ in rows],
            time=[t if t in near_ns else first_ns for _, _, t, _, _ in rows],
            count=[count for *_, count in rows],
        )


# Strays: a frame with a wrong clock would otherwise make a night that has only this frame.


def log_time_range(times: Sequence[Nanoseconds]) -> tuple[int, int] | None:
    """Return the first and last of the times near their median; None without times.

    Unset clocks read early, so take the upper median.
    """
    time_ns = np.concatenate([np.empty(0, np.int64), *times])
    n = len(time_ns)
    if n == 0:
        return None
    middle = np.partition(time_ns, n // 2)[n // 2]
    near = time_ns[np.abs(time_ns - middle) <= FAR_FROM_LOG_NS]
    return int(near.min()), int(near.max())


def stray_rejects(frames: pa.Table) -> pa.Table:
    """Return rows of `rejects` for frames that are strays: one per sensor and log."""
    return frames_left_out(frames, Reason.STRAY_TIME)


def frames_left_out(frames: pa.Table, reason: Reason) -> pa.Table:
    """Return a row of `rejects` per sensor and log: the first frame's time, and how many."""
    grouped = frames.group_by(["sensor_id", "source"], use_threads=False).aggregate(
        [("time", "min"), ("time", "count")]
    )
    return reject_rows(
        reason,
        source=grouped["source"],
        sensor_id=grouped["sensor_id"],
        time=grouped["time_min"],
        count=grouped["time_count"],
    )


def without_strays(exposures: pa.Table, first_ns: int, last_ns: int) -> tuple[pa.Table, pa.Table]:
    """Return the frames of a log within its time range, and those that are strays."""
    time_ns = array(exposures, "time")
    inside = pa.array((time_ns >= first_ns) & (time_ns <= last_ns))
    return exposures.filter(inside), exposures.filter(pa.compute.invert(inside))
