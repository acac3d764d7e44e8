"""The summary at the end of a log: its channels, its chunks and how many messages it has."""

import contextlib
import struct
import zlib
from array import array
from dataclasses import dataclass, field

import numpy as np

from epipole.io.logs.mcap.bytes import LogBytes
from epipole.io.logs.mcap.channels import ChannelTable
from epipole.io.logs.mcap.compression import ChunkError
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
    summary.chunk_offsets = array("Q", np.sort(summary.chunk_offsets).tobytes())
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
            offset = struct.unpack_from("<Q", data, body + 16)[0]
            if len(MAGIC) <= offset < file_end:
                summary.chunk_offsets.append(offset)
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
