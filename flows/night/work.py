"""The work of a night: its sensors, their spans with frames, and where their parts are."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.work.parts import Parts
from epipole.io.work.work_layout import ReadFolder, SensorParts, WorkFolder
from epipole.schemas.bridge import array, concat
from epipole.schemas.errors import LogError
from epipole.schemas.rejects import Reason, Trait, reject_rows
from epipole.schemas.spans import DAY_NS, SPAN_NS, Sensor, Span, day_of
from epipole.schemas.tables import REJECTS
from epipole.tasks.calibrate.calibrate_sensors import SensorStars
from epipole.tasks.check.check_sensors import SensorVerdict
from epipole.tasks.common.batches import Batch, in_batches
from epipole.tasks.common.sightings import calibration_at
from epipole.tasks.identify.identify_span import SpanToIdentify
from epipole.tasks.read.order_frames import OrderedFrames, SpanFrames, states_between
from epipole.tasks.track.join_tracklets import SensorToJoin
from epipole.tasks.track.track_span import SpanToTrack

Spans = dict[Sensor, list[Span]]
OfSpan = TypeVar("OfSpan", SpanToIdentify, SpanToTrack)
OfSensor = TypeVar("OfSensor", SensorStars, SensorToJoin)


class Work(NamedTuple):
    """The work of a night.

    A round is one pass from `track` to `check`. After a correction of clocks comes another round,
    in which sensors with such a clock are tracked again.
    """

    frames: ReadFolder  # ordered by `order_sensors`
    folder: WorkFolder
    spans: Spans  # with frames, of each sensor
    n_frames: Mapping[tuple[Sensor, Span], int]
    cameras: pa.Table
    identified: dict[Sensor, Parts]  # the newest of each sensor
    round: int = 0
    corrected: Mapping[Sensor, int] = {}  # the round in which a sensor was tracked last, if not 0
    verdicts: tuple[SensorVerdict, ...] = ()  # of the logs, before any correction
    n_detections: Mapping[tuple[Sensor, Span], int] = {}  # of tracklets, from `track` on

    def all_spans(self) -> list[Span]:
        """Return the spans in which any sensor has frames, in order."""
        return sorted({span for spans in self.spans.values() for span in spans})

    def by_span(self) -> list[tuple[Sensor, Span]]:
        """Return each sensor and span, in order of time: sensors are worked on together."""
        pairs = [(sensor, span) for sensor, spans in self.spans.items() for span in spans]
        return sorted(pairs, key=lambda pair: (pair[1], pair[0]))

    def span_batches(self, pieces: Sequence[OfSpan]) -> list[Batch[OfSpan]]:
        """Return pieces of work, each of one sensor and span, in batches of about equal work."""
        return in_batches(pieces, [self.n_frames.get((p.sensor, p.span), 0) for p in pieces])

    def sensor_batches(self, pieces: Sequence[OfSensor]) -> list[Batch[OfSensor]]:
        """Return pieces of work, each of one sensor, in batches of about equal work."""
        counts = [sum(self.n_frames.get((p.sensor, s), 0) for s in p.spans) for p in pieces]
        return in_batches(pieces, counts)

    def sensor_parts(self) -> dict[Sensor, SensorParts]:
        """Return where the parts of each sensor lie in this round."""
        viewed = self.folder.viewed(self.round)
        parts = {}
        for sensor in self.spans:
            tracked = self.corrected.get(sensor, 0)
            parts[sensor] = SensorParts(
                sensor.sensor_id,
                self.identified[sensor],
                self.folder.tracked(sensor, tracked),
                self.folder.tracklet_names(sensor, tracked),
                viewed[sensor.number],
            )
        return parts


def plan_spans(
    frames: OrderedFrames, night: str, without_velocity: Collection[str] = ()
) -> tuple[Spans, pa.Table]:
    """Return the spans with frames, by sensor: of a night, and one before and after it.

    A sensor without a calibration has no spans, but a row of the `rejects` that are returned, and
    so have sensors whose velocities are not used.

    Raises
    ------
    LogError
        If no sensor with frames of the night has a calibration.
    """
    calibrated = set(pc.unique(frames.cameras["sensor_id"]).to_pylist())
    day = day_of(night)
    spans: Spans = {}
    rejects = []
    for number, (sensor_id, found) in enumerate(zip(frames.sensors, frames.spans, strict=True)):
        wanted = [each.span for each in found if _is_wanted(each.span, day)]
        if wanted and sensor_id in calibrated:
            has_velocities = sensor_id not in without_velocity
            spans[Sensor(number, sensor_id, has_velocities)] = wanted
            if not has_velocities:
                rejects.append(_without_velocity(frames.folder, number, sensor_id, day))
        elif of_day := [each for each in found if each.span.start_ns // DAY_NS == day]:
            rejects.append(_without_calibration(sensor_id, of_day))
    if not any(spans_of_night(wanted, night) for wanted in spans.values()):
        raise LogError(
            f"{', '.join(log.name for log in frames.sources)}: no sensor has a calibration "
            f"({', '.join(frames.sensors)}) on {night}; {_why_not(frames.rejects)}"
        )
    return spans, concat(REJECTS, rejects)


def cameras_of_night(frames: OrderedFrames, night: str) -> pa.Table:
    """Return CAMERAS without those that hold for frames of other nights only.

    Frames of a night are those in the spans of `plan_spans`. Of a sensor without such frames, all
    calibrations are returned.
    """
    cameras, day = frames.cameras, day_of(night)
    sensor, time_ns = cameras["sensor_id"].to_numpy(), array(cameras, "time")
    holds = np.ones(cameras.num_rows, bool)
    for sensor_id, found in zip(frames.sensors, frames.spans, strict=True):
        wanted = [each for each in found if _is_wanted(each.span, day)]
        rows = np.flatnonzero(sensor == sensor_id)
        if wanted and len(rows):
            between_ns = np.array([wanted[0].first_ns, wanted[-1].last_ns])
            first, last = calibration_at(time_ns[rows], between_ns).tolist()
            holds[rows] = False
            holds[rows[first : last + 1]] = True
    return cameras.filter(pa.array(holds))


def count_frames(
    frames: OrderedFrames, sensors: Iterable[Sensor]
) -> dict[tuple[Sensor, Span], int]:
    """Return the number of frames of each of these sensors in each span."""
    return {
        (sensor, each.span): each.n_frames
        for sensor in sensors
        for each in frames.spans[sensor.number]
    }


def _without_calibration(sensor_id: str, of_day: Sequence[SpanFrames]) -> pa.Table:
    return reject_rows(
        Reason.NO_CALIBRATION,
        sensor_id=sensor_id,
        time=[of_day[0].first_ns],
        count=[sum(each.n_frames for each in of_day)],
    )


def _without_velocity(folder: ReadFolder, number: int, sensor_id: str, day: int) -> pa.Table:
    states = states_between(folder, number, day * DAY_NS, (day + 1) * DAY_NS)
    first = states.slice(0, 1)
    return reject_rows(
        Reason.WRONG_VELOCITY,
        sensor_id=[sensor_id] * first.num_rows,
        time=first["time"],
        count=[states.num_rows] * first.num_rows,
    )


def _why_not(rejects: pa.Table) -> str:
    """Return what is wrong with the calibrations that there are, or what to record."""
    found = set(rejects["reason"].to_pylist())
    invalid = [reason for reason in Reason.having(Trait.INVALID_CALIBRATION) if reason in found]
    sentences = [f"{reason}: {reason.sentence}" for reason in invalid]
    if sentences:
        return "those in the log are invalid: " + " ".join(sentences)
    return (
        "name the log that has it too: of a folder, a run of one night reads only the logs of that "
        "night; or record foxglove.CameraCalibration with the sensor's id as frame_id"
    )


def spans_of_night(spans: Sequence[Span], night: str) -> list[Span]:
    """Return the spans that belong to a night."""
    return [span for span in spans if span.start_ns // DAY_NS == day_of(night)]


def _is_wanted(span: Span, day: int) -> bool:
    """Return whether a span is of a day, or the one before or after: no track is cut there."""
    return day in {(span.start_ns + k * SPAN_NS) // DAY_NS for k in (-1, 0, 1)}
