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
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

from epipole.io.log_compression import ChunkError, decompress, decompress_part

MAGIC = b"\x89MCAP0\r\n"
# A chunk holds a few MiB; one that claims more than this is damage or an attack.
MAX_CHUNK_BYTES = 256 << 20

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, STATISTICS, METADATA, DATA_END = 0x09, 0x0B, 0x0C, 0x0F
PRIVATE = 0x80  # from here on records are someone's own, and skipped
IGNORED = (ATTACHMENT, METADATA)

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<BQHIQQ")
_CHUNK = struct.Struct("<QQQI")
_FOOTER_BYTES = 9 + 20 + len(MAGIC)


class Channel(NamedTuple):
    """What a channel carries, by the name of its schema, and in which encoding."""

    topic: str
    encoding: str
    schema: str


class Message(NamedTuple):
    """One message; `offset` is its chunk's place in the file, or its own outside chunks."""

    channel: Channel
    time_ns: int
    offset: int
    data: bytes


class Damage(NamedTuple):
    """Something of the file that was left out: where, when (0: unknown), why, how many."""

    offset: int
    time_ns: int
    reason: str
    n: int


@dataclass
class RecordWalk:
    """A walk over the bytes of one log; `damage` is complete when `messages` has ended."""

    data: memoryview
    wanted: frozenset[str]  # names of the schemas whose messages are asked for
    damage: list[Damage] = field(default_factory=list)
    _schemas: dict[int, str] = field(default_factory=dict)
    _channels: dict[int, tuple[str, str, int]] = field(default_factory=dict)
    _known: dict[int, Channel | None] = field(default_factory=dict)
    _unknown: dict[int, int] = field(default_factory=dict)
    _counts: dict[int, int] = field(default_factory=dict)
    _declared: dict[int, int] = field(default_factory=dict)
    _chunk_offsets: list[int] = field(default_factory=list)
    _lost: dict[int, int] = field(default_factory=dict)  # messages of a damage, by its index
    _lost_chunk: int | None = None  # the damage that message indexes now belong to
    _data_end: int | None = None  # where the data section ends, if the file is whole

    def messages(self) -> Iterator[Message]:
        """Yield the wanted messages in the order of the file."""
        self._read_summary()
        yield from self._walk_file()
        self._report_missing()

    # The file

    def _walk_file(self) -> Iterator[Message]:
        data, end, at = self.data, len(self.data), len(MAGIC)
        closed = False
        while at + _RECORD.size <= end:
            opcode, length = _RECORD.unpack_from(data, at)
            after = at + _RECORD.size + length
            skipped_to = self._next_chunk(at)
            limit = end if skipped_to is None else skipped_to
            if opcode == CHUNK:
                after = self._end_of_chunk(at, after, limit)
            if opcode == 0 or after > limit:
                if skipped_to is None:
                    if opcode == CHUNK:
                        yield from self._walk_cut_chunk(at)
                    break
                self._leave_out(at, 0, "damaged_record")
                at = skipped_to
            elif opcode == DATA_END and length == 4 and self._data_end in (None, at):
                closed = True
                break
            else:
                yield from self._walk_record(opcode, at, after)
                at = after
        if not closed:
            self._leave_out(at, 0, "truncated")

    def _walk_record(self, opcode: int, at: int, after: int) -> Iterator[Message]:
        body = at + _RECORD.size
        if opcode == CHUNK:
            self._lost_chunk = None
            yield from self._walk_chunk(at, after)
        elif opcode == MESSAGE_INDEX and self._is_message_index(body, after):
            self._count_lost(body)
        elif opcode in (SCHEMA, CHANNEL, MESSAGE):
            messages = self._walk_records(bytes(self.data[at:after]), at)
            if self._sound_outside_chunks:
                yield from messages
            else:
                for message in messages:
                    self._leave_out(at, message.time_ns, "bad_checksum")
        elif opcode < PRIVATE and opcode not in IGNORED and at != len(MAGIC):
            self._leave_out(at, 0, "damaged_record")  # no such record in a data section

    @cached_property
    def _sound_outside_chunks(self) -> bool:
        """Whether the data section holds its checksum, the only one of messages outside chunks."""
        at = self._data_end
        if at is None or _RECORD.unpack_from(self.data, at) != (DATA_END, 4):
            return True  # an unclosed log has none
        (checksum,) = struct.unpack_from("<I", self.data, at + _RECORD.size)
        return checksum in (0, zlib.crc32(self.data[:at]))

    def _walk_chunk(self, at: int, after: int) -> Iterator[Message]:
        start_ns = 0
        try:
            start_ns, size, checksum, compression, body = self._open_chunk(at, after)
            records = decompress(self.data[body:after], compression, size)
            if checksum and zlib.crc32(records) != checksum:
                raise ChunkError("bad_checksum")
        except ChunkError as error:
            self._leave_out(at, start_ns, str(error))
            self._lost_chunk = len(self.damage) - 1
            return
        yield from self._walk_records(records, at, start_ns)

    def _end_of_chunk(self, at: int, after: int, limit: int) -> int:
        """Return where a chunk ends: as its record says, unless only its own length can be."""
        try:
            body = self._open_chunk(at, None)[-1]
        except ChunkError:
            return after
        own = body + struct.unpack_from("<Q", self.data, body - 8)[0]
        return own if own <= limit else after

    def _walk_cut_chunk(self, at: int) -> Iterator[Message]:
        """Yield what the first part of a chunk holds where the file ends in it.

        Its checksum cannot be verified; that it was cut is known, that it is wrong is not.
        """
        try:
            start_ns, size, _, compression, body = self._open_chunk(at, None)
            records = decompress_part(self.data[body:], compression, size)
        except ChunkError:
            return
        yield from self._walk_records(records, at, start_ns, cut=True)

    def _open_chunk(self, at: int, after: int | None) -> tuple[int, int, int, str, int]:
        """Return start time, size, checksum, compression and where the records begin."""
        body, end = at + _RECORD.size, len(self.data) if after is None else after
        try:
            start_ns, _, size, checksum = _CHUNK.unpack_from(self.data, body)
            compression, body = _string(self.data, body + _CHUNK.size, end)
            (length,) = struct.unpack_from("<Q", self.data, body)
        except (struct.error, UnicodeDecodeError) as error:
            raise ChunkError("damaged_chunk") from error
        if after is not None and body + 8 + length != after:
            raise ChunkError("damaged_chunk")
        if size > MAX_CHUNK_BYTES:
            raise ChunkError("chunk_too_large")
        return start_ns, size, checksum, compression, body + 8

    def _walk_records(
        self, records: bytes, offset: int, start_ns: int = 0, cut: bool = False
    ) -> Iterator[Message]:
        """Yield the messages of a chunk's records; `cut`: the last one may be incomplete."""
        at, end = 0, len(records)
        while at < end:
            try:
                opcode, length = _RECORD.unpack_from(records, at)
                after = at + _RECORD.size + length
                if after > end:
                    raise ChunkError("damaged_chunk")
                if opcode == MESSAGE:
                    _, _, number, _, time_ns, _ = _MESSAGE.unpack_from(records, at)
                    channel = self._channel(number)
                    if channel is not None:
                        data = records[at + _MESSAGE.size : after]
                        yield Message(channel, time_ns, offset, data)
                elif opcode in (SCHEMA, CHANNEL):
                    self._declare(opcode, memoryview(records), at + _RECORD.size, after)
            except (struct.error, ChunkError):
                if not cut:
                    self._leave_out(offset, start_ns, "damaged_chunk")
                return
            at = after

    # Schemas and channels

    def _declare(self, opcode: int, data: memoryview, at: int, end: int) -> None:
        try:
            number = struct.unpack_from("<H", data, at)[0]
            if opcode == SCHEMA:
                self._schemas[number] = _string(data, at + 2, end)[0]
            else:
                schema = struct.unpack_from("<H", data, at + 2)[0]
                topic, at = _string(data, at + 4, end)
                self._channels[number] = (topic, _string(data, at, end)[0], schema)
        except UnicodeDecodeError as error:
            raise ChunkError("damaged_chunk") from error
        self._known.clear()

    def _channel(self, number: int) -> Channel | None:
        """Return a message's channel, or None where its messages are not asked for."""
        self._counts[number] = self._counts.get(number, 0) + 1
        if number not in self._known:
            self._known[number] = self._find_channel(number)
        if self._known[number] is None and number not in self._channels:
            self._unknown[number] = self._unknown.get(number, 0) + 1
        return self._known[number]

    def _find_channel(self, number: int) -> Channel | None:
        if number not in self._channels:
            return None
        topic, encoding, schema = self._channels[number]
        name = self._schemas.get(schema, "")
        return Channel(topic, encoding, name) if name in self.wanted else None

    # The summary

    def _read_summary(self) -> None:
        """Take schemas, channels, chunk places and counts from the summary, if it is sound."""
        data, end = self.data, len(self.data)
        at = end - _FOOTER_BYTES
        if at < len(MAGIC) or data[end - len(MAGIC) :] != MAGIC:
            return
        if _RECORD.unpack_from(data, at) != (FOOTER, 20):
            return
        start, _, checksum = struct.unpack_from("<QQI", data, at + _RECORD.size)
        if not len(MAGIC) <= start < at:
            self._data_end = at - _RECORD.size - 4 if start == 0 else None
            return
        if checksum and zlib.crc32(data[start : end - len(MAGIC) - 4]) != checksum:
            return
        self._data_end = start - _RECORD.size - 4
        try:
            self._read_summary_records(start, at)
        except (struct.error, ChunkError):
            self._declared.clear()  # the walk does without
        self._chunk_offsets.sort()

    def _read_summary_records(self, at: int, end: int) -> None:
        while at < end:
            opcode, length = _RECORD.unpack_from(self.data, at)
            body, at = at + _RECORD.size, at + _RECORD.size + length
            if at > end:
                raise ChunkError("damaged_summary")
            if opcode in (SCHEMA, CHANNEL):
                self._declare(opcode, self.data, body, at)
            elif opcode == CHUNK_INDEX:
                offset = struct.unpack_from("<Q", self.data, body + 16)[0]
                if len(MAGIC) <= offset < end:
                    self._chunk_offsets.append(offset)
            elif opcode == STATISTICS:
                (size,) = struct.unpack_from("<I", self.data, body + 42)
                for i in range(body + 46, min(body + 46 + size, at), 10):
                    number, count = struct.unpack_from("<HQ", self.data, i)
                    self._declared[number] = count

    def _next_chunk(self, at: int) -> int | None:
        """Return the first place behind `at` where the summary knows of a chunk."""
        i = bisect_right(self._chunk_offsets, at)
        return self._chunk_offsets[i] if i < len(self._chunk_offsets) else None

    # What is missing

    def _leave_out(self, offset: int, time_ns: int, reason: str, count: int = 1) -> None:
        self.damage.append(Damage(offset, time_ns, reason, count))

    def _is_message_index(self, body: int, after: int) -> bool:
        if after - body < 6:
            return False
        size = struct.unpack_from("<HI", self.data, body)[1]
        return size == after - body - 6 and size % 16 == 0

    def _count_lost(self, body: int) -> None:
        """Count the messages of a chunk that is left out, by an index that follows it."""
        number, size = struct.unpack_from("<HI", self.data, body)
        if self._lost_chunk is None or (self._channels and not self._find_channel(number)):
            return
        self._counts[number] = self._counts.get(number, 0) + size // 16
        index = self._lost_chunk
        self._lost[index] = self._lost.get(index, 0) + size // 16
        self.damage[index] = self.damage[index]._replace(n=max(1, self._lost[index]))

    def _report_missing(self) -> None:
        for number, count in sorted(self._unknown.items()):
            self._leave_out(0, 0, f"unknown_channel_{number}", count)
        declared = {n: c for n, c in self._declared.items() if self._find_channel(n)}
        missing = sum(max(0, c - self._counts.get(n, 0)) for n, c in declared.items())
        if missing:
            self._leave_out(0, 0, "missing_messages", missing)


def _string(data: memoryview, at: int, end: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", data, at)
    if at + 4 + length > end:
        raise ChunkError("damaged_chunk")
    return bytes(data[at + 4 : at + 4 + length]).decode(), at + 4 + length
