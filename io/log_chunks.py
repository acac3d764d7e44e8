"""Chunks of a log: what their heads say, and their records, checked before they are believed."""

import struct
import zlib
from typing import NamedTuple

import numpy as np

from epipole.io.log_bytes import forget
from epipole.io.log_channels import string
from epipole.io.log_compression import ChunkError, decompress, decompress_part
from epipole.io.log_summary import RECORD
from epipole.io.record_scan import RecordIndex, index_records

# A chunk holds a few MiB; one that claims more than this is damage or an attack.
MAX_CHUNK_BYTES = 256 << 20

_HEAD = struct.Struct("<QQQI")


class ChunkHead(NamedTuple):
    """What a chunk says of itself; `body` to `end` are its compressed records in the file."""

    start_ns: int
    end_ns: int
    size: int
    checksum: int
    compression: str
    body: int
    end: int


class OpenedChunk(NamedTuple):
    """A chunk's records and where they lie, or why they are left out."""

    start_ns: int
    records: bytes
    places: RecordIndex
    reason: str = ""


def read_head(data: memoryview, at: int) -> ChunkHead:
    """Return the head of the chunk at `at`.

    Raises
    ------
    ChunkError
        Where it is none.
    """
    body = at + RECORD.size
    try:
        start_ns, end_ns, size, checksum = _HEAD.unpack_from(data, body)
        compression, body = string(data, body + _HEAD.size, len(data))
        (length,) = struct.unpack_from("<Q", data, body)
    except (struct.error, UnicodeDecodeError) as error:
        raise ChunkError("damaged_chunk") from error
    return ChunkHead(start_ns, end_ns, size, checksum, compression, body + 8, body + 8 + length)


def open_chunk(data: memoryview, at: int, after: int) -> OpenedChunk:
    """Return the records of a chunk that lies from `at` to `after`."""
    start_ns = 0
    try:
        head = read_head(data, at)
        if head.end != after:
            raise ChunkError("damaged_chunk")
        start_ns = head.start_ns
        if head.size > MAX_CHUNK_BYTES:
            raise ChunkError("chunk_too_large")
        records = decompress(data[head.body : after], head.compression, head.size)
        forget(data, at, after)
        if head.checksum and zlib.crc32(records) != head.checksum:
            raise ChunkError("bad_checksum")
    except ChunkError as error:
        return _opened(start_ns, b"", str(error))
    return _opened(start_ns, records)


def open_cut_chunk(data: memoryview, at: int) -> OpenedChunk:
    """Return the first records of a chunk in which the file ends.

    Its checksum cannot be verified; that it was cut is known, that it is wrong is not.
    """
    try:
        head = read_head(data, at)
    except ChunkError:
        return _opened(0, b"")
    size = min(head.size, MAX_CHUNK_BYTES)
    return _opened(head.start_ns, decompress_part(data[head.body :], head.compression, size))


def _opened(start_ns: int, records: bytes, reason: str = "") -> OpenedChunk:
    index = index_records(np.frombuffer(records, np.uint8))
    return OpenedChunk(start_ns, records, index, reason)
