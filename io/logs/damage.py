"""What a log's reader leaves out, collected until it becomes rows of `rejects`.

The reasons, all of stage `read`:

- of the file: truncated (also: never closed), damaged_record, log_behind_log (which is read),
  missing_messages (the summary counts more), unknown_channel;
- of a chunk, with the number of its messages where an index tells it: bad_checksum,
  bad_compression, wrong_chunk_size, chunk_too_large, damaged_chunk, unknown_compression;
- of any message: undecodable_frame, _state or _calibration, bad_sensor_id, no_timestamp;
- of a frame: nan (a place that is none), unequal_arrays, bad_sigma, bad_frame_number, and, among
  all logs: duplicate_frame, duplicate_number, duplicate_time;
- of a state: unknown_frame, bad_position, inside_earth, bad_velocity, bad_attitude (the position
  is kept), duplicate_state;
- of a calibration: bad_image_size, bad_camera_matrix, bad_distortion, unknown_distortion_model.
"""

from dataclasses import dataclass, field

import pyarrow as pa

from epipole.schemas.rejects import Reason, reject_rows
from epipole.schemas.spans import DAY_NS

ROWS_ALIKE = 100  # a log that is broken all through does not need a row a message


_Key = tuple[int | None, str | None, str]


@dataclass
class RejectList:
    """Rows of `rejects` in the making, all of one log."""

    source: str
    _rows: list[tuple[int | None, str | None, int, str, int]] = field(default_factory=list)
    _alike: dict[_Key, int] = field(default_factory=dict)  # how many of a kind there were
    _last: dict[_Key, int] = field(default_factory=dict)  # the last row of a kind

    def add(
        self,
        reason: str,
        *,
        time_ns: int,
        offset: int | None = None,
        sensor_id: str | None = None,
        count: int = 1,
    ) -> None:
        """Add a row; a time of 0 is an unknown one.

        Of those alike in all but time (same chunk, sensor and reason) the first `ROWS_ALIKE`
        have a row each; the last of these counts the rest.
        """
        key = (offset, sensor_id, reason)
        n = self._alike[key] = self._alike.get(key, 0) + 1
        if n <= ROWS_ALIKE:
            self._rows.append((offset, sensor_id, time_ns, reason, count))
            self._last[key] = len(self._rows) - 1
            return
        i = self._last[key]
        self._rows[i] = (*self._rows[i][:-1], self._rows[i][-1] + count)

    def summary(self) -> str:
        """Return what was left out and why, most first: ``nan 3, no_timestamp 1``."""
        counts: dict[str, int] = {}
        for *_, reason, count in self._rows:
            counts[reason] = counts.get(reason, 0) + count
        ordered = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
        return ", ".join(f"{reason} {count}" for reason, count in ordered)

    def table(self, first_ns: int, last_ns: int) -> pa.Table:
        """Return the rows of `rejects`; the log's frames are of `first_ns` to `last_ns`.

        A row gets the time of the first frame if its own is unknown, or a day or more outside
        the log, which only damage can explain. Else no night that is made would have the row.
        """
        near_ns = range(first_ns - DAY_NS + 1, last_ns + DAY_NS)
        rows = self._rows
        return reject_rows(
            [Reason(reason) for *_, reason, _ in rows],
            source=self.source,
            offset=[offset for offset, *_ in rows],
            sensor_id=[sensor_id for _, sensor_id, *_ in rows],
            time=[t if t in near_ns else first_ns for _, _, t, _, _ in rows],
            count=[count for *_, count in rows],
        )
