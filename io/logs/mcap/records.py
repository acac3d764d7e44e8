"""The records of an MCAP file, which may be damaged.

The data section is read from its start, so that a log that was cut short or never closed gives
the messages that it has. A chunk with a wrong checksum, size or compression is left out and
reported. The summary is used where it is valid. It repeats the schemas and channels, lists the
chunks (to continue after a damaged record) and counts the messages (to notice missing ones).
"""

import struct
import zlib
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.io.logs.mcap.blocks import BLOCK_BYTES
from epipole.io.logs.mcap.bytes import LogBytes
from epipole.io.logs.mcap.channels import Channel, ChannelTable
from epipole.io.logs.mcap.chunks import OpenedChunk, open_chunk, open_cut_chunk
from epipole.io.logs.mcap.compression import ChunkError
from epipole.io.logs.mcap.places import CHUNK, LOOSE, LogPlaces, Place
from epipole.io.logs.mcap.record_scan import MESSAGE, Bytes, RecordIndex, index_records
from epipole.io.logs.mcap.summary import RECORD, LogSummary, read_summary
from epipole.schemas.rejects import Reason

AHEAD_BYTES = 8 << 20  # of chunks that are opened while the chunk before them is decoded

Numbers = npt.NDArray[np.int64]


class Block(NamedTuple):
    """Wanted messages that follow each other; message i is ``data[start[i]:end[i]]``."""

    data: Bytes
    channels: dict[int, Channel]  # by number
    channel: npt.NDArray[np.uint16]  # number
    time_ns: npt.NDArray[np.uint64]  # when it was logged
    start: Numbers
    end: Numbers
    offset: Numbers  # place in the file of its chunk; outside chunks, of the message


class Damage(NamedTuple):
    """Messages that were left out: where, when (0: unknown), why, how many."""

    offset: int
    time_ns: int
    reason: Reason
    n: int


@dataclass
class RecordWalk:
    """Reads the records of one log; `damage` is complete when `blocks` has ended."""

    data: LogBytes
    wanted: frozenset[str]  # names of the schemas whose messages are wanted
    pool: Executor | None = None  # opens chunks while the chunk before them is decoded
    damage: list[Damage] = field(default_factory=list)
    _summary: LogSummary = field(default_factory=LogSummary)
    _unknown: dict[int, int] = field(default_factory=dict)
    _counts: dict[int, int] = field(default_factory=dict)
    _lost: dict[int, int] = field(default_factory=dict)  # lost messages, by index of `damage`
    _lost_chunk: int | None = None  # index in `damage` of the chunk that message indexes follow

    def __post_init__(self) -> None:
        self._channels = ChannelTable(self.wanted)
        self._places = LogPlaces(self.data, self._summary)

    def blocks(self) -> Iterator[Block]:
        """Yield the wanted messages in the order of the file."""
        self._places.summary = self._summary = read_summary(self.data, self._channels)
        self.data.stream()
        for place, opening in self._opened_ahead(self._places):
            yield from self._walk_place(place, opening)
        self._report_missing()

    def _opened_ahead(
        self, places: Iterable[Place]
    ) -> Iterator[tuple[Place, Future[OpenedChunk] | None]]:
        """Yield the places; if there is a pool, it is already opening their chunks."""
        waiting: deque[tuple[Place, Future[OpenedChunk] | None]] = deque()
        ahead = 0
        for place in places:
            opening = None
            if self.pool is not None and place.opcode == CHUNK and not (place.reason or place.cut):
                opening = self.pool.submit(open_chunk, place.data)
            waiting.append((place, opening))
            ahead += place.size
            while waiting and (ahead > AHEAD_BYTES or waiting[0][1] is None):
                first, opening = waiting.popleft()
                ahead -= first.size
                yield first, opening
        yield from waiting

    # What is in the file

    def _walk_place(self, place: Place, opening: Future[OpenedChunk] | None) -> Iterator[Block]:
        if place.cut:
            yield from self._walk_chunk(place.at, open_cut_chunk(place.data), cut=True)
        elif place.reason:
            self._leave_out(place.at, 0, place.reason)
            if place.opcode == CHUNK:
                self._lost_chunk = len(self.damage) - 1
        elif place.opcode == CHUNK:
            opened = open_chunk(place.data) if opening is None else opening.result()
            yield from self._walk_chunk(place.at, opened)
        elif place.counted is not None:
            self._count_lost(*place.counted)
        elif place.opcode in LOOSE:
            yield from self._walk_loose(place)

    def _walk_chunk(self, at: int, opened: OpenedChunk, cut: bool = False) -> Iterator[Block]:
        """Yield the messages of a chunk; `cut`: its last record may be incomplete."""
        self._lost_chunk = None
        start_ns, records, index, reason = opened
        if reason:
            self._leave_out(at, start_ns, reason)
            self._lost_chunk = len(self.damage) - 1
            return
        offset = np.full(len(index.start), at)
        yield from self._walk_index(_bytes(records), index, offset, start_ns)
        if index.n_strange:
            self._leave_out(at, start_ns, Reason.DAMAGED_RECORD, index.n_strange)
        if index.walked < len(records) and not cut:
            self._leave_out(at, start_ns, Reason.DAMAGED_CHUNK)

    def _walk_loose(self, place: Place) -> Iterator[Block]:
        """Yield the messages of a run of records outside chunks."""
        data, at = _bytes(place.data), place.at
        index = index_records(data)
        offset = at + index.start - RECORD.size
        offset[index.opcode == MESSAGE] -= 22
        if index.n_strange:
            self._leave_out(at, 0, Reason.DAMAGED_RECORD, index.n_strange)
        for block in self._walk_index(data, index, offset, 0):
            if self._sound_outside_chunks:
                yield block
            else:
                for offset_of_lost, time_ns in zip(block.offset, block.time_ns, strict=True):
                    self._leave_out(int(offset_of_lost), int(time_ns), Reason.BAD_CHECKSUM)

    @cached_property
    def _sound_outside_chunks(self) -> bool:
        """Whether the data section fits its checksum; messages outside chunks have no other."""
        at = self._summary.data_end
        if at is None:
            return True  # a log that was never closed has no checksum
        (expected,) = struct.unpack("<I", self.data.view(at + RECORD.size, at + RECORD.size + 4))
        checksum = 0
        for low in range(0, at if expected else 0, BLOCK_BYTES):
            checksum = zlib.crc32(self.data.view(low, min(low + BLOCK_BYTES, at)), checksum)
        return checksum == expected

    def _walk_index(
        self, data: Bytes, index: RecordIndex, offset: Numbers, start_ns: int
    ) -> Iterator[Block]:
        """Yield the runs of messages between declarations of schemas and channels."""
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
                self._leave_out(int(offset[i]), start_ns, Reason.DAMAGED_RECORD)

    def _wanted(
        self, data: Bytes, index: RecordIndex, offset: Numbers, run: slice
    ) -> Iterator[Block]:
        """Yield the wanted messages of a run; all messages are counted."""
        channel = index.channel[run]
        wanted: dict[int, Channel] = {}
        counts = np.bincount(channel)
        for number in np.flatnonzero(counts).tolist():
            n = int(counts[number])
            self._counts[number] = self._counts.get(number, 0) + n
            known = self._channels.find(number)
            if known is not None:
                wanted[number] = known
            elif number not in self._channels:
                self._unknown[number] = self._unknown.get(number, 0) + n
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

    # What is missing in it

    def _leave_out(self, offset: int, time_ns: int, reason: Reason, count: int = 1) -> None:
        self.damage.append(Damage(offset, time_ns, reason, count))

    def _count_lost(self, number: int, n: int) -> None:
        """Count the messages of a chunk that is left out, by an index after it."""
        if self._lost_chunk is None or (self._channels and not self._channels.find(number)):
            return
        self._counts[number] = self._counts.get(number, 0) + n
        index = self._lost_chunk
        self._lost[index] = self._lost.get(index, 0) + n
        self.damage[index] = self.damage[index]._replace(n=max(1, self._lost[index]))

    def _report_missing(self) -> None:
        for _, count in sorted(self._unknown.items()):
            self._leave_out(0, 0, Reason.UNKNOWN_CHANNEL, count)
        declared = self._summary.declared
        missing = sum(
            max(0, count - self._counts.get(number, 0))
            for number, count in declared.items()
            if self._channels.find(number)
        )
        if missing:
            self._leave_out(0, 0, Reason.MISSING_MESSAGES, missing)


def _bytes(data: bytes | memoryview) -> Bytes:
    return np.frombuffer(data, np.uint8)
