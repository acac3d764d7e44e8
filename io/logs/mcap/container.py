"""The parts of an MCAP file beside its messages: chunks, declarations of channels, the summary.

All of them are checked before they are used: sizes, checksums, bounds. A part that cannot be used
raises `ChunkError` with the reason.
"""

import contextlib
import struct
import zlib
from array import array
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

import lz4.frame
import numpy as np
import zstandard

from epipole.io.logs.mcap.bytes import LogBytes
from epipole.io.logs.mcap.record_scan import (
    CHANNEL,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    OF_SUMMARY,
    PRIVATE,
    SCHEMA,
    STATISTICS,
)
from epipole.schemas.rejects import Reason

# Decompression, never to more bytes than the chunk declares.


class ChunkError(Exception):
    """A chunk, or a record in it, that cannot be used."""

    def __init__(self, reason: Reason) -> None:
        super().__init__(reason.value)
        self.reason = reason


def decompress(data: memoryview, compression: str, size: int) -> bytes:
    """Return the records of a chunk, decompressed to `size` bytes.

    Raises
    ------
    ChunkError
        Unknown compression (which names it), corrupt bytes, another size than declared.
    """
    try:
        if compression == "zstd":
            # Checked first: the decoder allocates the size that the frame declares, without limit.
            if zstandard.frame_content_size(data) not in (-1, size):
                raise ChunkError(Reason.WRONG_CHUNK_SIZE)
            records = zstandard.ZstdDecompressor().decompress(data, max_output_size=max(size, 1))
        elif compression == "lz4":
            records = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
        elif compression == "":
            records = bytes(data)
        else:
            raise ChunkError(Reason.UNKNOWN_COMPRESSION)
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
        raise ChunkError(Reason.BAD_COMPRESSION) from error
    if len(records) != size:
        raise ChunkError(Reason.WRONG_CHUNK_SIZE)
    return records


def decompress_part(data: memoryview, compression: str, size: int) -> bytes:
    """Return the first bytes of a chunk whose end is missing, at most `size` of them."""
    try:
        if compression == "zstd":
            reader = zstandard.ZstdDecompressor().stream_reader(data)
            pieces = []
            while size > 0 and (piece := reader.read(min(size, 1 << 20))):
                pieces.append(piece)
                size -= len(piece)
            return b"".join(pieces)
        if compression == "lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size))
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError):
        return b""
    return bytes(data[:size]) if compression == "" else b""


# Schemas and channels, as records and the summary declare them.


class Channel(NamedTuple):
    """A channel: its topic, the encoding of its messages and the name of their schema."""

    topic: str
    encoding: str
    schema: str


@dataclass
class ChannelTable:
    """Channels by number, as the records up to here declare them; else as the summary does.

    MCAP wants two declarations of one number to be equal. Where they are not, the later one
    counts, unless it would hide messages that are wanted.
    """

    wanted: frozenset[str]  # names of the schemas whose messages are wanted
    summary: Self | None = None  # what the summary of the log declares
    _schemas: dict[int, str] = field(default_factory=dict)
    _channels: dict[int, tuple[str, str, int]] = field(default_factory=dict)
    _known: dict[int, Channel | None] = field(default_factory=dict)

    def declare(self, opcode: int, data: Any, at: int, end: int) -> None:
        """Read the body of a schema or channel record.

        Raises
        ------
        ChunkError
            Where the body is invalid, or contradicts a declaration of wanted messages.
        """
        try:
            (number,) = struct.unpack_from("<H", data, at)
            if opcode == SCHEMA:
                self._declare_schema(number, string(data, at + 2, end)[0])
            else:
                (schema,) = struct.unpack_from("<H", data, at + 2)
                topic, at = string(data, at + 4, end)
                self._declare_channel(number, topic, string(data, at, end)[0], schema)
        except (struct.error, UnicodeDecodeError) as error:
            raise ChunkError(Reason.DAMAGED_RECORD) from error
        self._known.clear()

    def _declare_schema(self, number: int, name: str) -> None:
        if name not in self.wanted and self._schemas.get(number) in self.wanted:
            raise ChunkError(Reason.DAMAGED_RECORD)
        if number:  # MCAP: a schema of the number zero is to be ignored
            self._schemas[number] = name

    def _declare_channel(self, number: int, topic: str, encoding: str, schema: int) -> None:
        known = self.find(number)
        # The summary is that of the last log in the file: an equal topic says that it is about
        # this channel.
        if (
            known is not None
            and self._name(schema) not in self.wanted
            and (number in self._channels or known[:2] == (topic, encoding))
        ):
            raise ChunkError(Reason.DAMAGED_RECORD)
        self._channels[number] = (topic, encoding, schema)

    def find(self, number: int) -> Channel | None:
        """Return a channel, or None where it is unknown or its messages are not wanted."""
        if number not in self._known:
            self._known[number] = self._find(number)
        return self._known[number]

    def _find(self, number: int) -> Channel | None:
        in_summary = None if self.summary is None else self.summary.find(number)
        if number not in self._channels:
            return in_summary
        topic, encoding, schema = self._channels[number]
        name = self._name(schema)
        return Channel(topic, encoding, name) if name in self.wanted else None

    def _name(self, schema: int) -> str | None:
        """Return the name of a schema, "" for the number zero, and None where it is missing."""
        if schema == 0 or schema in self._schemas:
            return self._schemas.get(schema, "")
        return None if self.summary is None else self.summary._name(schema)

    def missing(self, number: int) -> Reason | None:
        """Return which declaration of a channel is missing; None where it is complete."""
        if number in self._channels:
            schema = self._channels[number][2]
            return Reason.UNKNOWN_SCHEMA if self._name(schema) is None else None
        return Reason.UNKNOWN_CHANNEL if self.summary is None else self.summary.missing(number)

    def forget(self) -> None:
        """Forget what the records up to here declare: another log follows."""
        self._schemas, self._channels, self._known = {}, {}, {}


def string(data: Any, at: int, end: int) -> tuple[str, int]:
    """Return an MCAP string and the offset after it; raise ChunkError where it passes `end`."""
    (length,) = struct.unpack_from("<I", data, at)
    if at + 4 + length > end:
        raise ChunkError(Reason.DAMAGED_CHUNK)
    return bytes(data[at + 4 : at + 4 + length]).decode(), at + 4 + length


# The summary: channels, chunks, and the number of messages.

MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")  # opcode, length
DATA_END_BYTES = RECORD.size + 4
_FOOTER_BYTES = RECORD.size + 20 + len(MAGIC)
_COUNT = struct.Struct("<HQ")  # channel, its messages
# The index of a chunk takes about 100 bytes. A summary that declares more than this is invalid.
MAX_SUMMARY_BYTES = 256 << 20


@dataclass
class LogSummary:
    """What a summary declares; it may be incomplete."""

    data_end: int | None = None  # where the data section ends, if the log was closed
    chunk_offsets: "array[int]" = field(default_factory=lambda: array("Q"))  # sorted
    # When the messages of each chunk were logged [ns]: the first and the last, one after the other.
    chunk_times: "array[int]" = field(default_factory=lambda: array("Q"))
    declared: dict[int, int] = field(default_factory=dict)  # messages of each channel
    logged_ns: tuple[int, int] | None = None  # when the first and the last message were logged


def read_summary(data: LogBytes, channels: ChannelTable) -> LogSummary:
    """Return the summary, and declare its channels; an invalid summary is empty."""
    end = len(data)
    at = end - _FOOTER_BYTES
    if at < len(MAGIC):
        return LogSummary()
    footer = data.view(at, end)
    if footer[-len(MAGIC) :] != MAGIC or RECORD.unpack_from(footer) != (FOOTER, 20):
        return LogSummary()
    start, _, checksum = struct.unpack_from("<QQI", footer, RECORD.size)
    data_end = (start or at) - DATA_END_BYTES
    if not max(len(MAGIC), at - MAX_SUMMARY_BYTES) <= data_end < at:
        return LogSummary()
    tail = data.view(data_end, end)
    if RECORD.unpack_from(tail) != (DATA_END, 4):
        return LogSummary()
    records = tail[DATA_END_BYTES : at - data_end]
    covered = tail[DATA_END_BYTES : len(tail) - len(MAGIC) - 4]
    if checksum and zlib.crc32(covered) != checksum:
        return LogSummary()
    summary = LogSummary(data_end)
    try:
        _read_records(records, at, summary, channels)
    except (struct.error, ChunkError):
        return LogSummary()  # the records are found without it
    offsets, times_ns = np.array(summary.chunk_offsets), np.array(summary.chunk_times)
    order = np.argsort(offsets, kind="stable")
    summary.chunk_offsets = array("Q", offsets[order].tobytes())
    summary.chunk_times = array("Q", times_ns.reshape(-1, 2)[order].tobytes())
    return summary


def _read_records(
    data: memoryview, file_end: int, summary: LogSummary, channels: ChannelTable
) -> None:
    at = 0
    while at < len(data):
        opcode, length = RECORD.unpack_from(data, at)
        body, at = at + RECORD.size, at + RECORD.size + length
        if at > len(data) or _is_foreign(opcode):
            raise ChunkError(Reason.DAMAGED_RECORD)  # or `start` belongs to another log
        if opcode in (SCHEMA, CHANNEL):
            with contextlib.suppress(ChunkError):  # the rest of the summary is of use without it
                channels.declare(opcode, data, body, at)
        elif opcode == CHUNK_INDEX:
            *times_ns, offset = struct.unpack_from("<QQQ", data, body)
            if len(MAGIC) <= offset < file_end:
                summary.chunk_offsets.append(offset)
                summary.chunk_times.extend(times_ns)
        elif opcode == STATISTICS:
            *logged_ns, size = struct.unpack_from("<QQI", data, body + 26)
            summary.logged_ns = (logged_ns[0], logged_ns[1])
            counts = data[body + 46 : min(body + 46 + size, at)]
            whole = counts[: len(counts) // _COUNT.size * _COUNT.size]
            summary.declared.update(_COUNT.iter_unpack(whole))


def end_of_log(data: LogBytes, at: int) -> int | None:
    """Return where the log ends whose summary begins at `at`.

    This is behind the magic bytes that follow its footer; beyond the end of the file where that
    is cut. None where other records than those of a summary follow.
    """
    while at + RECORD.size <= len(data):
        opcode, length = RECORD.unpack(data.view(at, at + RECORD.size))
        at += RECORD.size + length
        if opcode == FOOTER:
            return at + len(MAGIC)
        if _is_foreign(opcode):
            return None
    return at + RECORD.size


def _is_foreign(opcode: int) -> bool:
    """Return whether a record does not belong into a summary."""
    return opcode not in OF_SUMMARY and opcode < PRIVATE


# Chunks: heads and records.

# A chunk has a few MiB. A chunk that declares more than this is damaged or an attack.
MAX_CHUNK_BYTES = 256 << 20

# Limit of its record in the file: compression enlarges random bytes a little.
MAX_RECORD_BYTES = MAX_CHUNK_BYTES + (4 << 20)
HEAD_BYTES = 256  # of the beginning of a chunk record; its head is shorter

_HEAD = struct.Struct("<QQQI")


class ChunkHead(NamedTuple):
    """The head of a chunk; its compressed records lie from `body` to `end` in the file."""

    start_ns: int
    end_ns: int
    size: int
    checksum: int
    compression: str
    body: int
    end: int


class OpenedChunk(NamedTuple):
    """The records of a chunk, or the reason for leaving them out."""

    start_ns: int
    records: bytes | memoryview = b""
    reason: Reason | None = None
    is_checked: bool = False  # by a checksum


def read_head(data: memoryview, at: int) -> ChunkHead:
    """Return the head of the chunk at `at`, of which `data` are the first bytes.

    Raises
    ------
    ChunkError
        Where the head is invalid.
    """
    try:
        start_ns, end_ns, size, checksum = _HEAD.unpack_from(data, RECORD.size)
        compression, body = string(data, RECORD.size + _HEAD.size, len(data))
        (length,) = struct.unpack_from("<Q", data, body)
    except (struct.error, UnicodeDecodeError) as error:
        raise ChunkError(Reason.DAMAGED_CHUNK) from error
    body += at + 8
    return ChunkHead(start_ns, end_ns, size, checksum, compression, body, body + length)


def open_chunk(chunk: memoryview) -> OpenedChunk:
    """Return the records of a complete chunk."""
    start_ns = 0
    try:
        head = read_head(chunk, 0)
        if head.end != len(chunk):
            raise ChunkError(Reason.DAMAGED_CHUNK)
        start_ns = head.start_ns
        if head.size > MAX_CHUNK_BYTES:
            raise ChunkError(Reason.CHUNK_TOO_LARGE)
        records = decompress(chunk[head.body :], head.compression, head.size)
        if head.checksum and zlib.crc32(records) != head.checksum:
            raise ChunkError(Reason.BAD_CHECKSUM)
    except ChunkError as error:
        return OpenedChunk(start_ns, b"", error.reason)
    return OpenedChunk(start_ns, records, is_checked=head.checksum != 0)


def open_cut_chunk(chunk: memoryview) -> OpenedChunk:
    """Return the first records of a chunk that the end of the file cuts.

    Its checksum cannot be verified, so the records are used without.
    """
    try:
        head = read_head(chunk, 0)
    except ChunkError:
        return OpenedChunk(0)
    size = min(head.size, MAX_CHUNK_BYTES)
    return OpenedChunk(head.start_ns, decompress_part(chunk[head.body :], head.compression, size))
