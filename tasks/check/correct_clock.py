"""Correct a clock: set one sensor's identified frames of a span to their true times."""

import numpy as np
import pyarrow as pa

from epipole.io.work.parts import IDENTIFIED, Parts, write_part
from epipole.io.work.work_layout import ReadFolder
from epipole.schemas.bridge import array, from_polars, to_polars
from epipole.schemas.settings import SensorSettings
from epipole.schemas.spans import Sensor, Span
from epipole.schemas.stages import Stage
from epipole.schemas.work_tables import SOLUTIONS
from epipole.tasks.check.check_sensors import SensorVerdict
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.identify.frame_inputs import interpolate_sensor_states
from epipole.tasks.identify.identify_span import states_about

STATE_COLUMNS = [
    *("x_km", "y_km", "z_km"),
    *("vx_km_s", "vy_km_s", "vz_km_s"),
    *("position_sigma_km", "used_position_sigma_km"),
]


@stage_task(Stage.CHECK, "{sensor} {span}")
def correct_clock(
    frames: ReadFolder,
    sensor: Sensor,
    identified: Parts,
    span: Span,
    clock: SensorVerdict,
    settings: SensorSettings,
    parts: Parts,
) -> None:
    """Set a part's frames to their true times, with the states of the sensor at these times.

    Parameters
    ----------
    identified
        The sensor's parts, with times by its clock.
    parts
        Where the corrected part goes: `IDENTIFIED`.
    """
    if parts.holds(span):
        return
    names = ("solutions", "stars", "detections")
    tables = {name: at_true_times(identified.read(span, name), clock) for name in names}
    states = states_about(frames, sensor, span, settings.state_gap_s)
    at_frames = interpolate_sensor_states(tables["solutions"], states, settings)
    tables["solutions"] = with_sensor_states(tables["solutions"], at_frames)
    tables["rejects"] = identified.read(span, "rejects")
    write_part(parts.of(span), IDENTIFIED, tables)


def at_true_times(rows: pa.Table, clock: SensorVerdict) -> pa.Table:
    """Return the rows with true times instead of times by the clock."""
    at = rows.schema.get_field_index("time")
    field = rows.schema.field(at)
    time_ns = array(rows, "time") - np.int64(round(clock.offset_s * 1e9))
    return rows.set_column(at, field, pa.array(time_ns).cast(field.type))


def with_sensor_states(solutions: pa.Table, at_frames: pa.Table) -> pa.Table:
    """Return the solutions with the sensor states `at_frames`, joined by frame."""
    key = ["sensor_id", "frame_number"]
    states = to_polars(at_frames).select([*key, *STATE_COLUMNS])
    moved = to_polars(solutions).drop(STATE_COLUMNS).join(
        states, on=key, how="left", maintain_order="left"
    )  # fmt: skip
    return from_polars(SOLUTIONS, moved)
