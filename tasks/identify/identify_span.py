"""Identify spans: the stars and attitudes of one sensor each, from part to part."""

import logging
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.catalogues.star_catalogue import read_star_catalogue
from epipole.io.work.kept_parts import part_key
from epipole.io.work.parts import IDENTIFIED, Parts, write_part
from epipole.io.work.work_layout import ReadFolder
from epipole.schemas.bridge import array, concat
from epipole.schemas.rejects import Reason, reject_rows
from epipole.schemas.settings import IdentificationSettings, SensorSettings
from epipole.schemas.spans import Sensor, Span
from epipole.schemas.stages import Stage
from epipole.schemas.tables import REJECTS
from epipole.tasks.common.batches import Batch
from epipole.tasks.common.sightings import cameras_of
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.identify.frame_inputs import interpolate_sensor_states
from epipole.tasks.identify.identify_stars import identify_stars
from epipole.tasks.read.assume_readings import without_velocities
from epipole.tasks.read.order_frames import frames_between, states_between

LOGGER = logging.getLogger(__name__)

BRIDGED_NS = 300_000_000_000  # states this far outside a span are interpolated to its frames


class SpanToIdentify(NamedTuple):
    """A sensor's frames of a span, and where their part goes: `IDENTIFIED`."""

    sensor: Sensor
    span: Span
    parts: Parts

    def __str__(self) -> str:
        """Return the sensor and the times of day."""
        return f"{self.sensor} {self.span}"


class Counts(NamedTuple):
    """Counts of some parts; `by_stars` are frames with an attitude from stars."""

    frames: int
    by_stars: int
    stars: int


@stage_task(Stage.IDENTIFY, "{spans}")
def identify_spans(
    frames: ReadFolder,
    spans: Batch[SpanToIdentify],
    cameras: pa.Table,
    sensors: SensorSettings,
    identification: IdentificationSettings,
    max_detections: int,
) -> Counts:
    """Identify the frames of some spans, one sensor each, unless their parts exist.

    Parameters
    ----------
    frames
        Where `order_sensors` put the frames.
    """
    counts = [
        _identify_span(
            frames,
            *each,
            cameras_of(cameras, each.sensor.sensor_id),
            sensors,
            identification,
            max_detections,
        )
        for each in spans
    ]
    total = Counts(*(sum(count) for count in zip(*counts, strict=True)))
    LOGGER.info("%s: identified %d of %d frames", spans, total.by_stars, total.frames)
    return total


def _identify_span(
    frames: ReadFolder,
    sensor: Sensor,
    span: Span,
    parts: Parts,
    cameras: pa.Table,
    sensors: SensorSettings,
    identification: IdentificationSettings,
    max_detections: int,
) -> Counts:
    if not parts.holds(span):
        exposures = frames_between(frames, sensor.number, *span)
        states = states_about(frames, sensor, span, sensors.state_gap_s)
        cameras = valid_cameras(cameras, exposures)
        key = part_key([Stage.IDENTIFY, span, sensor.has_velocities], [exposures, states, cameras])
        if parts.take(span, key):
            return _counts(parts, span)
        frame_states = interpolate_sensor_states(exposures, states, sensors)
        catalogue = read_star_catalogue(identification.catalogue)
        identified = identify_stars(
            exposures, frame_states, cameras, catalogue, sensors, identification, max_detections
        )
        rejects = concat(REJECTS, [identified.rejects, without_state(frame_states)])
        tables = {**identified._asdict(), "rejects": rejects}
        write_part(parts.of(span), IDENTIFIED, tables, key=key)
    return _counts(parts, span)


def valid_cameras(cameras: pa.Table, exposures: pa.Table) -> pa.Table:
    """Return the CAMERAS of a sensor without those that are newer than all of these frames."""
    last_ns = array(exposures, "time").max()
    count = int(np.searchsorted(array(cameras, "time"), last_ns, side="right"))
    return cameras.slice(0, max(count, 1))  # the first one also counts before its time


def _counts(parts: Parts, span: Span) -> Counts:
    """Return the counts of a part that is written."""
    solutions = parts.read(span, "solutions", ["attitude_source"])
    return Counts(
        solutions.num_rows,
        pc.sum(pc.equal(solutions["attitude_source"], "stars")).as_py() or 0,
        parts.read(span, "stars").num_rows,
    )


def states_about(frames: ReadFolder, sensor: Sensor, span: Span, state_gap_s: float) -> pa.Table:
    """Return the states of a sensor that are needed for its frames of a span."""
    reach_ns = BRIDGED_NS + round(state_gap_s * 1e9)
    states = states_between(frames, sensor.number, *span.widened(reach_ns))
    return states if sensor.has_velocities else without_velocities(states)


def without_state(frame_states: pa.Table) -> pa.Table:
    """Return a row of `rejects` for the frames that have no state near in time."""
    without = frame_states.filter(pc.is_null(frame_states["x_km"]))
    first = without.slice(0, 1)
    return reject_rows(
        Reason.NO_STATE,
        sensor_id=first["sensor_id"],
        time=first["time"],
        count=[without.num_rows] * first.num_rows,
    )
