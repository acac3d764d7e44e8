"""The time that a log is about: where most of its frames are. Frames far from it are strays.

One frame with a wrong clock would else be a night of its own.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.schemas.bridge import array
from epipole.schemas.logs.bounds import FAR_FROM_LOG_NS
from epipole.schemas.rejects import Reason, reject_rows

Nanoseconds = npt.NDArray[np.int64]


def own_range(times: Sequence[Nanoseconds]) -> tuple[int, int] | None:
    """Return the first and last of the times near their median; None where there are none.

    Unset clocks read early, so take the upper median.
    """
    time_ns = np.concatenate([np.empty(0, np.int64), *times])
    n = len(time_ns)
    if n == 0:
        return None
    middle = np.partition(time_ns, n // 2)[n // 2]
    near = time_ns[np.abs(time_ns - middle) <= FAR_FROM_LOG_NS]
    return int(near.min()), int(near.max())


def stray_rejects(frames: pa.Table) -> pa.Table:
    """Return rows of `rejects` for frames that are strays: one per sensor and log."""
    return frames_left_out(frames, Reason.STRAY_TIME)


def frames_left_out(frames: pa.Table, reason: Reason) -> pa.Table:
    """Return a row of `rejects` per sensor and log: the first frame's time, and how many."""
    grouped = frames.group_by(["sensor_id", "source"], use_threads=False).aggregate(
        [("time", "min"), ("time", "count")]
    )
    return reject_rows(
        reason,
        source=grouped["source"],
        sensor_id=grouped["sensor_id"],
        time=grouped["time_min"],
        count=grouped["time_count"],
    )


def without_strays(exposures: pa.Table, first_ns: int, last_ns: int) -> tuple[pa.Table, pa.Table]:
    """Return the frames of a log within its own time, and those that are strays."""
    time_ns = array(exposures, "time")
    own = pa.array((time_ns >= first_ns) & (time_ns <= last_ns))
    return exposures.filter(own), exposures.filter(pa.compute.invert(own))
