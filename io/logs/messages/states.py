"""The states of a log as LOG_STATES."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.io.logs.left_out import RejectList
from epipole.io.logs.messages.batches import MessageBatch, Received, fault, known_id
from epipole.io.logs.messages.encoding import StateMessage
from epipole.io.logs.messages.scan import NameCodes, StateRows, scan_states
from epipole.schemas.bridge import nullable, table, unstack
from epipole.schemas.log_bounds import (
    ARCSEC_OF_HALF_A_TURN,
    ATTITUDE_SIGMA,
    POSITION,
    POSITION_SIGMA,
    QUATERNION,
    SPEED,
)
from epipole.schemas.rejects import Reason
from epipole.schemas.work_tables import LOG_STATES, STATE_FRAMES

Array = npt.NDArray[np.floating]

BATCH = 16384  # states in one table of those that are joined
ROW_BYTES = 150  # in the table
_FRAMES = NameCodes(STATE_FRAMES)


def _new_rows(n: int) -> StateRows:
    return StateRows(
        np.empty(n, np.int32),
        np.empty(n, np.int32),
        np.empty(n, np.int64),
        *(np.empty((n, width)) for width in (3, 3, 4, 2)),
    )


@dataclass
class StateColumns:
    """The states of a log; `as_meant` returns a message as it was meant, before it is judged."""

    rejects: RejectList
    as_meant: Callable[[StateMessage], StateMessage] | None = None
    _sensors: NameCodes = field(default_factory=NameCodes)
    _rows: StateRows = field(default_factory=lambda: _new_rows(0))
    _n: int = 0
    _tables: list[pa.Table] = field(default_factory=list)
    _table_bytes: int = 0

    def add(self, batch: MessageBatch) -> None:
        """Take the valid states; where only the attitude is invalid, the state stays without it."""
        messages = batch.messages
        if self._n + len(batch) > len(self._rows.time_ns):
            self._close()
            self._rows = _new_rows(max(len(batch), BATCH))
        sensors, frames = self._sensors.table, _FRAMES.table

        def scan(i: int) -> int:
            stopped, self._n = scan_states(messages, i, sensors, frames, self._rows, self._n)
            return int(stopped)

        # Only decoded messages can be read otherwise than they state.
        batch.take(scan if self.as_meant is None else lambda i: i, self._judge)

    @property
    def n_bytes(self) -> int:
        """About the size of the rows that have not been taken."""
        return self._n * ROW_BYTES + self._table_bytes

    def take(self) -> pa.Table:
        """Return LOG_STATES of the states since the last call, in the order of the log."""
        self._close()
        tables, self._tables, self._table_bytes = self._tables, [], 0
        return pa.concat_tables([LOG_STATES.empty_table(), *tables])

    def _close(self) -> None:
        """Make a table of the rows so far."""
        rows = StateRows._make(column[: self._n] for column in self._rows)
        self._n = 0
        if len(rows.time_ns) == 0:
            return
        q = rows.q / np.linalg.norm(rows.q, axis=1, keepdims=True)
        optional = {**unstack("v{}_km_s", rows.v_km_s), **unstack("q{}", q, "xyzw")}
        # A sigma that is not a positive finite number is unknown.
        sigma = np.where(np.isfinite(rows.sigma) & (rows.sigma > 0), rows.sigma, 0.0)
        states = table(
            LOG_STATES,
            {
                "sensor_id": self._sensors.strings(rows.sensor),
                "time": rows.time_ns,
                "frame": _FRAMES.strings(rows.frame),
                **{name: values.copy() for name, values in unstack("{}_km", rows.r_km).items()},
                **{name: nullable(values) for name, values in optional.items()},
                "position_sigma_km": sigma[:, 0].copy(),
                "attitude_sigma_arcsec": sigma[:, 1].copy(),
            },
        )
        self._tables.append(states)
        self._table_bytes += states.nbytes

    def _judge(self, received: Sequence[Received]) -> None:
        """Take decoded states; invalid ones become rejects."""
        for item in received:
            state: StateMessage = item.message
            if self.as_meant is not None:
                state = self.as_meant(state)
            reason = fault(state.time_ns, state.sensor_id) or _state_fault(state)
            if reason is not None:
                self._leave_out(item, reason)
                continue
            if _is_without_attitude(state):
                state = state._replace(attitude_xyzw=state.attitude_xyzw[:0])
            elif (reason := _attitude_fault(state)) is not None:
                self._leave_out(item, reason)
                state = state._replace(attitude_xyzw=state.attitude_xyzw[:0])
            self._write(state, item.message.time_ns)

    def _leave_out(self, item: Received, reason: Reason) -> None:
        self.rejects.add(
            reason,
            time_ns=item.message.time_ns or item.log_time_ns,
            offset=item.offset,
            sensor_id=known_id(item.message.sensor_id),
        )

    def _write(self, state: StateMessage, time_ns: int) -> None:
        rows, n = self._rows, self._n
        rows.sensor[n] = self._sensors.code(state.sensor_id)
        rows.frame[n] = _FRAMES.code(state.frame)
        rows.time_ns[n] = time_ns
        rows.r_km[n] = state.position_km
        rows.v_km_s[n] = state.velocity_km_s if len(state.velocity_km_s) else np.nan
        rows.q[n] = state.attitude_xyzw if len(state.attitude_xyzw) else np.nan
        rows.sigma[n] = state.position_sigma_km, state.attitude_sigma_arcsec
        self._n = n + 1


def _state_fault(state: StateMessage) -> Reason | None:
    if state.frame not in STATE_FRAMES:
        return Reason.UNKNOWN_FRAME
    # The length is finite only if every component is finite.
    radius_km = math.hypot(*state.position_km)
    if len(state.position_km) != 3 or not radius_km <= POSITION.maximum:
        return POSITION.reason
    velocity = state.velocity_km_s
    if len(velocity) not in (0, 3) or math.hypot(*velocity) not in SPEED:
        return SPEED.reason
    if state.position_sigma_km > POSITION_SIGMA.maximum:
        return POSITION_SIGMA.reason
    return Reason.INSIDE_EARTH if radius_km < POSITION.minimum else None


def _is_without_attitude(state: StateMessage) -> bool:
    """Return whether the state has no attitude, or says that it may be any."""
    return len(state.attitude_xyzw) == 0 or state.attitude_sigma_arcsec >= ARCSEC_OF_HALF_A_TURN


def _attitude_fault(state: StateMessage) -> Reason | None:
    q = state.attitude_xyzw
    if len(q) != 4 or math.hypot(*q) not in QUATERNION:
        return QUATERNION.reason
    return ATTITUDE_SIGMA.reason if state.attitude_sigma_arcsec > ATTITUDE_SIGMA.maximum else None
