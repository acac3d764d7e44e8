"""Epochs: common instants of sensors that expose at different times."""

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.constants import DAY_NS

Nanoseconds = npt.NDArray[np.int64]

MILLISECOND_NS = 1_000_000


def frame_interval_ns(time_ns: Nanoseconds) -> int:
    """Return the usual interval between a sensor's frames [ns]; 0 with fewer than two."""
    steps = np.diff(np.unique(time_ns))
    return int(np.median(steps)) if len(steps) else 0


def epoch_interval_ns(time_ns_by_sensor: list[Nanoseconds]) -> int:
    """Return the slowest sensor's frame interval [ns], rounded to 1 ms, at least 1 ms.

    Rounding keeps the grid fixed from night to night, whatever the jitter of the exposures.
    Without any interval it is one second.
    """
    slowest = max((frame_interval_ns(t) for t in time_ns_by_sensor), default=0)
    return max(round(slowest / MILLISECOND_NS), 1) * MILLISECOND_NS if slowest else 1_000_000_000


def instants_of(time_ns: Nanoseconds, apart_ns: int) -> Nanoseconds:
    """Return the mean times [ns] of groups of frames, split at gaps of `apart_ns` or more.

    These are the epochs of a night in which no sensor has a frame interval, hence no grid.
    """
    time_ns = np.unique(time_ns)
    group = np.concatenate([[0], np.cumsum(np.diff(time_ns) >= apart_ns)]).astype(np.int64)
    first = np.flatnonzero(np.diff(group, prepend=-1))
    if not len(time_ns):
        return time_ns
    since = time_ns - time_ns[first][group]
    return time_ns[first] + np.bincount(group, since).astype(np.int64) // np.bincount(group)


def epoch_grid(first_ns: int, last_ns: int, interval_ns: int) -> Nanoseconds:
    """Return all multiples of the interval since midnight UTC within [first, last], in ns.

    Counting from midnight makes the grid of a night independent of its logs.
    """
    out = []
    for day in range(first_ns // DAY_NS, last_ns // DAY_NS + 1):
        midnight = day * DAY_NS
        lo = max(first_ns - midnight + interval_ns - 1, 0) // interval_ns
        hi = min(last_ns - midnight, DAY_NS - 1) // interval_ns
        out.append(midnight + np.arange(lo, hi + 1, dtype=np.int64) * interval_ns)
    return np.concatenate(out) if out else np.zeros(0, np.int64)


def nearest_frame(epoch_ns: Nanoseconds, time_ns: Nanoseconds) -> npt.NDArray[np.int64]:
    """Return the index of the frame nearest to each epoch; the earlier one of a tie.

    Parameters
    ----------
    epoch_ns : (e,) int
        Epochs [ns].
    time_ns : (f,) int
        Frame times [ns], increasing, f >= 1.
    """
    after = np.clip(np.searchsorted(time_ns, epoch_ns), 1, max(len(time_ns) - 1, 1))
    after = np.minimum(after, len(time_ns) - 1)
    before = np.maximum(after - 1, 0)
    closer = (epoch_ns - time_ns[before]) <= (time_ns[after] - epoch_ns)
    return np.where(closer, before, after)
