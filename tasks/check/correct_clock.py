"""Correct a clock: set one sensor's identified frames of a span to their true times."""

from collections.abc import Mapping

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.work.parts import IDENTIFIED, Parts, write_part
from epipole.io.work.work_layout import ReadFolder
from epipole.schemas.arrays import Array, Flags
from epipole.schemas.bridge import (
    array,
    concat,
    from_polars,
    nullable,
    stack,
    table,
    to_polars,
    unstack,
)
from epipole.schemas.rejects import Reason
from epipole.schemas.settings import SensorSettings
from epipole.schemas.spans import Sensor, Span
from epipole.schemas.stages import Stage
from epipole.schemas.tables import DETECTIONS, REJECTS
from epipole.schemas.work_tables import SOLUTIONS
from epipole.tasks.algorithms.geometry.directions import (
    boresight_angles,
    matrix_from_quaternion,
    quaternion_from_matrix,
    radec_from_unit,
    unit_from_radec,
)
from epipole.tasks.check.check_sensors import SPEED_KM_S, SensorVerdict
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.identify.frame_inputs import interpolate_sensor_states
from epipole.tasks.identify.identify_span import states_about, without_state

STATE_COLUMNS = [
    *("x_km", "y_km", "z_km"),
    *("vx_km_s", "vy_km_s", "vz_km_s"),
    *("position_sigma_km", "used_position_sigma_km"),
]
BORESIGHT = ("ra_deg", "dec_deg", "roll_deg")


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
    at_frames = _with_error_of_clock(
        interpolate_sensor_states(tables["solutions"], states, settings), clock
    )
    tables["solutions"] = with_sensor_states(tables["solutions"], at_frames)
    tables |= with_prior_attitudes(tables["solutions"], tables["detections"], at_frames)
    tables["rejects"] = rejects_at_true_times(identified.read(span, "rejects"), at_frames)
    write_part(parts.of(span), IDENTIFIED, tables)


def _with_error_of_clock(at_frames: pa.Table, clock: SensorVerdict) -> pa.Table:
    """Return SENSOR_STATES_AT_FRAMES with what the clock may still be off in the positions."""
    used_km = array(at_frames, "used_position_sigma_km")
    columns = {name: at_frames[name] for name in at_frames.column_names}
    columns["used_position_sigma_km"] = np.hypot(used_km, SPEED_KM_S * clock.sigma_s)
    return table(at_frames.schema, columns)


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


def rejects_at_true_times(rejects: pa.Table, at_frames: pa.Table) -> pa.Table:
    """Return REJECTS of a part; frames without a state are those at the true times.

    At the ends of a log and of gaps, other frames have a state near than by the wrong clock.
    """
    others = rejects.filter(pc.not_equal(rejects["reason"], Reason.NO_STATE.value))
    return concat(REJECTS, [others, without_state(at_frames)])


def with_prior_attitudes(
    solutions: pa.Table, detections: pa.Table, at_frames: pa.Table
) -> dict[str, pa.Table]:
    """Return the solutions and detections, with the prior attitudes that `at_frames` has.

    A sensor that turns had another attitude at the true time. Attitudes from stars stay: they are
    those of the exposure. So do prior ones where the states have none at the true time.

    Parameters
    ----------
    at_frames
        SENSOR_STATES_AT_FRAMES, in the order of the solutions.
    """
    q_then = stack(at_frames, "q{}", "xyzw")
    moved = (array(solutions, "attitude_source") == "prior") & np.isfinite(q_then[:, 3])
    if not moved.any():
        return {"solutions": solutions, "detections": detections}
    q = stack(solutions, "q{}", "xyzw")
    R, R_then = matrix_from_quaternion(q), matrix_from_quaternion(q_then)
    q[moved] = quaternion_from_matrix(R_then[moved])
    angles = np.stack([array(solutions, name) for name in BORESIGHT])
    angles[:, moved] = np.degrees(boresight_angles(R_then[moved]))
    columns = {**unstack("q{}", q, "xyzw"), **dict(zip(BORESIGHT, angles, strict=True))}
    return {
        "solutions": _replaced(SOLUTIONS, solutions, columns),
        "detections": _turned(detections, solutions, np.swapaxes(R_then, 1, 2) @ R, moved),
    }


def _turned(detections: pa.Table, solutions: pa.Table, turn: Array, moved: Flags) -> pa.Table:
    """Return the detections with the directions of some frames, (f,) bool, turned by (f, 3, 3)."""
    numbers = array(solutions, "frame_number")
    order = np.argsort(numbers, kind="stable")
    frame = order[np.searchsorted(numbers[order], array(detections, "frame_number"))]
    rows = np.flatnonzero(moved[frame])
    ra_deg, dec_deg = (array(detections, name).copy() for name in ("ra_deg", "dec_deg"))
    u = unit_from_radec(np.radians(ra_deg[rows]), np.radians(dec_deg[rows]))
    ra, dec = radec_from_unit(np.einsum("nij,nj->ni", turn[frame[rows]], u))
    ra_deg[rows], dec_deg[rows] = np.degrees(ra), np.degrees(dec)
    return _replaced(DETECTIONS, detections, {"ra_deg": ra_deg, "dec_deg": dec_deg})


def _replaced(schema: pa.Schema, rows: pa.Table, columns: Mapping[str, Array]) -> pa.Table:
    """Return rows of a schema with other values in some columns; NaN is null."""
    kept = {name: rows[name] for name in schema.names}
    return table(schema, kept | {name: nullable(values) for name, values in columns.items()})
