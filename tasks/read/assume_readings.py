"""Assume readings: what the settings say of logs that were written otherwise than they state."""

from collections.abc import Callable, Sequence

import numpy as np
import pyarrow as pa

from epipole.io.logs.left_out import log_time_range
from epipole.io.logs.messages.encoding import StateMessage
from epipole.schemas.arrays import Array, Flags, Nanoseconds
from epipole.schemas.bridge import array
from epipole.schemas.settings import EVERY_SENSOR, Assumption
from epipole.schemas.work_tables import LogPiece, LogSource
from epipole.tasks.algorithms.constants import SECOND_NS
from epipole.tasks.algorithms.times import tai_minus_utc_s, utc_julian_date

TAI_MINUS_GPS_S = 19.0  # since 1980: GPS times have no leap seconds
VELOCITIES = ("vx_km_s", "vy_km_s", "vz_km_s")
KM = {"km": 1.0, "m": 1e-3, "km/s": 1.0, "m/s": 1e-3}


def as_assumed(piece: LogPiece, assumptions: Sequence[Assumption]) -> LogPiece:
    """Return a piece of a log as its sensors' assumptions read it.

    A sensor takes all assumptions that name it, or every sensor.
    """
    for assumed in assumptions:
        exposures, states, cameras = (
            _with_times(rows, assumed) for rows in (piece.exposures, piece.states, piece.cameras)
        )
        piece = piece._replace(
            exposures=_with_frame_times(exposures, assumed),
            states=_with_states(states, assumed),
            cameras=_with_line_time(cameras, assumed),
        )
    return piece


def in_kilometres(
    assumptions: Sequence[Assumption],
) -> Callable[[StateMessage], StateMessage] | None:
    """Return what reads a state in the units of its sensor's assumptions; None if all are usual.

    Units are read before the bounds of positions and velocities are checked.
    """
    scales = [
        (each.sensor, KM[each.position_unit], KM[each.velocity_unit], KM[each.position_sigma_unit])
        for each in assumptions
    ]
    unusual = [each for each in scales if each[1:] != (1.0, 1.0, 1.0)]
    if not unusual:
        return None

    def read(state: StateMessage) -> StateMessage:
        for sensor, of_position, of_velocity, of_sigma in unusual:
            if sensor in (state.sensor_id, EVERY_SENSOR):
                state = state._replace(
                    position_km=np.asarray(state.position_km) * of_position,
                    velocity_km_s=np.asarray(state.velocity_km_s) * of_velocity,
                    position_sigma_km=state.position_sigma_km * of_sigma,
                )
        return state

    return read


def as_assumed_source(
    source: LogSource,
    frames_ns: Sequence[Nanoseconds],
    states_ns: Sequence[Nanoseconds],
    assumptions: Sequence[Assumption],
) -> LogSource:
    """Return the source with its time range as its frames, or its states, are read.

    Parameters
    ----------
    frames_ns, states_ns
        Times of all frames and states of the log, as `as_assumed` has them. By how much a frame
        moves depends on its sensor and its exposure.
    """
    if not assumptions:
        return source
    first, last = log_time_range(frames_ns) or log_time_range(states_ns) or (None, None)
    return source._replace(first_time_ns=first, last_time_ns=last)


def _ahead_ns(time_ns: Nanoseconds, assumed: Assumption) -> Nanoseconds:
    """Return by how much written times are ahead of UTC."""
    ahead_ns = np.full(len(time_ns), _in_ns(assumed.ahead_s))
    if assumed.time == "utc":
        return ahead_ns
    to_tai_ns = _in_ns(TAI_MINUS_GPS_S if assumed.time == "gps" else 0.0)
    tai_ns = time_ns - ahead_ns + to_tai_ns
    # TAI-UTC is that of the UTC day, which begins after the TAI day. By the value of the latter, a
    # time before midnight may be a leap second too early: it stays in its day.
    in_day_ns = tai_ns - _tai_minus_utc_ns(tai_ns)
    return ahead_ns - to_tai_ns + _tai_minus_utc_ns(in_day_ns)


def _tai_minus_utc_ns(time_ns: Nanoseconds) -> Nanoseconds:
    return _in_ns(tai_minus_utc_s(utc_julian_date(time_ns)[0]))


def _in_ns(time_s: Array | float) -> Nanoseconds:
    return np.round(np.asarray(time_s) * SECOND_NS).astype(np.int64)


def _of_sensor(rows: pa.Table, assumed: Assumption) -> Flags:
    if assumed.sensor == EVERY_SENSOR:
        return np.ones(rows.num_rows, bool)
    return np.asarray(array(rows, "sensor_id") == assumed.sensor)


def _with_times(rows: pa.Table, assumed: Assumption) -> pa.Table:
    return _moved(rows, assumed, -_ahead_ns(array(rows, "time"), assumed))


def _with_frame_times(exposures: pa.Table, assumed: Assumption) -> pa.Table:
    """Return the exposures; `assumed` says how their times differ from those of the states."""
    to_middle = {"start": 0.5, "middle": 0.0, "end": -0.5}[assumed.frame_time]
    if to_middle == 0.0 and assumed.frames_ahead_s == 0.0:
        return exposures
    later_s = to_middle * array(exposures, "exposure_s") - assumed.frames_ahead_s
    return _moved(exposures, assumed, _in_ns(later_s))


def _moved(rows: pa.Table, assumed: Assumption, later_ns: Nanoseconds) -> pa.Table:
    moved = array(rows, "time") + np.where(_of_sensor(rows, assumed), later_ns, 0)
    return _with_column(rows, "time", pa.array(moved))


def _with_states(states: pa.Table, assumed: Assumption) -> pa.Table:
    of_sensor = _of_sensor(states, assumed)
    if assumed.states != "as stated":
        frame = np.where(of_sensor, assumed.states, array(states, "frame"))
        states = _with_column(states, "frame", pa.array(frame.tolist(), pa.string()))
    return without_velocities(states, of_sensor) if assumed.velocities == "unknown" else states


def _with_line_time(cameras: pa.Table, assumed: Assumption) -> pa.Table:
    if assumed.line_time_s is None:
        return cameras
    stated = array(cameras, "line_time_s")
    line_time_s = np.where(_of_sensor(cameras, assumed), assumed.line_time_s, stated)
    return _with_column(cameras, "line_time_s", pa.array(line_time_s))


def without_velocities(states: pa.Table, rows: Flags | None = None) -> pa.Table:
    """Return states of which those of some rows, or all, have no velocity."""
    of_rows = np.ones(states.num_rows, bool) if rows is None else rows
    for name in VELOCITIES:
        values = states[name].to_numpy().astype(float)
        unknown = of_rows | np.isnan(values)
        states = _with_column(states, name, pa.array(values, mask=unknown))
    return states


def _with_column(rows: pa.Table, name: str, values: pa.Array) -> pa.Table:
    field = rows.schema.field(name)
    return rows.set_column(rows.schema.get_field_index(name), field, values.cast(field.type))
