"""Decoded messages to columns: what is not usable is left out with a reason.

One collector a kind of message. `add` takes what one message alone can tell; what needs
a look at every number is checked for all frames at once in `table`.
"""

import math
import re
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.io.log_rejects import RejectList
from epipole.io.message_decoding import Calibration, Frame, State
from epipole.schemas.bridge import concat, nullable, table, unstack
from epipole.schemas.log_tables import LOG_STATES, STATE_FRAMES
from epipole.schemas.work_tables import CAMERAS, EXPOSURES

Array = npt.NDArray[np.float64]

SENSOR_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,62}")
MAX_FRAME_NUMBER = (1 << 63) - 1
# Below the poles' radius of 6357 km: no sensor is there, whatever its frame and its errors.
EARTH_RADIUS_KM = 6340.0
FARTHEST_KM = 1.0e7  # well behind the Moon; a number in metres lands here
BATCH = 65536  # frames: as Python objects they take several times the memory of a table
QUATERNION_TOLERANCE = 1e-2  # |q| further from 1 is not a rounded unit quaternion


@lru_cache(maxsize=4096)
def valid_sensor_id(sensor_id: str) -> bool:
    """Return whether an id is one: it names folders, so it must not leave them."""
    return SENSOR_ID.fullmatch(sensor_id) is not None


def _fault(time_ns: int | None, sensor_id: str) -> str | None:
    """Return why no message with this time and sensor can be used, if so."""
    if not valid_sensor_id(sensor_id):
        return "bad_sensor_id"
    return "no_timestamp" if time_ns is None else None


def _known(sensor_id: str) -> str | None:
    return sensor_id if valid_sensor_id(sensor_id) else None


@dataclass
class FrameColumns:
    """The frames of a log."""

    rejects: RejectList
    _frames: list[Frame] = field(default_factory=list)
    _offsets: list[int] = field(default_factory=list)
    _tables: list[pa.Table] = field(default_factory=list)

    def add(self, frame: Frame, offset: int, log_time_ns: int) -> None:
        """Take a frame, or leave it out for its time, sensor, number or lengths."""
        reason = _fault(frame.time_ns, frame.sensor_id) or _frame_fault(frame)
        if reason is None:
            self._frames.append(frame)
            self._offsets.append(offset)
            if len(self._frames) == BATCH:
                self._close_batch()
            return
        self.rejects.add(
            reason,
            time_ns=frame.time_ns or log_time_ns,
            offset=offset,
            sensor_id=_known(frame.sensor_id),
        )

    def table(self) -> pa.Table:
        """Return EXPOSURES without the frames that have a number that is none.

        Flux is never relied on: where it is not a positive finite number it is NaN, and the
        frame stays. An exposure that is not one is 0, unknown.
        """
        self._close_batch()
        return concat(EXPOSURES, self._tables)

    def _close_batch(self) -> None:
        self._tables.append(self._batch())
        self._frames, self._offsets = [], []

    def _batch(self) -> pa.Table:
        frames = self._frames
        lengths = np.array([len(f.x_px) for f in frames], np.int64)
        x = _joined([f.x_px for f in frames])
        y = _joined([f.y_px for f in frames])
        sigma, has_sigma = _joined_or_nan([f.sigma_px for f in frames], lengths)
        flux, has_flux = _joined_or_nan([f.flux for f in frames], lengths)
        with np.errstate(invalid="ignore"):
            bad_place = _any(~(np.isfinite(x) & np.isfinite(y)), lengths)
            bad_sigma = _any(~((sigma > 0) & np.isfinite(sigma)), lengths) & has_sigma
            flux[~((flux > 0) & np.isfinite(flux))] = np.nan
        keep = ~(bad_place | bad_sigma)
        self._leave_out(bad_place, "nan")
        self._leave_out(bad_sigma & ~bad_place, "bad_sigma")
        each = np.repeat(keep, lengths)
        rows = np.flatnonzero(keep)
        offsets = np.concatenate([[0], np.cumsum(lengths[keep])])
        exposure = np.array([f.exposure_s for f in frames], float)
        exposure[~((exposure > 0) & np.isfinite(exposure))] = 0.0
        return table(
            EXPOSURES,
            {
                "sensor_id": [frames[i].sensor_id for i in rows],
                "frame_number": np.array([frames[i].frame_number for i in rows], np.int64),
                "time": np.array([frames[i].time_ns for i in rows], np.int64),
                "exposure_s": exposure[keep],
                "x_px": _lists(x[each], offsets, "x_px"),
                "y_px": _lists(y[each], offsets, "y_px"),
                "flux": _lists(flux[each], offsets, "flux", ~has_flux[keep]),
                "sigma_px": _lists(sigma[each], offsets, "sigma_px", ~has_sigma[keep]),
                "source": [self.rejects.source] * len(rows),
                "offset": np.array(self._offsets, np.int64)[keep],
            },
        )

    def _leave_out(self, bad: npt.NDArray[np.bool_], reason: str) -> None:
        for i in np.flatnonzero(bad):
            frame = self._frames[i]
            self.rejects.add(
                reason,
                time_ns=frame.time_ns or 0,
                offset=self._offsets[i],
                sensor_id=frame.sensor_id,
            )


def _frame_fault(frame: Frame) -> str | None:
    if not 0 <= frame.frame_number <= MAX_FRAME_NUMBER:
        return "bad_frame_number"
    n = len(frame.x_px)
    if len(frame.y_px) != n or len(frame.flux) not in (0, n) or len(frame.sigma_px) not in (0, n):
        return "unequal_arrays"
    return None


def _joined(arrays: list[Array]) -> Array:
    with np.errstate(invalid="ignore"):  # a signalling NaN among float32 is still a NaN
        return np.concatenate([np.empty(0), *arrays])


def _joined_or_nan(
    arrays: list[Array], lengths: npt.NDArray[np.int64]
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Return the arrays joined, NaN in place of those left empty, and which are given."""
    given = np.array([len(a) for a in arrays], np.int64) == lengths
    out = np.full(lengths.sum(), np.nan)
    out[np.repeat(given, lengths)] = _joined(arrays)
    return out, given & (lengths > 0)


def _any(bad: npt.NDArray[np.bool_], lengths: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Return for each frame whether any of its centroids is bad."""
    before = np.concatenate([[0], np.cumsum(bad)])
    end = np.cumsum(lengths)
    return before[end] > before[end - lengths]


def _lists(
    flat: Array,
    offsets: npt.NDArray[np.int64],
    name: str,
    null: npt.NDArray[np.bool_] | None = None,
) -> pa.ListArray:
    """Return rows of one list each; where `null`, no list: its values are skipped over."""
    kind = EXPOSURES.field(name).type
    return pa.ListArray.from_arrays(
        pa.array(offsets, pa.int32()),
        pa.array(flat, kind.value_type),
        type=kind,
        mask=None if null is None else pa.array(null),
    )


@dataclass
class StateColumns:
    """The states of a log."""

    rejects: RejectList
    _rows: list[State] = field(default_factory=list)

    def add(self, state: State, offset: int, log_time_ns: int) -> None:
        """Take a state; without its attitude where only that is bad, or leave it out."""
        sensor_id, time_ns = _known(state.sensor_id), state.time_ns or log_time_ns
        reason = _fault(state.time_ns, state.sensor_id) or _state_fault(state)
        if reason is not None:
            self.rejects.add(reason, time_ns=time_ns, offset=offset, sensor_id=sensor_id)
            return
        if len(state.attitude_xyzw):
            attitude = _unit_quaternion(state.attitude_xyzw)
            if len(attitude) == 0:
                self.rejects.add(
                    "bad_attitude", time_ns=time_ns, offset=offset, sensor_id=sensor_id
                )
            state = state._replace(attitude_xyzw=attitude)
        self._rows.append(state)

    def table(self) -> pa.Table:
        """Return LOG_STATES."""
        rows = self._rows
        position = _vectors([s.position_km for s in rows], 3)
        velocity = _vectors([s.velocity_km_s for s in rows], 3)
        attitude = _vectors([s.attitude_xyzw for s in rows], 4)
        values = {
            **unstack("v{}_km_s", velocity),
            **unstack("q{}", attitude, "xyzw"),
        }
        return table(
            LOG_STATES,
            {
                "sensor_id": [s.sensor_id for s in rows],
                "time": np.array([s.time_ns for s in rows], np.int64),
                "frame": [s.frame for s in rows],
                **unstack("{}_km", position),
                **{name: nullable(value) for name, value in values.items()},
                "position_sigma_km": _sigmas([s.position_sigma_km for s in rows]),
                "attitude_sigma_arcsec": _sigmas([s.attitude_sigma_arcsec for s in rows]),
            },
        )


def _state_fault(state: State) -> str | None:
    if state.frame not in STATE_FRAMES:
        return "unknown_frame"
    # A length is finite only if every component is.
    radius_km = math.hypot(*state.position_km)
    if len(state.position_km) != 3 or not radius_km <= FARTHEST_KM:
        return "bad_position"
    velocity = state.velocity_km_s
    if len(velocity) not in (0, 3) or not math.isfinite(math.hypot(*velocity)):
        return "bad_velocity"
    return "inside_earth" if radius_km < EARTH_RADIUS_KM else None


def _unit_quaternion(q: Array) -> Array:
    """Return the quaternion at length 1, or an empty array where it is no unit quaternion."""
    norm = math.hypot(*q) if len(q) == 4 else math.nan
    return q / norm if abs(norm - 1.0) < QUATERNION_TOLERANCE else q[:0]


def _vectors(arrays: list[Array], n: int) -> Array:
    """Return (len(arrays), n) values, NaN where an array is empty."""
    missing = np.full(n, np.nan)
    return np.array([a if len(a) else missing for a in arrays], float).reshape(-1, n)


def _sigmas(values: list[float]) -> Array:
    """Return sigmas, 0 (unknown) where one is not a positive finite number."""
    out = np.array(values, float)
    return np.where(np.isfinite(out) & (out > 0), out, 0.0)


@dataclass
class CameraColumns:
    """The calibrations of a log."""

    rejects: RejectList
    _rows: list[Calibration] = field(default_factory=list)

    def add(self, calibration: Calibration, offset: int, log_time_ns: int) -> None:
        """Take a calibration, or leave it out with a reason.

        One without a time holds from when it was logged.
        """
        time_ns = calibration.time_ns or log_time_ns or None
        reason = _fault(time_ns, calibration.sensor_id) or _camera_fault(calibration)
        if reason is None:
            self._rows.append(calibration._replace(time_ns=time_ns))
            return
        self.rejects.add(
            reason,
            time_ns=time_ns or 0,
            offset=offset,
            sensor_id=_known(calibration.sensor_id),
        )

    def table(self) -> pa.Table:
        """Return CAMERAS."""
        rows = self._rows
        matrices = _vectors([c.K for c in rows], 9)
        distortion = np.zeros((len(rows), 5))
        for i, c in enumerate(rows):
            distortion[i, : len(c.D)] = c.D
        return table(
            CAMERAS,
            {
                "sensor_id": [c.sensor_id for c in rows],
                "time": np.array([c.time_ns for c in rows], np.int64),
                "width": np.array([c.width for c in rows], np.int64),
                "height": np.array([c.height for c in rows], np.int64),
                "fx_px": matrices[:, 0],
                "fy_px": matrices[:, 4],
                "cx_px": matrices[:, 2],
                "cy_px": matrices[:, 5],
                **unstack("{}", distortion, ("k1", "k2", "p1", "p2", "k3")),
            },
        )


def _camera_fault(calibration: Calibration) -> str | None:
    if calibration.width <= 0 or calibration.height <= 0:
        return "bad_image_size"
    if calibration.distortion_model not in ("", "plumb_bob"):
        return "unknown_distortion_model"
    if len(calibration.D) not in (0, 4, 5) or not np.isfinite(calibration.D).all():
        return "bad_distortion"
    K = calibration.K
    if len(K) != 9 or not np.isfinite(K).all() or K[0] <= 0 or K[4] <= 0:
        return "bad_camera_matrix"
    # A skewed or scaled matrix is a camera that the pipeline has no model of.
    zeros, scale = (K[1], K[3], K[6], K[7]), 1e-9 * K[0]
    if any(abs(k) > scale for k in zeros) or abs(K[8] - 1.0) > 1e-9:
        return "bad_camera_matrix"
    return None
