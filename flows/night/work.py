"""The work of a night: its sensors, their spans with frames, and where their parts are."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.work.parts import Parts
from epipole.io.work.work_layout import ReadFolder, SensorParts, WorkFolder
from epipole.schemas.bridge import concat
from epipole.schemas.errors import LogError
from epipole.schemas.rejects import Reason, Trait, reject_rows
from epipole.schemas.spans import DAY_NS, SPAN_NS, Sensor, Span, day_of
from epipole.schemas.tables import REJECTS
from epipole.tasks.check.check_sensors import SensorVerdict
from epipole.tasks.read.order_frames import OrderedFrames

Spans = dict[Sensor, list[Span]]


class Work(NamedTuple):
    """The work of a night.

    A round is one pass from `track` to `check`. After a correction of clocks comes another round.
    """

    frames: ReadFolder  # ordered by `order_logs`
    folder: WorkFolder
    spans: Spans  # with frames, of each sensor
    cameras: pa.Table
    identified: dict[Sensor, Parts]  # the newest of each sensor
    round: int = 0
    verdicts: tuple[SensorVerdict, ...] = ()  # of the logs, before any correction

    def all_spans(self) -> list[Span]:
        """Return the spans in which any sensor has frames, in order."""
        return sorted({span for spans in self.spans.values() for span in spans})

    def by_span(self) -> list[tuple[Sensor, Span]]:
        """Return each sensor and span, in order of time: sensors are worked on together."""
        pairs = [(sensor, span) for sensor, spans in self.spans.items() for span in spans]
        return sorted(pairs, key=lambda pair: (pair[1], pair[0]))

    def sensor_parts(self) -> dict[Sensor, SensorParts]:
        """Return where the parts of each sensor lie in this round."""
        return {
            sensor: SensorParts(
                self.identified[sensor],
                self.folder.tracked(sensor, self.round),
                self.folder.tracklet_names(sensor, self.round),
                self.folder.viewed(self.round)[sensor.number],
            )
            for sensor in self.spans
        }


def plan_spans(frames: OrderedFrames, night: str) -> tuple[Spans, pa.Table]:
    """Return the spans with frames, by sensor: of a night, and one before and after it.

    A sensor without a calibration has no spans, but a row of the `rejects` that are returned.

    Raises
    ------
    LogError
        If no sensor with frames of the night has a calibration.
    """
    calibrated = set(pc.unique(frames.cameras["sensor_id"]).to_pylist())
    day = day_of(night)
    spans: Spans = {}
    rejects = []
    for number, sensor_id in enumerate(frames.sensors):
        time_ns = frames.time_ns[number]
        wanted = _wanted(np.unique(time_ns // SPAN_NS), day)
        if wanted and sensor_id in calibrated:
            spans[Sensor(number, sensor_id)] = wanted
        elif len(of_day := time_ns[time_ns // DAY_NS == day]):
            rejects.append(
                reject_rows(
                    Reason.NO_CALIBRATION, sensor_id=sensor_id, time=of_day[:1], count=[len(of_day)]
                )
            )
    if not spans:
        raise LogError(
            f"{', '.join(log.name for log in frames.sources)}: no sensor has a calibration "
            f"({', '.join(frames.sensors)}) on {night}; {_why_not(frames.rejects)}"
        )
    return spans, concat(REJECTS, rejects)


def _why_not(rejects: pa.Table) -> str:
    """Return what is wrong with the calibrations that there are, or what to record."""
    found = set(rejects["reason"].to_pylist())
    invalid = [reason for reason in Reason.having(Trait.INVALID_CALIBRATION) if reason in found]
    sentences = [f"{reason}: {reason.sentence}" for reason in invalid]
    if sentences:
        return "those in the log are invalid: " + " ".join(sentences)
    return "record foxglove.CameraCalibration with the sensor's id as frame_id"


def spans_of_night(spans: Sequence[Span], night: str) -> list[Span]:
    """Return the spans that belong to a night."""
    return [span for span in spans if span.start_ns // DAY_NS == day_of(night)]


def _wanted(numbers: np.ndarray, day: int) -> list[Span]:
    """Return the spans of a day, and one before and after: no track is cut at midnight."""
    near = (numbers[:, None] + [-1, 0, 1]) * SPAN_NS // DAY_NS == day
    return [Span(k * SPAN_NS, (k + 1) * SPAN_NS) for k in numbers[near.any(axis=1)].tolist()]
