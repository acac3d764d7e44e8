"""The records of an MCAP file, which may be damaged.

The data section is read from its start, so that a log that was cut short or never closed gives
the messages that it has. A chunk with a wrong checksum, size or compression is left out and
reported. The summary is used where it is valid. It repeats the schemas and channels, lists the
chunks (to continue after a damaged record) and counts the messages (to notice missing ones).
"""

import zlib
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.io.logs.mcap.bytes import BLOCK_BYTES, LogBytes
from epipole.io.logs.mcap.container import (
    RECORD,
    Channel,
    ChannelTable,
    ChunkError,
    LogSummary,
    OpenedChunk,
    open_chunk,
    open_cut_chunk,
    read_summary,
)
from epipole.io.logs.mcap.damage_rows import Damage, DamageRows
from epipole.io.logs.mcap.record_layout import RUN, LogSegments, Segment
from epipole.io.logs.mcap.record_scan import (
    CHUNK,
    DATA_END,
    MESSAGE,
    MESSAGE_BYTES,
    Bytes,
    Hashes,
    RecordIndex,
    changed_declarations,
    index_records,
    no_declarations,
)
from epipole.io.logs.mcap.undeclared import Channels, LateMessages, Undeclared
from epipole.schemas.arrays import Integers
from epipole.schemas.rejects import Reason

# The uncompressed size of all chunks together may not exceed max(16 MiB, 200 x the file's size):
# so the file bounds what they cost. Logs of frames shrink to a half or a tenth.
MAX_EXPANSION = 200
MIN_UNPACKED_BYTES = 16 << 20

AHEAD_BYTES = 8 << 20  # of chunks that are opened while the chunk before them is decoded
WAITING_BYTES = 2 << 10  # that a waiting chunk takes beside its records
SMALL_BYTES = 4 << 10  # a chunk of fewer is opened sooner than given to another thread

# A summary that counts more messages per byte of the log is damaged: the best compression of
# empty messages has about 300.
MAX_PER_BYTE = 1000

PER_RECORD = ("opcode", "channel", "time_ns", "start", "end")  # columns of an index


class Block(NamedTuple):
    """Wanted messages that follow each other; message i is ``data[start[i]:end[i]]``."""

    data: Bytes
    channels: dict[int, Channel]  # by number
    channel: npt.NDArray[np.uint16]  # number
    time_ns: npt.NDArray[np.uint64]  # when it was logged
    start: Integers
    end: Integers
    offset: Integers  # in the file, of its chunk; outside chunks, of the message


@dataclass
class RecordWalk:
    """Reads the records of one log."""

    data: LogBytes
    wanted: frozenset[str]  # names of the schemas whose messages are wanted
    pool: Executor | None = None  # opens chunks while the chunk before them is decoded
    _damage: DamageRows = field(default_factory=DamageRows)
    _summary: LogSummary = field(default_factory=LogSummary)
    _undeclared: Undeclared = field(default_factory=Undeclared)
    _counts: dict[int, int] = field(default_factory=dict)  # messages by channel
    _promised: frozenset[int] = frozenset()  # channels that are wanted, by the summary
    _declared: Hashes = field(default_factory=no_declarations)  # what was declared last
    _lost_chunk: int | None = None  # row of the chunk left out that message indexes follow
    _n_lost: int = 0  # messages of it that these indexes counted
    _in_chunk: dict[int, int] = field(default_factory=dict)  # its messages by channel, if read
    _log_start: int = 0  # of this one of several logs in the file
    _unchecked: bool = False  # whether there are messages that no chunk's checksum covers

    def __post_init__(self) -> None:
        self._channels = ChannelTable(self.wanted, ChannelTable(self.wanted))
        self._segments = LogSegments(self.data, self._summary)

    @property
    def damage(self) -> list[Damage]:
        """What was left out; complete when `blocks` has ended."""
        return self._damage.rows

    def blocks(self) -> Iterator[Block]:
        """Yield the wanted messages in the order of the file; late declared ones come last."""
        in_summary = ChannelTable(self.wanted)
        self._segments.summary = self._summary = read_summary(self.data, in_summary)
        self._channels.summary = in_summary
        self._promised = frozenset(filter(in_summary.find, self._summary.declared))
        self._unchecked = self._summary.data_end is None
        self.data.stream()
        for segment, opening in self._opened_ahead(self._segments):
            yield from self._read_segment(segment, opening)
        self._end_log()
        self._report_missing()
        if (late := self._undeclared.late()) is not None:
            yield from self._walk_again(late)

    def _opened_ahead(
        self, segments: Iterable[Segment]
    ) -> Iterator[tuple[Segment, Future[OpenedChunk] | None]]:
        """Yield the segments; if there is a pool, it is already opening their chunks."""
        waiting: deque[tuple[Segment, Future[OpenedChunk] | None]] = deque()
        ahead, unpacked = 0, 0
        limit = max(MIN_UNPACKED_BYTES, MAX_EXPANSION * len(self.data))
        for segment in segments:
            opening = None
            if segment.opcode == CHUNK and not segment.reason:
                if unpacked + segment.size > limit:
                    segment = Segment(CHUNK, segment.at, segment.after, Reason.CHUNK_TOO_LARGE)
                unpacked += segment.size
            is_whole_chunk = segment.opcode == CHUNK and not (segment.reason or segment.cut)
            if self.pool is not None and is_whole_chunk and _cost(segment) > SMALL_BYTES:
                opening = self.pool.submit(open_chunk, segment.data)
            waiting.append((segment, opening))
            ahead += _cost(segment)
            while waiting and (ahead > AHEAD_BYTES or waiting[0][1] is None):
                ahead -= _cost(waiting[0][0])
                yield waiting.popleft()
        yield from waiting

    # What is in the file

    def _read_segment(
        self, segment: Segment, opening: Future[OpenedChunk] | None
    ) -> Iterator[Block]:
        if segment.counted is None:
            self._in_chunk = {}  # only indexes that follow a chunk at once are about it
        if segment.reason == Reason.LOG_BEHIND_LOG:
            self._end_log()
            self._log_start = segment.at
            self._channels.forget()
            self._declared = no_declarations()
        if segment.reason:
            row = self._damage.add(segment.at, 0, segment.reason)
            if segment.opcode == CHUNK:
                self._lost_chunk, self._n_lost = row, 0
        elif segment.opcode == CHUNK:
            yield from self._walk_chunk(segment, _open(segment, opening))
        elif segment.counted is not None:
            self._count_lost(segment.at, *segment.counted)
        elif segment.opcode == RUN:
            yield from self._walk_run(segment)
        elif segment.opcode == DATA_END:
            self._check_data_section(segment)

    def _walk_chunk(self, segment: Segment, opened: OpenedChunk) -> Iterator[Block]:
        """Yield the messages of a chunk."""
        self._lost_chunk = None
        at, start_ns = segment.at, opened.start_ns
        if opened.reason:
            self._lost_chunk, self._n_lost = self._damage.add(at, start_ns, opened.reason), 0
            return
        self._unchecked |= not opened.is_checked
        data, n_strange, walked = _bytes(opened.records), 0, 0
        self._in_chunk = {}
        for index in index_records(data):
            yield from self._walk_index(data, index, _offsets(segment, index), start_ns)
            counts = np.bincount(index.channel[index.opcode == MESSAGE])
            for number in np.flatnonzero(counts).tolist():
                self._in_chunk[number] = self._in_chunk.get(number, 0) + int(counts[number])
            n_strange, walked = n_strange + index.n_strange, index.walked
        if n_strange:
            self._damage.add(at, start_ns, Reason.DAMAGED_RECORD, n_strange)
        if walked < len(data) and not segment.cut:
            self._damage.add(at, start_ns, Reason.DAMAGED_CHUNK)

    def _walk_run(self, segment: Segment) -> Iterator[Block]:
        """Yield the messages of a run of records outside chunks."""
        data = _bytes(segment.data)
        for index in index_records(data, outside=True):
            self._unchecked |= MESSAGE in index.opcode
            if index.n_strange:
                at = segment.at + index.first_strange
                self._damage.add(at, 0, Reason.DAMAGED_RECORD, index.n_strange)
            yield from self._walk_index(data, index, _offsets(segment, index), 0)

    def _check_data_section(self, segment: Segment) -> None:
        """Compare the data section with the checksum at its end, if no other checksum covers it.

        This reads the log again. A wrong checksum does not say which message is damaged: those
        whose values are valid have been used.
        """
        expected = int.from_bytes(segment.data[RECORD.size :], "little")
        if expected and self._unchecked:
            checksum = 0
            for low in range(self._log_start, segment.at, BLOCK_BYTES):
                checksum = zlib.crc32(
                    self.data.view(low, min(low + BLOCK_BYTES, segment.at)), checksum
                )
            if checksum != expected:
                self._damage.add(segment.at, 0, Reason.BAD_DATA_CHECKSUM)

    def _walk_index(
        self, data: Bytes, index: RecordIndex, offset: Integers, start_ns: int
    ) -> Iterator[Block]:
        """Yield the runs of messages between declarations of schemas and channels."""
        keep = changed_declarations(data, index, self._declared)
        if not keep.all():
            columns = {name: getattr(index, name)[keep] for name in PER_RECORD}
            index, offset = index._replace(**columns), offset[keep]
        declared = np.flatnonzero(index.opcode != MESSAGE)
        at = 0
        for i in [*declared.tolist(), len(index.opcode)]:
            if i > at:
                yield from self._wanted(data, index, offset, slice(at, i))
            at = i + 1
            if i == len(index.opcode):
                break
            start, end = int(index.start[i]), int(index.end[i])
            try:
                self._channels.declare(int(index.opcode[i]), data.data, start, end)
            except ChunkError:
                self._damage.add(int(offset[i]), start_ns, Reason.DAMAGED_RECORD)

    def _wanted(
        self, data: Bytes, index: RecordIndex, offset: Integers, run: slice
    ) -> Iterator[Block]:
        """Yield the wanted messages of a run; all messages are counted."""
        channel = index.channel[run]
        wanted: dict[int, Channel] = {}
        undeclared = []
        counts = np.bincount(channel)
        for number in np.flatnonzero(counts).tolist():
            n = int(counts[number])
            known = self._channels.find(number)
            # Where a damaged declaration hides a channel that the summary has, they are missing.
            if known is not None or number not in self._promised:
                self._counts[number] = self._counts.get(number, 0) + n
            if known is not None:
                wanted[number] = known
            elif self._channels.missing(number):
                undeclared.append(number)
        if undeclared:
            self._add_undeclared(undeclared, channel, index.time_ns[run], offset[run])
        columns: list[npt.NDArray[Any]] = [
            channel,
            index.time_ns[run],
            index.start[run],
            index.end[run],
            offset[run],
        ]
        if np.count_nonzero(counts) > len(wanted):
            asked = np.zeros(len(counts), bool)
            asked[list(wanted)] = True
            keep = asked[channel]
            columns = [column[keep] for column in columns]
        if wanted:
            yield Block(data, wanted, *columns)

    # What is declared too late, or never

    def _add_undeclared(
        self, numbers: list[int], channel: npt.NDArray[np.uint16], time_ns: Any, offset: Integers
    ) -> None:
        first = np.zeros(int(channel.max()) + 1, np.int64)
        first[channel[::-1]] = np.arange(len(channel))[::-1]  # the last assignment counts
        counts = np.bincount(channel)
        for number in numbers:
            i = first[number]
            self._undeclared.add(number, int(counts[number]), int(offset[i]), int(time_ns[i]))

    def _end_log(self) -> None:
        """Leave out the messages of a log that it does not declare."""
        for waiting in self._undeclared.settle(self._channels):
            self._damage.add(waiting.offset, waiting.time_ns, waiting.reason, waiting.n)

    def _walk_again(self, late: LateMessages) -> Iterator[Block]:
        """Yield the messages that come before their declarations; no damage is reported again."""
        n_logs = 0
        for segment, opening in self._opened_ahead(self._segments):
            if not late:
                return
            if segment.reason == Reason.LOG_BEHIND_LOG:
                n_logs += 1
                late.begin_log(n_logs)
            elif not segment.reason and segment.opcode in (CHUNK, RUN):
                data = _bytes(_open(segment, opening).records)
                for index in index_records(data, outside=segment.opcode == RUN):
                    messages = np.flatnonzero(index.opcode == MESSAGE)
                    chosen = messages[late.take(index.channel[messages])]
                    columns = [getattr(index, name)[chosen] for name in PER_RECORD[1:]]
                    columns.append(_offsets(segment, index)[chosen])
                    yield Block(data, late.channels, *columns)

    # What is missing in it

    def _count_lost(self, at: int, numbers: Channels, counted: Integers) -> None:
        """Count the messages that indexes have and the chunk before them had not.

        The chunk was left out, or it was no chunk any more, or a part of it was damaged.
        """
        some = counted > 0
        for number, n in zip(numbers[some].tolist(), counted[some].tolist(), strict=True):
            lost = n - self._in_chunk.get(number, 0)
            if lost <= 0 or not self._may_be_wanted(number):
                continue
            if self._lost_chunk is None:
                row = self._damage.add(at, 0, Reason.MISSING_MESSAGES)
                self._lost_chunk, self._n_lost = row, 0
            self._counts[number] = self._counts.get(number, 0) + lost
            # The row of the chunk counts one already, for itself.
            self._damage.count(self._lost_chunk, lost if self._n_lost else lost - 1)
            self._n_lost += lost

    def _may_be_wanted(self, number: int) -> bool:
        """Return whether a channel is wanted, or not declared so far."""
        return bool(self._channels.find(number) or self._channels.missing(number))

    def _report_missing(self) -> None:
        declared = self._summary.declared
        missing = sum(
            max(0, count - self._counts.get(number, 0))
            for number, count in declared.items()
            if number in self._promised or self._may_be_wanted(number)
        )
        if missing > MAX_PER_BYTE * len(self.data):
            self._damage.add(0, 0, Reason.DAMAGED_RECORD)  # the counts themselves are damaged
        elif missing:
            self._damage.add(0, 0, Reason.MISSING_MESSAGES, missing)


def _cost(segment: Segment) -> int:
    """Return about how many bytes a segment takes while it waits, and when it is opened."""
    return segment.size + len(segment.data) + WAITING_BYTES


def _open(segment: Segment, opening: Future[OpenedChunk] | None) -> OpenedChunk:
    """Return the records of a chunk, or of a run of records outside chunks."""
    if opening is not None:
        return opening.result()
    if segment.opcode == CHUNK:
        return open_cut_chunk(segment.data) if segment.cut else open_chunk(segment.data)
    return OpenedChunk(0, segment.data)


def _offsets(segment: Segment, index: RecordIndex) -> Integers:
    """Return where in the file the records lie; those of a chunk lie where the chunk does."""
    if segment.opcode == CHUNK:
        return np.full(len(index.start), segment.at)
    offset = segment.at + index.start - RECORD.size
    offset[index.opcode == MESSAGE] -= MESSAGE_BYTES
    return offset


def _bytes(data: bytes | memoryview) -> Bytes:
    return np.frombuffer(data, np.uint8)
