"""Chunks of a log: their heads and their records, checked before they are used."""

import struct
import zlib
from typing import NamedTuple

from epipole.io.logs.mcap.channels import string
from epipole.io.logs.mcap.compression import ChunkError, decompress, decompress_part
from epipole.io.logs.mcap.summary import RECORD
from epipole.schemas.rejects import Reason

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
