"""The frames of a log as EXPOSURES."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.io.logs.left_out import RejectList
from epipole.io.logs.messages.batches import MessageBatch, Received, fault, known_id
from epipole.io.logs.messages.encoding import FrameMessage
from epipole.io.logs.messages.scan import FrameRows, NameCodes, scan_frames
from epipole.schemas.arrays import Flags, Integers
from epipole.schemas.bridge import table
from epipole.schemas.log_bounds import (
    CENTROID_POSITION,
    CENTROID_SIGMA,
    EXPOSURE,
    FLUX,
    FRAME_NUMBER,
    Bound,
)
from epipole.schemas.rejects import Reason
from epipole.schemas.work_tables import EXPOSURES

Floats = npt.NDArray[np.float32]

BATCH = 65536  # frames in one table of those that are joined
BATCH_CENTROIDS = 1 << 21
# The x and y of a centroid take 8 bytes in binary and at least 4 as text.
BYTES_OF_A_CENTROID = 4
CENTROID_BYTES, ROW_BYTES = 16, 80  # in the table


class _Rows:
    """Rows of one of the tables that are joined, while they are filled in."""

    def __init__(self, n: int, n_centroids: int) -> None:
        self.n = 0
        self.offset = np.empty(n, np.int64)
        self.columns = FrameRows(
            np.empty(n, np.int32),
            np.empty(n, np.int64),
            np.empty(n, np.int64),
            np.empty(n, np.float64),
            np.zeros(n + 1, np.int32),
            np.empty(n, np.bool_),
            np.empty(n, np.bool_),
            *(_arrow_floats(n_centroids) for _ in range(4)),
        )

    @property
    def n_centroids(self) -> int:
        return int(self.columns.first[self.n])

    def has_room(self, n: int, n_centroids: int) -> bool:
        return self.n + n <= len(self.offset) and (
            self.n_centroids + n_centroids <= len(self.columns.x_px)
        )


@dataclass
class FrameColumns:
    """The frames of a log."""

    rejects: RejectList
    _sensors: NameCodes = field(default_factory=NameCodes)
    _rows: _Rows = field(default_factory=lambda: _Rows(0, 0))
    _tables: list[pa.Table] = field(default_factory=list)
    _table_bytes: int = 0

    def add(self, batch: MessageBatch) -> None:
        """Take the frames whose time, sensor, number and arrays are valid.

        Flux is never relied on: a value out of bounds becomes NaN, and the frame stays. An
        exposure time out of bounds is a reject too, and becomes 0, which is unknown.
        """
        messages = batch.messages
        self._make_room(len(batch), batch.n_bytes // BYTES_OF_A_CENTROID)
        rows, names = self._rows, self._sensors.table

        def scan(i: int) -> int:
            n = rows.n
            stopped, rows.n = scan_frames(messages, i, names, rows.columns, n)
            rows.offset[n : rows.n] = batch.offset[i:stopped]
            return int(stopped)

        batch.take(scan, self._judge)

    @property
    def n_bytes(self) -> int:
        """About the size of the rows that have not been taken."""
        waiting = self._rows.n_centroids * CENTROID_BYTES + self._rows.n * ROW_BYTES
        return waiting + self._table_bytes

    def take(self) -> pa.Table:
        """Return EXPOSURES of the frames since the last call, in the order of the log."""
        self._close()
        tables, self._tables, self._table_bytes = self._tables, [], 0
        return pa.concat_tables([EXPOSURES.empty_table(), *tables])

    def _make_room(self, n: int, n_centroids: int) -> None:
        if not self._rows.has_room(n, n_centroids):
            self._close()
            self._rows = _Rows(max(n, BATCH), max(n_centroids, BATCH_CENTROIDS))

    def _close(self) -> None:
        """Make a table of the rows so far."""
        rows, n = self._rows, self._rows.n
        self._rows = _Rows(0, 0)
        if n == 0:
            return
        c, m = rows.columns, int(rows.columns.first[n])
        offsets = pa.array(c.first[: n + 1])
        columns = {
            "sensor_id": self._sensors.strings(c.sensor[:n]),
            "frame_number": c.number[:n],
            "time": c.time_ns[:n],
            "exposure_s": c.exposure_s[:n],
            "x_px": _lists("x_px", c.x_px[:m], offsets),
            "y_px": _lists("y_px", c.y_px[:m], offsets),
            "flux": _lists("flux", c.flux[:m], offsets, c.has_flux[:n]),
            "sigma_px": _lists("sigma_px", c.sigma_px[:m], offsets, c.has_sigma[:n]),
            "source": pa.repeat(pa.scalar(self.rejects.source), n),
            "offset": rows.offset[:n],
        }
        self._tables.append(table(EXPOSURES, columns))
        self._table_bytes += self._tables[-1].nbytes

    # Frames that were decoded one at a time

    def _judge(self, received: Sequence[Received]) -> None:
        """Take decoded frames; invalid ones become rejects."""
        sound = []
        for item in received:
            frame: FrameMessage = item.message
            reason = fault(frame.time_ns, frame.sensor_id) or _frame_fault(frame)
            if reason is not None:
                self._leave_out(item, reason)
                continue
            if frame.exposure_s not in EXPOSURE:
                self._leave_out(item, Reason.BAD_EXPOSURE)
                item = item._replace(message=frame._replace(exposure_s=0.0))
            sound.append(item)
        if sound:
            self._append(sound)

    def _leave_out(self, item: Received, reason: Reason) -> None:
        self.rejects.add(
            reason,
            time_ns=item.message.time_ns or item.log_time_ns,
            offset=item.offset,
            sensor_id=known_id(item.message.sensor_id),
        )

    def _append(self, received: Sequence[Received]) -> None:
        frames: list[FrameMessage] = [item.message for item in received]
        lengths = np.array([len(f.x_px) for f in frames], np.int64)
        x = _joined([f.x_px for f in frames])
        y = _joined([f.y_px for f in frames])
        sigma, has_sigma = _joined_or_nan([f.sigma_px for f in frames], lengths)
        flux, has_flux = _joined_or_nan([f.flux for f in frames], lengths)
        with np.errstate(invalid="ignore"):
            not_finite = _any(~(np.isfinite(x) & np.isfinite(y)), lengths)
            bad_position = _any(
                ~(_within(CENTROID_POSITION, x) & _within(CENTROID_POSITION, y)), lengths
            )
            bad_sigma = _any(~_within(CENTROID_SIGMA, sigma), lengths) & has_sigma
            flux[~_within(FLUX, flux)] = np.nan
        keep = ~(bad_position | bad_sigma)
        bad_number = np.where(bad_position, Reason.BAD_CENTROID, Reason.BAD_SIGMA)
        reasons = np.where(not_finite, Reason.NAN, bad_number)
        for i in np.flatnonzero(~keep).tolist():
            self._leave_out(received[i], Reason(reasons[i]))
        each = np.repeat(keep, lengths)
        values = (x[each], y[each], flux[each], sigma[each])
        kept = np.flatnonzero(keep).tolist()
        self._write([received[i] for i in kept], lengths[keep], values)
        rows = self._rows
        rows.columns.has_flux[rows.n - len(kept) : rows.n] = has_flux[keep]
        rows.columns.has_sigma[rows.n - len(kept) : rows.n] = has_sigma[keep]

    def _write(
        self, received: Sequence[Received], lengths: Integers, values: Sequence[Floats]
    ) -> None:
        """Add good frames to the rows."""
        rows, c = self._rows, self._rows.columns
        low = rows.n_centroids
        for column, numbers in zip((c.x_px, c.y_px, c.flux, c.sigma_px), values, strict=True):
            column[low : low + len(numbers)] = numbers
        for item, length in zip(received, lengths.tolist(), strict=True):
            n, frame = rows.n, item.message
            c.sensor[n] = self._sensors.code(frame.sensor_id)
            c.number[n], c.time_ns[n] = frame.frame_number, frame.time_ns
            c.exposure_s[n] = frame.exposure_s
            c.first[n + 1] = c.first[n] + length
            rows.offset[n] = item.offset
            rows.n += 1


def _arrow_floats(n: int) -> Floats:
    """Return an empty array in memory of Arrow, which returns freed memory to the system."""
    return np.frombuffer(pa.allocate_buffer(4 * n), np.float32)


def _frame_fault(frame: FrameMessage) -> Reason | None:
    if frame.frame_number not in FRAME_NUMBER:
        return FRAME_NUMBER.reason
    n = len(frame.x_px)
    if len(frame.y_px) != n or len(frame.flux) not in (0, n) or len(frame.sigma_px) not in (0, n):
        return Reason.UNEQUAL_ARRAYS
    return None


def _within(bound: Bound, values: Floats) -> Flags:
    """Return which values lie within a bound, as float32 like the values; false for NaN."""
    minimum, maximum = np.float32(bound.minimum), np.float32(bound.maximum)
    return np.asarray((values >= minimum) & (values <= maximum))


def _joined(arrays: Sequence[npt.NDArray[np.floating]]) -> Floats:
    """Return the arrays joined as float32, which is the type in the messages."""
    with np.errstate(invalid="ignore", over="ignore"):  # JSON may have larger numbers
        return np.concatenate([np.empty(0, np.float32), *arrays], dtype=np.float32)


def _joined_or_nan(
    arrays: Sequence[npt.NDArray[np.floating]], lengths: Integers
) -> tuple[Floats, Flags]:
    """Return the arrays joined, with NaN for empty arrays, and which arrays are not empty."""
    given = np.array([len(a) for a in arrays], np.int64) == lengths
    out = np.full(lengths.sum(), np.nan, np.float32)
    out[np.repeat(given, lengths)] = _joined(arrays)
    return out, given & (lengths > 0)


def _any(bad: Flags, lengths: Integers) -> Flags:
    """Return for each frame whether any of its centroids is bad."""
    before = np.concatenate([[0], np.cumsum(bad)])
    end = np.cumsum(lengths)
    return before[end] > before[end - lengths]


def _lists(name: str, flat: Floats, offsets: pa.Array, given: Flags | None = None) -> pa.ListArray:
    """Return a list per row; null where not `given`, whose values are skipped."""
    kind = EXPOSURES.field(name).type
    null = None if given is None or given.all() else pa.array(~given)
    return pa.ListArray.from_arrays(offsets, pa.array(flat, kind.value_type), type=kind, mask=null)
