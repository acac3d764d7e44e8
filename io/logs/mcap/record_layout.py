"""The segments of an MCAP file: where its records are, found by their lengths, even if damaged.

The data section is walked from its start. Where a length is damaged, the walk continues at the next
chunk that the summary lists, if there is one: the summary may be damaged too. Records may be longer
than their fields; what is behind the fields is skipped.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.io.logs.mcap.bytes import NEAR_BYTES, LogBytes
from epipole.io.logs.mcap.container import (
    DATA_END_BYTES,
    HEAD_BYTES,
    MAGIC,
    MAX_RECORD_BYTES,
    RECORD,
    ChunkError,
    ChunkHead,
    LogSummary,
    end_of_log,
    read_head,
)
from epipole.io.logs.mcap.record_scan import (
    ATTACHMENT,
    CHANNEL,
    CHUNK,
    DATA_END,
    HEADER,
    MESSAGE,
    MESSAGE_INDEX,
    METADATA,
    PRIVATE,
    SCHEMA,
    index_counts,
    length_outside,
)
from epipole.schemas.arrays import Integers
from epipole.schemas.rejects import Reason

RUN = -1  # the opcode of a segment with many records outside chunks
RUN_BYTES = 4 << 20  # of records outside chunks that are walked at once
# How many are tried first: chunks and other records may take turns, and what is read for a run is
# read again behind it.
MIN_RUN_BYTES = NEAR_BYTES // 4


class Segment(NamedTuple):
    """A part of the data section: a record, a run of records, or damage with a reason."""

    opcode: int
    at: int
    after: int
    reason: Reason | None = None
    data: memoryview = memoryview(b"")  # of a chunk that is to be opened, or of a run
    size: int = 0  # of its records in memory, in bytes
    cut: bool = False  # whether the file ends in this chunk
    # Of message indexes: channels, and how many messages of each.
    counted: tuple[npt.NDArray[np.uint16], Integers] | None = None


@dataclass
class LogSegments:
    """The segments in the data section of one log, in the order of the file."""

    data: LogBytes
    summary: LogSummary
    _next_listed: int = 0  # the first chunk that the summary lists and the walk has not passed
    _run_bytes: int = MIN_RUN_BYTES

    def __iter__(self) -> Iterator[Segment]:
        data, end, at = self.data, len(self.data), len(MAGIC)
        self._next_listed = 0
        while at + RECORD.size <= end:
            opcode, length = RECORD.unpack(data.view(at, at + RECORD.size))
            after = at + RECORD.size + length
            head = self._head(at) if opcode == CHUNK else None
            skipped_to = self._next_chunk(at, after if head is None else max(after, head.end))
            limit = end if skipped_to is None else skipped_to
            if head is not None and head.end <= limit and not self._is_padded(head, after, limit):
                after = head.end  # the length in the chunk counts, not that of its record
            if opcode == 0 or after > limit:
                if skipped_to is None:
                    if opcode == CHUNK:
                        cut = data.view(at, min(end, at + MAX_RECORD_BYTES))
                        size = 0 if head is None else head.size
                        yield Segment(CHUNK, at, end, data=cut, size=size, cut=True)
                    break
                yield Segment(opcode, at, skipped_to, Reason.DAMAGED_RECORD)
                at = skipped_to
            elif opcode == DATA_END and (behind := self._behind(at, after)) is not None:
                yield Segment(
                    DATA_END, at, after, data=data.view(at, min(after, at + DATA_END_BYTES))
                )
                if behind.reason is not None:
                    yield behind
                if behind.reason != Reason.LOG_BEHIND_LOG:
                    return
                at = behind.after
            else:
                segment = self._segment(opcode, at, after, limit, head)
                yield segment
                at = segment.after
        yield Segment(0, at, end, Reason.TRUNCATED)

    def _segment(
        self, opcode: int, at: int, after: int, limit: int, head: ChunkHead | None
    ) -> Segment:
        """Return the record from `at` to `after`; mostly together with those that follow."""
        if opcode == CHUNK:
            if after - at > MAX_RECORD_BYTES:
                return Segment(CHUNK, at, after, Reason.CHUNK_TOO_LARGE)
            size, chunk_end = (0, after) if head is None else (head.size, min(head.end, after))
            return Segment(CHUNK, at, after, None, self.data.view(at, chunk_end), size)
        if opcode == MESSAGE_INDEX:
            window = self.data.view(at, min(at + MIN_RUN_BYTES, limit))
            *counted, walked = index_counts(np.frombuffer(window, np.uint8), limit - at)
            if walked:
                return Segment(opcode, at, at + walked, counted=(counted[0], counted[1]))
        if opcode == HEADER and self.data.view(at - len(MAGIC), at) == MAGIC:
            return Segment(opcode, at, after)
        return self._run(opcode, at, after, limit)

    def _run(self, opcode: int, at: int, after: int, limit: int) -> Segment:
        """Return the record from `at` to `after`, and those that follow to a chunk or its index."""
        if after - at <= self._run_bytes or (
            opcode in (SCHEMA, CHANNEL, MESSAGE) and after - at <= MAX_RECORD_BYTES
        ):
            window = self.data.view(at, min(max(after, at + self._run_bytes), limit))
            walked = length_outside(np.frombuffer(window, np.uint8))
            is_long = walked > self._run_bytes // 2
            self._run_bytes = min(4 * self._run_bytes, RUN_BYTES) if is_long else MIN_RUN_BYTES
            if walked:
                return Segment(RUN, at, at + walked, None, window[:walked], walked)
        is_skipped = opcode >= PRIVATE or opcode in (ATTACHMENT, METADATA)
        return Segment(opcode, at, after, None if is_skipped else Reason.DAMAGED_RECORD)

    def _behind(self, at: int, after: int) -> Segment | None:
        """Return what lies behind the log that a record at `at` ends; None where it ends none."""
        size = len(self.data)
        if at == self.summary.data_end:
            return Segment(0, size, size)
        end = end_of_log(self.data, after)
        if end is None:
            return None
        begins = end + len(MAGIC)
        if begins <= size and self.data.view(end, begins) == MAGIC:
            return Segment(0, end, begins, Reason.LOG_BEHIND_LOG)
        if self.summary.data_end is not None:
            return None
        if end == size:
            return Segment(0, size, size)
        reason = Reason.TRUNCATED if end > size else Reason.DAMAGED_RECORD
        return Segment(0, min(end, size), size, reason)

    def _next_chunk(self, at: int, after: int) -> int | None:
        """Return the first offset after `at` where the summary lists a chunk.

        One within the record from `at` to `after` counts only if a chunk begins there.
        """
        offsets, i = self.summary.chunk_offsets, self._next_listed
        # Each is looked at once: one that begins no chunk is not asked about again.
        while i < len(offsets) and not (
            offsets[i] >= after or (offsets[i] > at and self._begins_chunk(offsets[i]))
        ):
            i += 1
        self._next_listed = i
        return offsets[i] if i < len(offsets) else None

    def _begins_chunk(self, at: int) -> bool:
        if at + RECORD.size > len(self.data):
            return False
        opcode, length = RECORD.unpack(self.data.view(at, at + RECORD.size))
        head = self._head(at) if opcode == CHUNK else None
        # Either length may be damaged, but not both: then nothing says that this is a chunk.
        return head is not None and (
            head.end <= len(self.data) or at + RECORD.size + length <= len(self.data)
        )

    def _is_padded(self, head: ChunkHead, after: int, limit: int) -> bool:
        """Return whether a chunk's record is longer than its fields, and a record follows it."""
        return (
            head.end < after <= limit
            and self._begins_record(after, limit)
            and not self._begins_record(head.end, limit)
        )

    def _begins_record(self, at: int, limit: int) -> bool:
        if at + RECORD.size > limit:
            return at == limit
        opcode, length = RECORD.unpack(self.data.view(at, at + RECORD.size))
        return opcode != 0 and at + RECORD.size + length <= len(self.data)

    def _head(self, at: int) -> ChunkHead | None:
        try:
            return read_head(self.data.view(at, min(at + HEAD_BYTES, len(self.data))), at)
        except ChunkError:
            return None
