"""Logs read into memory for tests and benchmarks, with the frames of all sensors."""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa

from epipole.io.work.work_layout import ReadFolder
from epipole.schemas.bridge import concat
from epipole.schemas.settings import Settings
from epipole.schemas.work_tables import EXPOSURES, SENSOR_STATES, LogSource
from epipole.tasks.read.order_frames import frames_between, order_logs, states_between
from epipole.tasks.read.read_logs import read_log_into

EVER = (0, (1 << 63) - 1)


class WholeLogs(NamedTuple):
    """What several logs hold together, with frames and states by sensor and time."""

    exposures: pa.Table
    states: pa.Table
    cameras: pa.Table
    sources: list[LogSource]
    rejects: pa.Table


def read_whole(
    paths: Sequence[Path | str], settings: Settings, between: tuple[int, int] = EVER
) -> WholeLogs:
    """Read logs as the flow does, with frames and states of a range of time [ns] only."""
    with tempfile.TemporaryDirectory() as folder:
        where = ReadFolder(Path(folder))
        read = [read_log_into(where, k, path) for k, path in enumerate(paths)]
        frames = order_logs(where, read, settings.sensors)
        numbers = range(len(frames.sensors))
        exposures = [frames_between(where, n, *between) for n in numbers]
        states = [states_between(where, n, *between) for n in numbers]
        return WholeLogs(
            concat(EXPOSURES, exposures),
            concat(SENSOR_STATES, states),
            frames.cameras,
            frames.sources,
            frames.rejects,
        )
