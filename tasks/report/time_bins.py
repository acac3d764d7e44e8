"""Bins of time: a night is drawn in about a hundred of them, however many frames it has."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Indices = npt.NDArray[np.int64]

MOST_BINS = 96
FEWEST_BINS = 8
FRAMES_IN_BIN = 4  # of the busiest sensor, at least: an empty bin is then a gap


class TimeBins(NamedTuple):
    """Equal bins from the first to the last frame of a night."""

    start_ns: int
    end_ns: int
    number: int

    @property
    def edges_s(self) -> npt.NDArray[np.float64]:
        """The (number + 1,) edges, in seconds since 0 h of the first day."""
        edges = np.linspace(0.0, (self.end_ns - self.start_ns) / 1e9, self.number + 1)
        return seconds_of_day(np.array([self.start_ns])) + edges

    def of(self, time_ns: Indices) -> Indices:
        """Return the bin of each time; times outside belong to the first or last bin."""
        since = (time_ns - self.start_ns) / max(self.end_ns - self.start_ns, 1)
        return np.clip((since * self.number).astype(np.int64), 0, self.number - 1)


def bins_between(start_ns: int, end_ns: int, frames_of_busiest: int) -> TimeBins:
    """Return bins with a few frames each of the sensor that has most."""
    count = int(np.clip(frames_of_busiest // FRAMES_IN_BIN, FEWEST_BINS, MOST_BINS))
    return TimeBins(start_ns, end_ns + 1, count)


def seconds_of_day(time_ns: Indices) -> npt.NDArray[np.float64]:
    """Return the seconds since 0 h UTC of each time's day."""
    seconds: npt.NDArray[np.float64] = (time_ns % 86_400_000_000_000) / 1e9
    return seconds


def clock(time_ns: int) -> str:
    """Return the time of day, such as ``04:05:06``."""
    return str(np.datetime64(time_ns // 1_000_000_000, "s"))[11:]
