"""What an encoding of messages has to define: decoded messages, functions, and field segments."""

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.schemas.arrays import Integers
from epipole.schemas.log_messages import DECLARED, FRAME, STATE, MessageType

# Decoded messages: the same plain values in every encoding.

Array = npt.NDArray[np.floating]

SECOND_NS = 1_000_000_000
MAX_SECONDS = 9_223_372_035  # whole seconds that fit into 64 bits of nanoseconds


class FrameMessage(NamedTuple):
    """A CentroidFrame; `time_ns`: None without a valid time."""

    time_ns: int | None
    sensor_id: str
    frame_number: int
    exposure_s: float
    x_px: Array
    y_px: Array
    flux: Array
    sigma_px: Array


class StateMessage(NamedTuple):
    """A SensorState; `time_ns`: None without a valid time."""

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
    line_time_s: float = 0.0


DecodedMessage = FrameMessage | StateMessage | CalibrationMessage


def valid_time_ns(seconds: int, nanos: int) -> int | None:
    """Return nanoseconds since 1970, or None for an invalid time.

    Zero is invalid too: the clock was never set, or the field was never filled.
    """
    if not 0 <= nanos < SECOND_NS or not 0 <= seconds <= MAX_SECONDS:
        return None
    return seconds * SECOND_NS + nanos or None


# The definition of an encoding.

# Fields by name. A calibration has timestamp, frame_id, width, height, distortion_model, D, K, R
# and P, and line_time_s where it is not 0; the other kinds have the fields that
# `epipole.schemas.log_messages` declares.
Values = Mapping[str, Any]

# What decoders raise where bytes are not a message. Whatever else they raise is a bug.
_INVALID = (
    ValueError,
    TypeError,
    KeyError,
    AttributeError,
    OverflowError,
    RecursionError,
    struct.error,
)


class UndecodableError(Exception):
    """Bytes that are not a message of the kind that their channel declares."""


@dataclass(frozen=True)
class MessageEncoding:
    """One way to write messages as bytes; a kind of message is FRAME, STATE or CALIBRATION.

    `registry` gives it the name that people use, such as ``--encoding ros2``.
    """

    message_encoding: str  # as MCAP names it in channels
    schema_encoding: str  # as MCAP names it in schemas
    schema_names: Mapping[str, tuple[str, ...]]  # by kind; the first is written, all are read
    schema: Callable[[str], bytes]  # the content of the MCAP schema of a kind
    encode: Callable[[str, Values], bytes]  # a message of a kind; `timestamp` is in ns
    decode: Callable[[str, bytes], DecodedMessage]  # the same back; raises one of `_INVALID`
    # A compiled loop (data, start, end, mine, types, fields) that fills `fields` (see "Located
    # fields" below) for the messages that are `mine`. Without one, messages are decoded
    # one at a time, which is slower and gives the same rows.
    locate: Callable[..., None] | None = None
    profile: str = ""  # the MCAP profile of a log that is written

    def decoded(self, kind: str, data: bytes) -> DecodedMessage:
        """Return the message that the bytes are.

        Raises
        ------
        UndecodableError
            Where they are not one; nothing else is raised, whatever the bytes are.
        """
        try:
            return self.decode(kind, data)
        except _INVALID as error:
            raise UndecodableError(f"{type(error).__name__}: {error}") from error


# Located fields: where the fields of messages are in the bytes of a chunk.
#
# An encoding may have a compiled loop that finds them (`MessageEncoding.locate`). It fills one row
# of integers per message. Column 0 is 1 where the message is well formed and has a valid time, else
# 0. Columns 2 f and 2 f + 1 are of field number f: the time [ns], the integer or the bits of the
# double; or the offset and the length of the text or array; 0 and 0 where the field was not sent.


# The type of a field; UNKNOWN is a field number that the message does not declare.
UNKNOWN, TIME, TEXT, INTEGER, DOUBLE, FLOATS, DOUBLES = range(7)
_SCALARS = {"time": TIME, "string": TEXT, "uint64": INTEGER, "double": DOUBLE}
_ARRAYS = {"float": FLOATS, "double": DOUBLES}


def _field_types(message: MessageType) -> Integers:
    """Return the type of each field of a message, by its number."""
    types = np.full(len(message.members) + 1, UNKNOWN, np.int64)
    for number, member in enumerate(message.members, start=1):
        if member.number != number:
            raise ValueError(f"{message.name}: {member.name} must be field {number}")
        types[number] = _ARRAYS[member.type] if member.repeated else _SCALARS[member.type]
    return types


FIELD_TYPES = {kind: _field_types(DECLARED[kind]) for kind in (FRAME, STATE)}


def no_fields(kind: str, n: int) -> Integers:
    """Return rows of `n` messages in which nothing has been located."""
    return np.zeros((n, 2 * len(FIELD_TYPES[kind])), np.int64)
