"""Messages of one kind out of a block of a log: scanned where they are good, else decoded."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np

from epipole.io.logs.left_out import RejectList
from epipole.io.logs.mcap.records import Block
from epipole.io.logs.messages.encoding import (
    FIELD_TYPES,
    MessageEncoding,
    UndecodableError,
    no_fields,
)
from epipole.io.logs.messages.registry import message_encodings
from epipole.io.logs.messages.scan import Messages
from epipole.schemas.arrays import Indices
from epipole.schemas.log_bounds import TIME
from epipole.schemas.log_messages import CALIBRATION, FRAME, SENSOR_ID_PATTERN, STATE
from epipole.schemas.rejects import Reason

SENSOR_ID = re.compile(SENSOR_ID_PATTERN)
MAX_AT_ONCE = 4096  # messages decoded one at a time before the scan is tried again
BATCH_MESSAGES = 8192  # so that the located fields of a batch stay small
UNDECODABLE = {
    FRAME: Reason.UNDECODABLE_FRAME,
    STATE: Reason.UNDECODABLE_STATE,
    CALIBRATION: Reason.UNDECODABLE_CALIBRATION,
}


@lru_cache(maxsize=4096)
def valid_sensor_id(sensor_id: str) -> bool:
    """Return whether a sensor id is valid; it names folders, so it must not lead out of them."""
    return SENSOR_ID.fullmatch(sensor_id) is not None


def fault(time_ns: int | None, sensor_id: str) -> Reason | None:
    """Return why a message with this time and sensor cannot be used, or None if it can."""
    if not valid_sensor_id(sensor_id):
        return Reason.BAD_SENSOR_ID
    return TIME.reason if time_ns is None or time_ns not in TIME else None


def known_id(sensor_id: str) -> str | None:
    """Return a sensor id, or None if it is invalid."""
    return sensor_id if valid_sensor_id(sensor_id) else None


class Received(NamedTuple):
    """A decoded message, its offset in the log, and when it was logged."""

    message: Any
    offset: int
    log_time_ns: int


def batches_of(
    block: Block, kind: str, chosen: Indices, rejects: RejectList
) -> "Iterator[MessageBatch]":
    """Yield the chosen messages of a block, which are all of one kind, in batches."""
    for first in range(0, len(chosen), BATCH_MESSAGES):
        yield MessageBatch(block, kind, chosen[first : first + BATCH_MESSAGES], rejects)


@dataclass
class MessageBatch:
    """Messages of one kind in a block."""

    block: Block
    kind: str  # FRAME, STATE or CALIBRATION
    chosen: Indices  # which of the block's messages
    rejects: RejectList

    def __len__(self) -> int:
        return len(self.chosen)

    @property
    def n_bytes(self) -> int:
        """The length of all messages together."""
        return int((self.block.end[self.chosen] - self.block.start[self.chosen]).sum())

    @cached_property
    def offset(self) -> Indices:
        """The offset in the log of each message."""
        return self.block.offset[self.chosen]

    @cached_property
    def messages(self) -> Messages:
        """The messages as the scans take them: those of encodings that locate fields are located.

        Frames and states only: there is no scan of calibrations.
        """
        b, fields = self.block, no_fields(self.kind, len(self))
        start, end, channel = b.start[self.chosen], b.end[self.chosen], b.channel[self.chosen]
        for encoding in {e.message_encoding: e for e in self._encodings.values()}.values():
            if encoding.locate is not None:
                of_encoding = np.zeros(max(b.channels) + 1, bool)
                of_encoding[[n for n, e in self._encodings.items() if e == encoding]] = True
                mine = of_encoding[channel]
                encoding.locate(b.data, start, end, mine, FIELD_TYPES[self.kind], fields)
        return Messages(b.data, channel, fields)

    @cached_property
    def _encodings(self) -> dict[int, MessageEncoding]:
        """The encoding of each channel, by its number."""
        known = message_encodings()
        return {n: known[channel.encoding] for n, channel in self.block.channels.items()}

    def take(self, scan: Callable[[int], int], judge: Callable[[list[Received]], None]) -> None:
        """Take every message in order.

        `scan` takes messages from one number on and returns the number that it stopped at.
        `judge` takes decoded messages. Where the scan stops at once, twice as many messages as
        before are decoded until it is tried again: a log that no scan can read loses no time.
        """
        i, at_once = 0, 1
        while i < len(self):
            stopped = scan(i)
            at_once = 1 if stopped > i else min(2 * at_once, MAX_AT_ONCE)
            i = min(stopped + at_once, len(self))
            if stopped < i:
                judge(list(self.decoded(stopped, i)))

    def decoded(self, first: int, last: int) -> Iterator[Received]:
        """Yield the messages from `first` to before `last`; undecodable ones become rejects.

        Equal messages in a row are decoded once: half a million empty ones fit into 1 kB.
        """
        b, before = self.block, (-1, b"")
        message: Any = None
        for i in self.chosen[first:last].tolist():
            number, data = int(b.channel[i]), b.data[b.start[i] : b.end[i]].tobytes()
            offset, time_ns = int(b.offset[i]), int(b.time_ns[i])
            try:
                if (number, data) != before:
                    message = self._encodings[number].decoded(self.kind, data)
                    before = number, data
            except UndecodableError:
                self.rejects.add(UNDECODABLE[self.kind], time_ns=time_ns, offset=offset)
                continue
            yield Received(message, offset, time_ns)
