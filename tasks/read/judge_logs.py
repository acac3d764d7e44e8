"""Judge the logs of a night: what is written as it says, of each sensor."""

from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.work.parts import read_part
from epipole.schemas.arrays import Integers
from epipole.schemas.log_checks import LogCause
from epipole.schemas.stages import Stage
from epipole.tasks.algorithms.log_checks.findings import FRAMES_ALL_NIGHT, WRONG, Finding
from epipole.tasks.algorithms.log_checks.frames import check_night
from epipole.tasks.common.batches import Batch
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.read.judge_sensor import (
    LEFT_OUT,
    checks_table,
    judge_sensor,
    rows_by_sensor,
    sensor_log,
)
from epipole.tasks.read.order_frames import OrderedFrames

OPEN_PIECES = 64  # tables of pieces of logs whose rows are sorted by sensor once for many sensors
WRONG_SHARE = 0.05  # of the sensors, whose times may all be wrong without a gap in those of others


class NightFrames(NamedTuple):
    """The times [ns] between which the sensors of a night have frames.

    `max_gaps` is the largest share of the night in which a sensor may have no frames.
    """

    first_ns: int
    last_ns: int
    max_gaps: float

    @classmethod
    def of_most(cls, between_ns: Sequence[tuple[int, int]], max_gaps: float) -> "NightFrames":
        """Return the times that no single sensor decides, of three and more.

        Where the times of one are wrong, the others have no gap for that.

        Parameters
        ----------
        between_ns
            First and last frame of each sensor.
        """
        if not between_ns:
            return cls(0, 0, max_gaps)
        first, last = (sorted(each) for each in zip(*between_ns, strict=True))
        n = len(between_ns)
        outside = 1 + int(WRONG_SHARE * n) if n > 2 else 0
        return cls(first[outside], last[-1 - outside], max_gaps)


class JudgedSensor(NamedTuple):
    """A sensor, and the parts of logs that have something of it."""

    sensor_id: str
    pieces: list[Path]

    def __str__(self) -> str:
        """Return the sensor's id."""
        return self.sensor_id


def judged_sensors(frames: OrderedFrames) -> list[JudgedSensor]:
    """Return all sensors, those too of which no state or frame could be used."""
    pieces = dict(zip(frames.sensors, frames.pieces, strict=True))
    left_out = frames.rejects.filter(pc.is_in(frames.rejects["reason"], pa.array(list(LEFT_OUT))))
    names = {*pieces, *left_out["sensor_id"].drop_null().to_pylist()}
    return [JudgedSensor(name, pieces.get(name, [])) for name in sorted(names)]


@stage_task(Stage.READ, "checks of {sensors}")
def judge_logs(
    sensors: Batch[JudgedSensor],
    cameras: pa.Table,
    rejects: pa.Table,
    between_ns: tuple[int, int],
    state_gap_s: float,
    night: NightFrames | None = None,
) -> pa.Table:
    """Return CHECKS of sensors, by what the logs have of them between two times.

    Parameters
    ----------
    cameras, rejects
        CAMERAS and REJECTS of all sensors.
    state_gap_s
        Largest time from a frame to the nearest state [s].
    """
    found = {}

    @lru_cache(maxsize=OPEN_PIECES)
    def rows_of(piece: Path, name: str) -> tuple[pa.Table, dict[str, Integers]]:
        rows = read_part(piece, name)
        return rows, rows_by_sensor(rows, between_ns)

    for sensor, pieces in sensors:
        exposures, states = (
            [
                (rows, of_sensors[sensor])
                for rows, of_sensors in (rows_of(piece, name) for piece in pieces)
                if sensor in of_sensors
            ]
            for name in ("exposures", "states")
        )
        log = sensor_log(sensor, exposures, states, cameras, rejects)
        found[sensor] = judge_sensor(log, state_gap_s)
        if night is not None and (of_night := _of_night(log.time_ns, night)) is not None:
            found[sensor].append(of_night)
    return checks_table(found)


def _of_night(time_ns: Integers, night: NightFrames) -> Finding | None:
    first_ns, last_ns, max_gaps = night
    inside = np.unique(time_ns[(time_ns >= first_ns) & (time_ns <= last_ns)])
    return check_night(inside, first_ns, last_ns, max_gaps)


def absent_sensors(names: Iterable[str]) -> pa.Table:
    """Return CHECKS of sensors that are expected and have no frames."""
    found = Finding(FRAMES_ALL_NIGHT, WRONG, 1.0, expected=0.0, cause=LogCause.NO_FRAMES.value)
    return checks_table({name: [found] for name in names})
