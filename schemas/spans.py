"""Spans of a night, and sensors: what a task works on.

Spans are counted from 1970, not from the first frame, and a day is a whole number of them. So
another log of a night does not shift them, and no span contains a midnight.
"""

from typing import NamedTuple

import numpy as np
import pyarrow as pa

from epipole.schemas.arrays import Flags, Integers
from epipole.schemas.bridge import array

DAY_NS = 86_400_000_000_000
SPAN_NS = 1_800_000_000_000  # half an hour: enough tasks for many workers, but few per night

BLOCK_NS = 600_000_000_000  # divides a span: the longest evidence that tracklets are one object


class Span(NamedTuple):
    """A time from `start_ns` to before `end_ns`; UTC nanoseconds since 1970."""

    start_ns: int
    end_ns: int

    def widened(self, margin_ns: int) -> "Span":
        """Return the span with a margin at both ends."""
        return Span(self.start_ns - margin_ns, self.end_ns + margin_ns)

    def holds(self, time_ns: Integers) -> Flags:
        """Return which instants lie in the span."""
        return (time_ns >= self.start_ns) & (time_ns < self.end_ns)

    def of(self, rows: pa.Table, column: str) -> pa.Table:
        """Return the rows whose time lies in the span, in their order."""
        inside = np.flatnonzero(self.holds(array(rows, column)))
        if len(inside) and inside[-1] - inside[0] + 1 == len(inside):  # not copied
            return rows.slice(inside[0], len(inside))
        return rows.take(inside)

    @property
    def span(self) -> "Span":
        """The half hour that a block of time lies in."""
        start_ns = self.start_ns // SPAN_NS * SPAN_NS
        return Span(start_ns, start_ns + SPAN_NS)

    @property
    def blocks(self) -> list["Span"]:
        """The blocks of time that a half hour consists of."""
        return [Span(t, t + BLOCK_NS) for t in range(self.start_ns, self.end_ns, BLOCK_NS)]

    @property
    def folder(self) -> str:
        """Name of the span's parts in the folder of a stage: its start [s since 1970]."""
        return f"{self.start_ns // 1_000_000_000}"

    def __str__(self) -> str:
        """Return the times of day, such as ``04:00-04:30``."""
        start, end = (np.datetime64(t, "ns").astype("datetime64[m]") for t in self)
        return f"{str(start)[11:]}-{str(end)[11:]}"


ALL_TIME = Span(-(2**63), 2**63 - 1)


class Sensor(NamedTuple):
    """A sensor: its number in the run, which names its parts, and its id.

    `has_velocities` is false where those of its states are not used.
    """

    number: int
    sensor_id: str
    has_velocities: bool = True

    def __str__(self) -> str:
        """Return the sensor's id."""
        return self.sensor_id


def spans_between(start_ns: int, end_ns: int) -> list[Span]:
    """Return the spans that cover the time from one instant to another."""
    first, last = start_ns // SPAN_NS, -(-end_ns // SPAN_NS)
    return [Span(k * SPAN_NS, (k + 1) * SPAN_NS) for k in range(first, last)]


def day_of(night: str) -> int:
    """Return the number of days from 1970 to a UTC date."""
    return int(np.datetime64(night, "D").astype(np.int64))
