"""Logs in: an MCAP file of frames, states and calibrations to tables.

Channels are chosen by the name of their schema, in protobuf, JSON or ROS 2 CDR, mixed as
they may be. Nothing that is in the file stops the reading: what cannot be used is a row
in `rejects`. Only a log that gives no frame at all is an error.
"""

import os
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.io.logs.columns.cameras import CameraColumns
from epipole.io.logs.columns.frames import FrameColumns
from epipole.io.logs.columns.states import StateColumns
from epipole.io.logs.damage import RejectList
from epipole.io.logs.mcap.bytes import LogBytes, open_log
from epipole.io.logs.mcap.channels import ChannelTable
from epipole.io.logs.mcap.records import Block, RecordWalk
from epipole.io.logs.mcap.summary import MAGIC, read_summary
from epipole.io.logs.messages.batches import batches_of
from epipole.io.logs.messages.encodings.registry import kinds_of_schemas, message_encodings
from epipole.schemas.bridge import array
from epipole.schemas.errors import LogError
from epipole.schemas.log_tables import LogContents, LogPiece, LogSource
from epipole.schemas.messages import CALIBRATION, FRAME, KINDS, STATE
from epipole.schemas.tables import REJECTS

THREADS = 2  # that unpack and check chunks, beside the one that decodes
PIECE_BYTES = 64 << 20  # of frames and states in one piece of a log
# A frame's time and the time it was logged at may be so far apart, no further, for chunks
# to be judged by the latter. States that far beyond a range help its first and last frames.
MARGIN_NS = 600_000_000_000
FIRST_NS, LAST_NS = 0, (1 << 63) - 1 - MARGIN_NS


def read_log(
    path: str | os.PathLike[str], start_ns: int | None = None, end_ns: int | None = None
) -> LogContents:
    """Return what a log holds, in the order of the file (see `read_log_pieces`).

    Parameters
    ----------
    path
        A local file or an fsspec URL such as ``s3://bucket/night.mcap``.
    start_ns, end_ns
        Frames from the one to before the other only (UTC since 1970; none: no limit), states
        within `MARGIN_NS` of them, all calibrations. Chunks of another time are passed over
        unopened where the log's own times can be trusted.

    Returns
    -------
    LogContents
        Exposures, states (in their own frames), cameras, rejects and the source's row.
        The offset of a row is the place of its message's chunk in the file.

    Raises
    ------
    LogError
        No such file, a folder, no MCAP, messages in an unknown encoding, no frame. That none
        lies in the range is no error.
    """
    pieces = list(read_log_pieces(path, start_ns, end_ns))
    exposures, states, cameras, rejects = (
        pa.concat_tables([getattr(piece, name) for piece in pieces])
        for name in ("exposures", "states", "cameras", "rejects")
    )
    source = pieces[-1].source
    assert source is not None  # the last piece has it
    return LogContents(exposures, states, cameras, rejects, source)


def read_log_pieces(
    path: str | os.PathLike[str],
    start_ns: int | None = None,
    end_ns: int | None = None,
    piece_bytes: int = PIECE_BYTES,
) -> Iterator[LogPiece]:
    """Yield what `read_log` returns in pieces, so that it need not be in memory at once.

    A piece has about `piece_bytes` of frames and states, at most a chunk of the log more. Each
    message comes once, in the order of the file; only where the log's times turn out to be
    wrong, chunks that were passed over come last. The last piece has the rejects and the
    source; the errors that need the whole log come in its place. There is at least one piece.
    """
    where = os.fspath(path)
    span = None
    if start_ns is not None or end_ns is not None:
        span = (FIRST_NS if start_ns is None else start_ns, LAST_NS if end_ns is None else end_ns)
    with _open_mcap(where) as data, ThreadPoolExecutor(THREADS, "open chunks") as pool:
        reading = _Reading(where, data, span, pool)
        for block in reading.blocks():
            for kind, chosen in _by_kind(block, where):
                for batch in batches_of(block, kind, chosen, reading.rejects):
                    reading.columns[kind].add(batch)
            if reading.n_bytes >= piece_bytes:
                yield reading.piece()
        yield reading.last_piece()


def read_log_times(path: str | os.PathLike[str]) -> tuple[int, int] | None:
    """Return when a log's first and last message were logged, without reading them.

    UTC nanoseconds since 1970, of the recorder's clock: not the times of frames. None where
    the log has no sound summary (it was never closed): then only `read_log` can tell.

    Raises
    ------
    LogError
        No such file, a folder, no MCAP.
    """
    with _open_mcap(os.fspath(path)) as data:
        return read_summary(data, ChannelTable(frozenset())).logged_ns


def _open_mcap(where: str) -> LogBytes:
    data = open_log(where)
    if len(data) < len(MAGIC) or data.view(0, len(MAGIC)) != MAGIC:
        data.close()
        raise LogError(f"{where}: not an MCAP file; give a log as MCAP (https://mcap.dev)")
    return data


class _Reading:
    """One log that is being read: what has come of its messages, not yet taken."""

    def __init__(
        self, where: str, data: LogBytes, span: tuple[int, int] | None, pool: Executor
    ) -> None:
        self._where, self._data, self._span = where, data, span
        wide = None if span is None else (span[0] - MARGIN_NS, span[1] + MARGIN_NS)
        self._name = where.rstrip("/").rpartition("/")[2]
        self.rejects = RejectList(self._name)
        self._frames = FrameColumns(self.rejects, span)
        self._states = StateColumns(self.rejects, wide)
        self._cameras = CameraColumns(self.rejects)
        self.columns: dict[str, FrameColumns | StateColumns | CameraColumns] = {
            FRAME: self._frames,
            STATE: self._states,
            CALIBRATION: self._cameras,
        }
        kinds = kinds_of_schemas()
        # A calibration holds until the next one, so it may lie far before a range.
        always = frozenset(name for name, kind in kinds.items() if kind == CALIBRATION)
        self._walk = RecordWalk(data, frozenset(kinds), pool, wide, always)
        self._frames_ns = _TimeSpan()
        self._states_ns = _TimeSpan()

    def blocks(self) -> Iterator[Block]:
        """Yield the wanted messages of the log.

        Chunks may be passed over as long as frames are of the time they were logged at; where
        one is not, those that were passed come at the end.
        """
        for block in self._walk.blocks():
            yield block
            if (self._frames.clock_off_ns or 0) > MARGIN_NS:
                self._walk.pass_no_more()
        off_ns = self._frames.clock_off_ns
        if off_ns is None or off_ns > MARGIN_NS:
            yield from self._walk.passed_blocks()

    @property
    def n_bytes(self) -> int:
        """What waits to be taken."""
        return self._frames.n_bytes + self._states.n_bytes

    def piece(self) -> LogPiece:
        """Return what has come since the last piece."""
        exposures, states = self._frames.take(), self._states.take()
        self._frames_ns.add(exposures)
        self._states_ns.add(states)
        return LogPiece(exposures, states, self._cameras.take(), REJECTS.empty_table(), None)

    def last_piece(self) -> LogPiece:
        """Return the rest, what was left out of the whole log, and its source.

        Raises
        ------
        LogError
            Where the whole log has no frames.
        """
        piece = self.piece()
        for damage in self._walk.damage:
            self.rejects.add(
                damage.reason, time_ns=damage.time_ns, offset=damage.offset, count=damage.n
            )
        if self._frames_ns.first is None and self._span is None:
            raise LogError(f"{self._where}: no frames in it; {_advice(self.rejects)}")
        first, last = self._frames_ns.ends() or self._states_ns.ends() or self._nowhere()
        source = LogSource(self._name, len(self._data), self._data.sha256(), first, last)
        return piece._replace(rejects=self.rejects.table(first, last, self._span), source=source)

    def _nowhere(self) -> tuple[int, int]:
        return (0, 0) if self._span is None else (self._span[0], self._span[0])


@dataclass
class _TimeSpan:
    """The first and the last time of rows."""

    first: int | None = None
    last: int = 0

    def add(self, rows: pa.Table) -> None:
        """Take rows, which have a `time`."""
        if rows.num_rows:
            time_ns = array(rows, "time")
            low, high = int(time_ns.min()), int(time_ns.max())
            self.first = low if self.first is None else min(low, self.first)
            self.last = max(high, self.last)

    def ends(self) -> tuple[int, int] | None:
        """Return both, or None of no rows."""
        return None if self.first is None else (self.first, self.last)


def _by_kind(block: Block, where: str) -> Iterator[tuple[str, npt.NDArray[np.int64]]]:
    """Yield the kinds of message in a block, each with the numbers of its messages.

    Raises
    ------
    LogError
        Where a channel is in an encoding that is not registered.
    """
    kinds, encodings = kinds_of_schemas(), message_encodings()
    code = np.zeros(max(block.channels) + 1, np.uint8)
    for number, channel in block.channels.items():
        if channel.encoding not in encodings:
            raise LogError(
                f"{where}: topic {channel.topic}: messages are encoded as {channel.encoding!r}; "
                f"write {channel.schema} as one of {', '.join(encodings)}"
            )
        code[number] = KINDS.index(kinds[channel.schema])
    of_message = code[block.channel]
    for i in np.unique(code[list(block.channels)]).tolist():
        yield KINDS[i], np.flatnonzero(of_message == i)


def _advice(rejects: RejectList) -> str:
    left_out = rejects.summary()
    if left_out:
        return f"left out: {left_out}; check the recording"
    return "record epipole.CentroidFrame messages (the schema's name decides, not the topic)"
