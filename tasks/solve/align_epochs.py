"""Align epochs: common times of all sensors, and the nearest frame of each sensor."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from epipole.schemas.arrays import Integers
from epipole.schemas.bridge import array, concat, rows_with, table
from epipole.schemas.settings import AlignmentSettings
from epipole.schemas.tables import EPOCHS
from epipole.tasks.algorithms.times import (
    epoch_grid,
    epoch_interval_ns,
    frame_interval_ns,
    instants_of,
    nearest_frame,
)

SERVED_NS = 60_000_000_000  # longest time between an epoch and the frame that is used for it


class EpochGrid(NamedTuple):
    """The epochs of a whole night, the same for each of its spans."""

    interval_ns: int
    epochs_ns: tuple[int, ...] | None  # the epochs, if no sensor has a frame interval


class FrameTimes(NamedTuple):
    """The times of a sensor's `usable_frames` [ns], in order, and the usual interval of all its
    frames [ns], 0 with fewer than two."""

    usable_ns: Integers
    interval_ns: int


def frame_times(solutions: Sequence[pa.Table]) -> FrameTimes:
    """Return the times of one sensor's frames; parts of its `solutions`.

    A sensor of which few frames have an attitude is not slow: the interval is that of all frames.
    """
    usable, every = (
        np.concatenate([np.zeros(0, np.int64), *(array(part, "time") for part in parts)])
        for parts in ([usable_frames(part) for part in solutions], solutions)
    )
    return FrameTimes(np.sort(usable), frame_interval_ns(every))


def night_grid(sensors: Sequence[FrameTimes], settings: AlignmentSettings) -> EpochGrid:
    """Return a night's grid of epochs: at the interval of the slowest sensor, if not set."""
    if settings.interval_s is not None:
        return EpochGrid(max(round(settings.interval_s * 1e9), 1), None)
    seeing = [sensor for sensor in sensors if len(sensor.usable_ns)]
    interval_ns = epoch_interval_ns([sensor.interval_ns for sensor in seeing])
    if any(len(sensor.usable_ns) > 1 for sensor in seeing) or not seeing:
        return EpochGrid(interval_ns, None)
    usable_ns = np.concatenate([sensor.usable_ns for sensor in seeing])
    return EpochGrid(interval_ns, tuple(instants_of(usable_ns, interval_ns).tolist()))


def usable_frames(solutions: pa.Table) -> pa.Table:
    """Return the frames that have an attitude and a position."""
    has_attitude = pc.not_equal(solutions["attitude_source"], "none")
    return solutions.filter(pc.and_(has_attitude, pc.is_valid(solutions["x_km"])))


def align_epochs(
    solutions: pa.Table, settings: AlignmentSettings, grid: EpochGrid | None = None
) -> pa.Table:
    """Return EPOCHS: for each epoch and sensor the nearest frame, and its distance in time.

    An epoch is kept if any sensor has a frame for it. Without `grid`, it is that of these frames.
    """
    served = usable_frames(solutions).sort_by("time")
    sensors = sorted(set(served["sensor_id"].to_pylist()))
    parts = [rows_with(served, "sensor_id", s) for s in sensors]
    times = [frame_times([rows_with(solutions, "sensor_id", s)]) for s in sensors]
    if not parts:
        return concat(EPOCHS, [])
    interval_ns, epochs_ns = grid or night_grid(times, settings)
    if epochs_ns is None:
        epochs = epoch_grid(
            min(int(t.usable_ns[0]) for t in times) - interval_ns // 2,
            max(int(t.usable_ns[-1]) for t in times) + interval_ns // 2,
            interval_ns,
        )
    else:
        epochs = np.array(epochs_ns, np.int64)
    rows = [
        _nearest_frames(epochs, sensor, array(part, "frame_number"), t, interval_ns, settings)
        for sensor, part, t in zip(sensors, parts, times, strict=True)
    ]
    return concat(EPOCHS, rows).sort_by([("epoch", "ascending"), ("sensor_id", "ascending")])


def _nearest_frames(
    epochs: Integers,
    sensor: str,
    frame_number: Integers,
    times: FrameTimes,
    interval_ns: int,
    settings: AlignmentSettings,
) -> pa.Table:
    """Return EPOCHS of one sensor."""
    frame = nearest_frame(epochs, times.usable_ns)
    dt_ns = times.usable_ns[frame] - epochs
    if settings.max_gap_s is not None:
        limit_ns = settings.max_gap_s * 1e9
    else:
        limit_ns = max(interval_ns, frame_interval_ns(times.usable_ns)) / 2
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
