"""A log taken apart into its records, and put together again: the harness's own MCAP."""

import struct
import zlib
from typing import NamedTuple

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = range(1, 8)
CHUNK_INDEX, STATISTICS, DATA_END = 0x08, 0x0B, 0x0F
FOOTER_BYTES = HEAD.size + 20 + len(MAGIC)
CRC_BYTES = 4 + len(MAGIC)  # at the end of a log: the summary's checksum and what follows it


class Record(NamedTuple):
    """A record: its opcode and its body."""

    opcode: int
    body: bytes

    @property
    def data(self) -> bytes:
        """The record as it stands in a file."""
        return HEAD.pack(self.opcode, len(self.body)) + self.body


def records_of(log: bytes) -> list[Record]:
    """Return the records of a sound log, from the header to the footer."""
    return records_in(log[len(MAGIC) : -len(MAGIC)])


def records_in(data: bytes) -> list[Record]:
    """Return the records in sound bytes, such as those of a chunk."""
    records, at = [], 0
    while at < len(data):
        opcode, length = HEAD.unpack_from(data, at)
        at += HEAD.size + length
        records.append(Record(opcode, data[at - length : at]))
    return records


def data_end(log: bytes) -> Record:
    """Return the record that ends the data section of a sound log."""
    return next(record for record in records_of(log) if record.opcode == DATA_END)


def split(records: list[Record]) -> tuple[list[Record], list[Record]]:
    """Return the data section with its end, and the summary with the footer."""
    end = 1 + next(i for i, record in enumerate(records) if record.opcode == DATA_END)
    return records[:end], records[end:]


def joined(data: list[Record], summary: list[Record], remade: bool = True) -> bytes:
    """Return a log of records.

    Where `remade`, the footer tells where the summary begins now, and its checksum is right.
    """
    log = MAGIC + b"".join(record.data for record in data)
    start = len(log)
    log += b"".join(record.data for record in summary) + MAGIC
    return with_footer(log, start) if remade else log


def with_footer(log: bytes, start: int) -> bytes:
    """Return a log whose footer says that the summary begins at `start`.

    The summary's checksum is made anew, where the log has one.
    """
    at = len(log) - FOOTER_BYTES
    if at < start or HEAD.unpack_from(log, at) != (FOOTER, 20):
        return log
    start_before, offsets, crc = struct.unpack_from("<QQI", log, at + HEAD.size)
    if start < at and offsets:
        offsets = (offsets - start_before + start) % (1 << 64)
    fields = HEAD.pack(FOOTER, 20) + struct.pack("<QQ", start if start < at else 0, offsets)
    if crc:
        crc = zlib.crc32(log[start:at] + fields)
    return log[:at] + fields + struct.pack("<I", crc) + MAGIC


def summary_start(log: bytes) -> int:
    """Return where the summary of a sound log begins; without one, where the footer does."""
    at = len(log) - FOOTER_BYTES
    return int(struct.unpack_from("<Q", log, at + HEAD.size)[0]) or at


def counts_of(log: bytes) -> dict[int, int] | None:
    """Return the messages per channel that a valid summary counts; None where there is none."""
    try:
        return _counts_of(log)
    except struct.error:
        return None


def _counts_of(log: bytes) -> dict[int, int] | None:
    at = len(log) - FOOTER_BYTES
    if at < len(MAGIC) or log[-len(MAGIC) :] != MAGIC or HEAD.unpack_from(log, at) != (FOOTER, 20):
        return None
    start, _, crc = struct.unpack_from("<QQI", log, at + HEAD.size)
    if not len(MAGIC) + HEAD.size + 4 <= start < at:
        return None
    if HEAD.unpack_from(log, start - HEAD.size - 4) != (DATA_END, 4):
        return None
    if crc and zlib.crc32(log[start:-CRC_BYTES]) != crc:
        return None
    found: dict[int, int] = {}
    while start < at:
        opcode, length = HEAD.unpack_from(log, start)
        start += HEAD.size + length
        if start > at:
            return None
        if opcode == STATISTICS:
            found |= _counts(log[start - length : start])
    return found or None


def _counts(statistics: bytes) -> dict[int, int]:
    (size,) = struct.unpack_from("<I", statistics, 42)
    pairs = range(46, 46 + size, 10)
    return dict(struct.unpack_from("<HQ", statistics, at) for at in pairs)
