"""The messages of one kind in a block of a log: scanned where they are good, else decoded."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.io.logs.damage import RejectList
from epipole.io.logs.mcap.records import Block
from epipole.io.logs.messages.decoding import Record, UndecodableError, decoder
from epipole.io.logs.messages.scan import Messages
from epipole.io.logs.messages.wire import CDR, OTHER, PROTOBUF

SENSOR_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,62}")
MOST_AT_ONCE = 4096  # messages decoded one by one before the scan is tried again
_SCANNED = {"protobuf": PROTOBUF, "cdr": CDR}


@lru_cache(maxsize=4096)
def valid_sensor_id(sensor_id: str) -> bool:
    """Return whether an id is one: it names folders, so it must not leave them."""
    return SENSOR_ID.fullmatch(sensor_id) is not None


def fault(time_ns: int | None, sensor_id: str) -> str | None:
    """Return why no message with this time and sensor can be used, if so."""
    if not valid_sensor_id(sensor_id):
        return "bad_sensor_id"
    return "no_timestamp" if time_ns is None else None


def known_id(sensor_id: str) -> str | None:
    """Return a sensor id, or None for what is none."""
    return sensor_id if valid_sensor_id(sensor_id) else None


class Received(NamedTuple):
    """A decoded message, where it lay and when it was logged."""

    record: Any
    offset: int
    log_time_ns: int


@dataclass
class Part:
    """The messages of one kind in a block."""

    block: Block
    carries: str
    chosen: npt.NDArray[np.int64]  # which of the block's messages
    rejects: RejectList

    def __len__(self) -> int:
        return len(self.chosen)

    @cached_property
    def offset(self) -> npt.NDArray[np.int64]:
        """The place in the log of each message."""
        return self.block.offset[self.chosen]

    @cached_property
    def messages(self) -> Messages:
        """The messages as the scans take them."""
        b = self.block
        encodings = np.full(max(b.channels) + 1, OTHER, np.uint8)
        for n, channel in b.channels.items():
            encodings[n] = _SCANNED.get(channel.encoding, OTHER)
        number = b.channel[self.chosen]
        return Messages(b.data, b.start[self.chosen], b.end[self.chosen], encodings[number], number)

    def take(self, scan: Callable[[int], int], judge: Callable[[list[Received]], None]) -> None:
        """Take every message in order: `scan` from one on, as far as it goes, `judge` the next.

        Where the scan stops at once again, it is left alone for twice as many as before:
        a log that it cannot read at all costs it nothing.
        """
        i, at_once = 0, 1
        while i < len(self):
            stopped = scan(i)
            at_once = 1 if stopped > i else min(2 * at_once, MOST_AT_ONCE)
            i = min(stopped + at_once, len(self))
            if stopped < i:
                judge(list(self.decoded(stopped, i)))

    def decoded(self, first: int, last: int) -> Iterator[Received]:
        """Yield the messages from `first` to before `last`; what is none is left out."""
        b = self.block
        for i in self.chosen[first:last].tolist():
            decode = _decoder(self.carries, b.channels[int(b.channel[i])].encoding)
            offset, time_ns = int(b.offset[i]), int(b.time_ns[i])
            try:
                record = decode(b.data[b.start[i] : b.end[i]].tobytes())
            except UndecodableError:
                self.rejects.add(f"undecodable_{self.carries}", time_ns=time_ns, offset=offset)
                continue
            yield Received(record, offset, time_ns)


@lru_cache(maxsize=64)
def _decoder(carries: str, encoding: str) -> Callable[[bytes], Record]:
    return decoder(carries, encoding)
