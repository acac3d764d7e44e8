"""The records of an MCAP file, walked one by one, with whatever damage the file has.

The data section is walked from its start and the summary is not trusted to be complete:
a log that was cut off, or never closed, gives the messages it holds. A chunk whose
checksum, size or compression does not hold is left out and reported. The summary helps
where it can: it has the schemas and channels again, the places of the chunks (to go on
behind a damaged record), and the number of messages (to know that one is missing).
"""

import struct
import zlib
from bisect import bisect_right
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.io.log_channels import Channel, ChannelTable
from epipole.io.log_chunks import OpenedChunk, open_chunk, open_cut_chunk, read_head
from epipole.io.log_compression import ChunkError
from epipole.io.log_summary import DATA_END, MAGIC, RECORD, Summary, next_log, read_summary
from epipole.io.record_scan import (
    CHANNEL,
    MESSAGE,
    PRIVATE,
    SCHEMA,
    Bytes,
    RecordIndex,
    index_records,
)

HEADER, CHUNK, MESSAGE_INDEX, ATTACHMENT, METADATA = 0x01, 0x06, 0x07, 0x09, 0x0C
IGNORED = (ATTACHMENT, METADATA)
LOOSE = (SCHEMA, CHANNEL, MESSAGE)  # may lie in a chunk or outside
AHEAD_BYTES = 32 << 20  # of chunks that are opened while the ones before them are decoded

Numbers = npt.NDArray[np.int64]


class Block(NamedTuple):
    """Wanted messages that follow each other; message i is ``data[start[i]:end[i]]``."""

    data: Bytes
    channels: dict[int, Channel]  # by number
    channel: npt.NDArray[np.uint16]  # number
    time_ns: npt.NDArray[np.uint64]  # when it was logged
    start: Numbers
    end: Numbers
    offset: Numbers  # place in the file of its chunk, or its own outside chunks


class Damage(NamedTuple):
    """Something of the file that was left out: where, when (0: unknown), why, how many."""

    offset: int
    time_ns: int
    reason: str
    n: int


class Place(NamedTuple):
    """Part of the data section: a record, a run of loose ones, or damage, which has a reason."""

    opcode: int
    at: int
    after: int
    reason: str = ""


@dataclass
class RecordWalk:
    """A walk over the bytes of one log; `damage` is complete when `blocks` has ended."""

    data: memoryview
    wanted: frozenset[str]  # names of the schemas whose messages are asked for
    pool: Executor | None = None  # opens chunks while the ones before them are decoded
    span: tuple[int, int] | None = None  # chunks logged wholly outside it need not be opened
    always: frozenset[str] = frozenset()  # but for those with messages of these schemas
    n_passed: int = 0  # chunks that were not opened
    damage: list[Damage] = field(default_factory=list)
    _summary: Summary = field(default_factory=Summary)
    _unknown: dict[int, int] = field(default_factory=dict)
    _counts: dict[int, int] = field(default_factory=dict)
    _lost: dict[int, int] = field(default_factory=dict)  # messages of a damage, by its index
    _lost_chunk: int | None = None  # the damage that message indexes now belong to
    _passing: bool = False  # whether message indexes now belong to a chunk that is not opened

    def __post_init__(self) -> None:
        self._channels = ChannelTable(self.wanted)

    def blocks(self) -> Iterator[Block]:
        """Yield the wanted messages in the order of the file."""
        self._summary = read_summary(self.data, self._channels)
        for place, opening in self._opened_ahead():
            yield from self._walk_place(place, opening)
        self._report_missing()

    # Where things are, by the lengths of records alone

    def _places(self) -> Iterator[Place]:
        data, end, at = self.data, len(self.data), len(MAGIC)
        while at + RECORD.size <= end:
            opcode, length = RECORD.unpack_from(data, at)
            after = at + RECORD.size + length
            skipped_to = self._next_chunk(at)
            limit = end if skipped_to is None else skipped_to
            if opcode == CHUNK:
                after = self._end_of_chunk(at, after, limit)
            if opcode == 0 or after > limit:
                if skipped_to is None:
                    if opcode == CHUNK:
                        yield Place(CHUNK, at, end, "cut")
                    break
                yield Place(opcode, at, skipped_to, "damaged_record")
                at = skipped_to
            elif opcode == DATA_END and (another := next_log(data, after)) is not None:
                yield Place(0, another, another, "log_behind_log")
                at = another + len(MAGIC)
            elif opcode == DATA_END and length == 4 and self._summary.data_end in (None, at):
                return
            else:
                if opcode in LOOSE:
                    run = index_records(_bytes(data[at:limit]), only_known=True)
                    after = max(after, at + run.walked)
                passed = opcode == CHUNK and self._may_pass(at, after)
                yield Place(opcode, at, after, "passed" if passed else "")
                at = after
        yield Place(0, at, end, "truncated")

    def _end_of_chunk(self, at: int, after: int, limit: int) -> int:
        """Return where a chunk ends: as its record says, unless only its own length can be."""
        try:
            own = read_head(self.data, at).end
        except ChunkError:
            return after
        return own if own <= limit else after

    def _next_chunk(self, at: int) -> int | None:
        """Return the first place behind `at` where the summary knows of a chunk."""
        offsets = self._summary.chunk_offsets
        i = bisect_right(offsets, at)
        return offsets[i] if i < len(offsets) else None

    def _opened_ahead(self) -> Iterator[tuple[Place, Future[OpenedChunk] | None]]:
        """Yield the places, each chunk with its opening under way if there is a pool."""
        waiting: deque[tuple[Place, Future[OpenedChunk] | None, int]] = deque()
        ahead = 0
        for place in self._places():
            opening, size = None, 0
            if self.pool is not None and place.opcode == CHUNK and not place.reason:
                opening = self.pool.submit(open_chunk, self.data, place.at, place.after)
                size = self._size(place)
            waiting.append((place, opening, size))
            ahead += size
            while waiting and (ahead > AHEAD_BYTES or waiting[0][1] is None):
                first, opening, size = waiting.popleft()
                ahead -= size
                yield first, opening
        for place, opening, _ in waiting:
            yield place, opening

    def _size(self, place: Place) -> int:
        try:
            return read_head(self.data, place.at).size
        except ChunkError:
            return 0

    def _may_pass(self, at: int, after: int) -> bool:
        """Return whether a chunk is of another time for certain, and nothing else needs it.

        The log must have been closed: its summary has the channels that a chunk may declare.
        The chunk's times must be those of the indexes behind it. The first and the last are
        always opened: they show whether messages are logged at the time that they are of.
        """
        places = self._summary.chunk_offsets
        if self.span is None or not self._summary.sound or at in (places[:1] + places[-1:]):
            return False
        try:
            head = read_head(self.data, at)
        except ChunkError:
            return False
        low, high = self.span
        if not (head.start_ns <= head.end_ns < low or high <= head.start_ns <= head.end_ns):
            return False
        indexes = list(self._indexes_behind(after))
        return bool(indexes) and all(
            self._channels.knows(number)
            and getattr(self._channels.find(number), "schema", "") not in self.always
            and len(time_ns)
            and head.start_ns <= time_ns.min()
            and time_ns.max() <= head.end_ns
            for number, time_ns in indexes
        )

    def _indexes_behind(self, at: int) -> Iterator[tuple[int, npt.NDArray[np.uint64]]]:
        """Yield the channel and the times of each message index from `at` on."""
        while at + RECORD.size <= len(self.data):
            opcode, length = RECORD.unpack_from(self.data, at)
            body, at = at + RECORD.size, at + RECORD.size + length
            if opcode != MESSAGE_INDEX or at > len(self.data):
                return
            if not self._is_message_index(body, at):
                return
            number, size = struct.unpack_from("<HI", self.data, body)
            yield number, np.frombuffer(self.data, "<u8", size // 8, body + 6)[::2]

    # What is there

    def _walk_place(self, place: Place, opening: Future[OpenedChunk] | None) -> Iterator[Block]:
        opcode, at, after, reason = place
        body = at + RECORD.size
        if reason == "cut":
            yield from self._walk_chunk(at, open_cut_chunk(self.data, at), cut=True)
        elif reason == "passed":
            self.n_passed += 1
            self._passing = True
        elif reason:
            self._leave_out(at, 0, reason)
        elif opcode == CHUNK:
            opened = open_chunk(self.data, at, after) if opening is None else opening.result()
            yield from self._walk_chunk(at, opened)
        elif opcode == MESSAGE_INDEX and self._is_message_index(body, after):
            self._count_lost(body)
        elif opcode in LOOSE:
            yield from self._walk_loose(at, after)
        elif opcode == HEADER and self.data[at - len(MAGIC) : at] == MAGIC:
            pass
        elif opcode < PRIVATE and opcode not in IGNORED:
            self._leave_out(at, 0, "damaged_record")  # no such record in a data section

    def _walk_chunk(self, at: int, opened: OpenedChunk, cut: bool = False) -> Iterator[Block]:
        """Yield the messages of a chunk; `cut`: its last record may be incomplete."""
        self._lost_chunk, self._passing = None, False
        start_ns, records, index, reason = opened
        if reason:
            self._leave_out(at, start_ns, reason)
            self._lost_chunk = len(self.damage) - 1
            return
        offset = np.full(len(index.start), at)
        yield from self._walk_index(_bytes(records), index, offset, start_ns)
        if index.n_strange:
            self._leave_out(at, start_ns, "damaged_record", index.n_strange)
        if index.walked < len(records) and not cut:
            self._leave_out(at, start_ns, "damaged_chunk")

    def _walk_loose(self, at: int, after: int) -> Iterator[Block]:
        """Yield the messages of a run of records outside chunks."""
        data = _bytes(self.data[at:after])
        index = index_records(data)
        offset = at + index.start - RECORD.size
        offset[index.opcode == MESSAGE] -= 22
        if index.n_strange:
            self._leave_out(at, 0, "damaged_record", index.n_strange)
        for block in self._walk_index(data, index, offset, 0):
            if self._sound_outside_chunks:
                yield block
            else:
                for place, time_ns in zip(block.offset, block.time_ns, strict=True):
                    self._leave_out(int(place), int(time_ns), "bad_checksum")

    @cached_property
    def _sound_outside_chunks(self) -> bool:
        """Whether the data section holds its checksum, the only one of messages outside chunks."""
        at = self._summary.data_end
        if at is None:
            return True  # an unclosed log has none
        (checksum,) = struct.unpack_from("<I", self.data, at + RECORD.size)
        return checksum in (0, zlib.crc32(self.data[:at]))

    def _walk_index(
        self, data: Bytes, index: RecordIndex, offset: Numbers, start_ns: int
    ) -> Iterator[Block]:
        """Yield the runs of messages between declarations."""
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
                self._leave_out(int(offset[i]), start_ns, "damaged_record")

    def _wanted(
        self, data: Bytes, index: RecordIndex, offset: Numbers, part: slice
    ) -> Iterator[Block]:
        """Yield the messages of a run that are asked for; all of them are counted."""
        channel = index.channel[part]
        wanted: dict[int, Channel] = {}
        counts = np.bincount(channel)
        for number in np.flatnonzero(counts).tolist():
            n = int(counts[number])
            self._counts[number] = self._counts.get(number, 0) + n
            found = self._channels.find(number)
            if found is not None:
                wanted[number] = found
            elif number not in self._channels:
                self._unknown[number] = self._unknown.get(number, 0) + n
        columns: list[npt.NDArray[Any]] = [
            channel,
            index.time_ns[part],
            index.start[part],
            index.end[part],
            offset[part],
        ]
        if np.count_nonzero(counts) > len(wanted):
            asked = np.zeros(len(counts), bool)
            asked[list(wanted)] = True
            keep = asked[channel]
            columns = [column[keep] for column in columns]
        if wanted:
            yield Block(data, wanted, *columns)

    # What is missing

    def _leave_out(self, offset: int, time_ns: int, reason: str, count: int = 1) -> None:
        self.damage.append(Damage(offset, time_ns, reason, count))

    def _is_message_index(self, body: int, after: int) -> bool:
        if after - body < 6:
            return False
        size = struct.unpack_from("<HI", self.data, body)[1]
        return size == after - body - 6 and size % 16 == 0

    def _count_lost(self, body: int) -> None:
        """Count the messages of a chunk that is left out or passed, by an index behind it."""
        number, size = struct.unpack_from("<HI", self.data, body)
        if self._passing:
            self._counts[number] = self._counts.get(number, 0) + size // 16
            return
        if self._lost_chunk is None or (self._channels and not self._channels.find(number)):
            return
        self._counts[number] = self._counts.get(number, 0) + size // 16
        index = self._lost_chunk
        self._lost[index] = self._lost.get(index, 0) + size // 16
        self.damage[index] = self.damage[index]._replace(n=max(1, self._lost[index]))

    def _report_missing(self) -> None:
        for number, count in sorted(self._unknown.items()):
            self._leave_out(0, 0, f"unknown_channel_{number}", count)
        declared = self._summary.declared
        missing = sum(
            max(0, count - self._counts.get(number, 0))
            for number, count in declared.items()
            if self._channels.find(number)
        )
        if missing:
            self._leave_out(0, 0, "missing_messages", missing)


def _bytes(data: bytes | memoryview) -> Bytes:
    return np.frombuffer(data, np.uint8)
