"""Align epochs: common instants of all sensors, and the frame of each that serves."""

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from prefect import task
from prefect.cache_policies import NO_CACHE

from epipole.schemas.bridge import array, concat, table
from epipole.schemas.settings import AlignmentSettings, Settings
from epipole.schemas.tables import EPOCHS
from epipole.tasks.algorithms.epoch_grid import (
    epoch_grid,
    epoch_interval_ns,
    frame_interval_ns,
    instants_of,
    nearest_frame,
)


@task(name="align epochs", cache_policy=NO_CACHE)
def align_epochs(solutions: pa.Table, settings: Settings) -> pa.Table:
    """Return the epochs of a night: which frame of which sensor serves each, and how far off.

    A frame serves if it has an attitude and a position. An epoch is kept if any sensor has a
    frame for it.
    """
    served = solutions.filter(
        (pa.compute.field("attitude_source") != "none") & pa.compute.field("x_km").is_valid()
    ).sort_by("time")
    sensors = sorted(set(served["sensor_id"].to_pylist()))
    parts = [served.filter(pa.compute.field("sensor_id") == s) for s in sensors]
    times = [array(part, "time") for part in parts]
    if not parts:
        return concat(EPOCHS, [])
    interval_ns = _interval_ns(times, settings.alignment)
    if settings.alignment.interval_s is None and all(len(t) < 2 for t in times):
        epochs = instants_of(np.concatenate(times), interval_ns)
    else:
        epochs = epoch_grid(
            min(int(t[0]) for t in times) - interval_ns // 2,
            max(int(t[-1]) for t in times) + interval_ns // 2,
            interval_ns,
        )
    rows = [
        _serving(epochs, sensor, array(part, "frame_number"), t, interval_ns, settings.alignment)
        for sensor, part, t in zip(sensors, parts, times, strict=True)
    ]
    return concat(EPOCHS, rows).sort_by([("epoch", "ascending"), ("sensor_id", "ascending")])


def _interval_ns(times: list[npt.NDArray[np.int64]], settings: AlignmentSettings) -> int:
    if settings.interval_s is not None:
        return max(round(settings.interval_s * 1e9), 1)
    return epoch_interval_ns(times)


def _serving(
    epochs: npt.NDArray[np.int64],
    sensor: str,
    frame_number: npt.NDArray[np.int64],
    time_ns: npt.NDArray[np.int64],
    interval_ns: int,
    settings: AlignmentSettings,
) -> pa.Table:
    """Return one sensor's rows of the epochs table."""
    frame = nearest_frame(epochs, time_ns)
    dt_ns = time_ns[frame] - epochs
    if settings.max_gap_s is not None:
        limit_ns = settings.max_gap_s * 1e9
    else:
        limit_ns = max(interval_ns, frame_interval_ns(time_ns)) / 2
    near = np.abs(dt_ns) <= limit_ns
    return table(
        EPOCHS,
        {
            "epoch": epochs[near],
            "sensor_id": np.full(int(near.sum()), sensor, dtype=object),
            "frame_number": frame_number[frame[near]],
            "dt_s": dt_ns[near] / 1e9,
        },
    )
