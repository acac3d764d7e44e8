"""When a log's messages were logged, and the digest of its bytes up to a time.

Both come from the log's summary, without reading messages. A log that was never closed has no
summary: it is still being written, or its recorder was stopped. Then, and where a summary has no
statistics, they come from the heads of its chunks.
"""

import hashlib
import os
from collections.abc import Iterator
from typing import NamedTuple

from epipole.io.logs.mcap.bytes import NEAR_BYTES, LogBytes, open_log
from epipole.io.logs.mcap.container import (
    HEAD_BYTES,
    MAGIC,
    MAX_RECORD_BYTES,
    RECORD,
    ChannelTable,
    ChunkError,
    read_head,
    read_summary,
)
from epipole.io.logs.mcap.record_scan import CHUNK, DATA_END, MESSAGE
from epipole.schemas.errors import LogError
from epipole.schemas.rejects import Reason

# Maximum number of records of an unclosed log: in a log without chunks, each message is one.
MAX_RECORDS = 50_000
HASHED_BYTES = 1 << 20  # at once


class ChunkTimes(NamedTuple):
    """Where a chunk begins in the file, and when its messages were logged [ns]."""

    at: int
    start_ns: int
    end_ns: int


def open_mcap(where: str) -> LogBytes:
    """Return the bytes of a log.

    Raises
    ------
    LogError
        Where there is no such file, or it is a folder or not MCAP.
    """
    data = open_log(where)
    if len(data) < len(MAGIC) or data.view(0, len(MAGIC)) != MAGIC:
        data.close()
        raise LogError(f"{where}: not an MCAP file; give a log as MCAP (https://mcap.dev)")
    return data


def read_log_times(path: str | os.PathLike[str]) -> tuple[int, int] | None:
    """Return when a log's first and last message were logged, without reading them.

    UTC nanoseconds since 1970, of the recorder's clock: not the times of frames. None if neither
    summary nor chunks have them: then the log has to be read.

    Raises
    ------
    LogError
        As `open_mcap`.
    """
    with open_mcap(os.fspath(path)) as data:
        summary = read_summary(data, ChannelTable(frozenset()))
        if summary.logged_ns is not None:
            return summary.logged_ns if summary.logged_ns != (0, 0) else None  # no messages
        try:
            chunks = list(_walk_chunks(data))
        except ChunkError:
            return None
    times = [t for chunk in chunks for t in chunk[1:] if t]  # a chunk without messages has zeros
    return (min(times), max(times)) if times else None


class ReadBytes(NamedTuple):
    """What a run has read of a log: all its bytes at that time."""

    sha256: str
    size: int


def read_digest(path: str, until_ns: int, read: ReadBytes | None = None) -> str:
    """Return the SHA-256 of a log; if the log goes on after `until_ns`, of its bytes before that.

    They end at the first chunk whose messages were all logged at `until_ns` or later. So the digest
    is the same while the log is still being written.

    Parameters
    ----------
    read
        What a run has read of it. The log may have grown since. If it grew by messages from before
        `until_ns`, the digest is that of what was read: so the next run sees a change.
    """
    with open_mcap(path) as data:
        try:
            chunks = list(_chunks(data))
        except ChunkError:
            chunks = []
        after = [chunk.at for chunk in chunks if chunk.start_ns >= until_ns]
        if read is not None and (not after or min(after) > read.size):
            return read.sha256
        if not after:
            return data.sha256()
        digest = hashlib.sha256()
        for at in range(0, min(after), HASHED_BYTES):
            digest.update(data.view(at, min(at + HASHED_BYTES, *after)))
        return digest.hexdigest()


def _chunks(data: LogBytes) -> Iterator[ChunkTimes]:
    """Yield the chunks of a log, by its summary where it has one."""
    summary = read_summary(data, ChannelTable(frozenset()))
    if summary.data_end is None:
        yield from _walk_chunks(data)
    times_ns = iter(summary.chunk_times)
    yield from map(ChunkTimes, summary.chunk_offsets, times_ns, times_ns)


def _walk_chunks(data: LogBytes) -> Iterator[ChunkTimes]:
    """Yield the chunks of a log from record to record; the last one may be incomplete.

    Raises
    ------
    ChunkError
        If records outside chunks are damaged, or are messages: then chunks do not have all times.
    """
    at = len(MAGIC)
    near_at, near = 0, memoryview(b"")  # records that follow: of a URL each read is a request
    for _ in range(MAX_RECORDS):
        if at + RECORD.size > len(data):
            return
        if near_at + len(near) < min(at + HEAD_BYTES, len(data)):
            near_at, near = at, data.view(at, min(at + NEAR_BYTES, len(data)))
        record = near[at - near_at :]
        opcode, length = RECORD.unpack_from(record)
        if opcode == CHUNK:
            if len(data) - at < HEAD_BYTES:  # cut
                return
            head = read_head(record[:HEAD_BYTES], at)
            yield ChunkTimes(at, head.start_ns, head.end_ns)
        elif opcode == MESSAGE or not 0 < opcode <= DATA_END or length > MAX_RECORD_BYTES:
            break
        at += RECORD.size + length
    raise ChunkError(Reason.DAMAGED_RECORD)
