"""Decoded messages: the same plain values, whatever encoding they came in."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.floating]

SECOND_NS = 1_000_000_000
MAX_SECONDS = 9_223_372_035  # whole seconds that fit into 64 bits of nanoseconds


class FrameMessage(NamedTuple):
    """A CentroidFrame; `time_ns` is None where the message has no valid time."""

    time_ns: int | None
    sensor_id: str
    frame_number: int
    exposure_s: float
    x_px: Array
    y_px: Array
    flux: Array
    sigma_px: Array


class StateMessage(NamedTuple):
    """A SensorState; `time_ns` is None where the message has no valid time."""

    time_ns: int | None
    sensor_id: str
    frame: str
    position_km: Array
    velocity_km_s: Array
    position_sigma_km: float
    attitude_xyzw: Array
    attitude_sigma_arcsec: float


class CalibrationMessage(NamedTuple):
    """The fields of a CameraCalibration or CameraInfo that are used."""

    time_ns: int | None
    sensor_id: str
    width: int
    height: int
    distortion_model: str
    D: Array
    K: Array


DecodedMessage = FrameMessage | StateMessage | CalibrationMessage


def valid_time_ns(seconds: int, nanos: int) -> int | None:
    """Return nanoseconds since 1970, or None for an invalid time.

    Zero is invalid too: the clock was never set, or the field was never filled.
    """
    if not 0 <= nanos < SECOND_NS or not 0 <= seconds <= MAX_SECONDS:
        return None
    return seconds * SECOND_NS + nanos or None
