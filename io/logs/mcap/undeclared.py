"""Messages that come before the declaration of their channel or its schema, or without one.

MCAP wants a channel to be declared before its messages. Where it comes later, its first messages
are read in a second walk over the file. Without any, they are left out and counted.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.io.logs.mcap.container import Channel, ChannelTable
from epipole.schemas.arrays import Integers
from epipole.schemas.rejects import Reason

N_CHANNELS = 1 << 16  # with distinct numbers of 16 bits
Channels = npt.NDArray[np.uint16]


class Waiting(NamedTuple):
    """The messages of a channel without a declaration so far, and the first one of them."""

    n: int
    offset: int
    time_ns: int
    reason: Reason = Reason.UNKNOWN_CHANNEL


class Late(NamedTuple):
    """The first `n` messages of a channel, in the log number `log` of the file, counted from 0."""

    log: int
    number: int
    channel: Channel
    n: int


@dataclass
class Undeclared:
    """Counts the messages of a file without a declaration before them, in the first walk."""

    _waiting: dict[int, Waiting] = field(default_factory=dict)  # by channel, in the latest log
    _late: list[Late] = field(default_factory=list)
    _n_logs: int = 0  # that have ended

    def add(self, number: int, n: int, offset: int, time_ns: int) -> None:
        """Count messages of a channel; the offset and time are those of the first one."""
        before = self._waiting.get(number, Waiting(0, offset, time_ns))
        self._waiting[number] = before._replace(n=before.n + n)

    def settle(self, channels: ChannelTable) -> Iterator[Waiting]:
        """Look at the channels at the end of a log; yield the messages that are to be left out."""
        for number, waiting in sorted(self._waiting.items()):
            reason, channel = channels.missing(number), channels.find(number)
            # At most as many as one log can have: a file may be made of a million logs.
            if channel is not None and len(self._late) == N_CHANNELS:
                reason = Reason.UNKNOWN_CHANNEL
            if reason is not None:
                yield waiting._replace(reason=reason)
            elif channel is not None:
                self._late.append(Late(self._n_logs, number, channel, waiting.n))
        self._waiting = {}
        self._n_logs += 1

    def late(self) -> "LateMessages | None":
        """Return what a second walk has to find, if anything."""
        return LateMessages(self._late) if self._late else None


class LateMessages:
    """Finds the messages before the declarations of their channels, in a second walk."""

    def __init__(self, late: list[Late]) -> None:
        self._of_log: dict[int, list[Late]] = {}
        for item in late:
            self._of_log.setdefault(item.log, []).append(item)
        self._left = sum(item.n for item in late)
        self._n = np.zeros(N_CHANNELS, np.int64)
        self.channels: dict[int, Channel] = {}
        self.begin_log(0)

    def __bool__(self) -> bool:
        return self._left > 0

    def begin_log(self, log: int) -> None:
        """Begin with log number `log` of the file, counted from 0."""
        self._n[list(self.channels)] = 0
        self.channels = {item.number: item.channel for item in self._of_log.get(log, [])}
        for item in self._of_log.get(log, []):
            self._n[item.number] = item.n

    def take(self, channel: Channels) -> Integers:
        """Return which of the next messages of the file were not read before, in order.

        `channel` (n,) are their channels; returned are rows of it.
        """
        order = np.argsort(channel, kind="stable")
        in_order = channel[order]
        # For each message, how many of the same channel come before it.
        rank = np.arange(len(order)) - np.searchsorted(in_order, in_order)
        taken = np.sort(order[rank < self._n[in_order]])
        counts = np.bincount(channel[taken])
        self._n[: len(counts)] -= counts
        self._left -= len(taken)
        return taken
