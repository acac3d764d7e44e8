"""Bytes to messages: protobuf, JSON and ROS 2 CDR, all to the same plain records."""

import json
import re
import struct
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import orjson
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from google.protobuf.message import DecodeError

from epipole.schemas.messages import (
    CALIBRATION,
    CENTROID_FRAME,
    FRAME,
    OWN_MESSAGES,
    SENSOR_STATE,
    STATE,
    MessageType,
    json_name,
    message_class,
)

Array = npt.NDArray[Any]
SECOND_NS = 1_000_000_000


class UndecodableError(Exception):
    """Bytes that are no message of the kind their channel promises."""


class Frame(NamedTuple):
    """A CentroidFrame; `time_ns` is None where the message has no time."""

    time_ns: int | None
    sensor_id: str
    frame_number: int
    exposure_s: float
    x_px: Array
    y_px: Array
    flux: Array
    sigma_px: Array


class State(NamedTuple):
    """A SensorState."""

    time_ns: int | None
    sensor_id: str
    frame: str
    position_km: Array
    velocity_km_s: Array
    position_sigma_km: float
    attitude_xyzw: Array
    attitude_sigma_arcsec: float


class Calibration(NamedTuple):
    """A CameraCalibration or CameraInfo, as far as it is used."""

    time_ns: int | None
    sensor_id: str
    width: int
    height: int
    distortion_model: str
    D: Array
    K: Array


Record = Frame | State | Calibration
_RECORDS: dict[str, Callable[..., Record]] = {FRAME: Frame, STATE: State}
ENCODINGS = ("protobuf", "json", "cdr")


def decoder(carries: str, encoding: str) -> Callable[[bytes], Record]:
    """Return the function that decodes messages of a kind (frame, state or calibration).

    It raises `UndecodableError` and nothing else, whatever the bytes are.
    """
    decode = _DECODERS[encoding, carries]

    def decode_safely(data: bytes) -> Record:
        try:
            return decode(data)
        except (
            DecodeError,
            UnicodeDecodeError,
            ValueError,
            TypeError,
            KeyError,
            AttributeError,
            OverflowError,
            RecursionError,
            struct.error,
        ) as error:
            raise UndecodableError(f"{type(error).__name__}: {error}") from error

    return decode_safely


def _time(seconds: int, nanos: int) -> int | None:
    """Return nanoseconds since 1970, or None for a time that no log can have."""
    if not 0 <= nanos < SECOND_NS or not 0 <= seconds < 9_223_372_036:
        return None
    # A clock that was never set, or a field that was never filled.
    return seconds * SECOND_NS + nanos or None


# Protobuf


def _protobuf_time(message: Any) -> int | None:
    if not message.HasField("timestamp"):
        return None
    return _time(message.timestamp.seconds, message.timestamp.nanos)


def _parse_protobuf(message_type: MessageType, data: bytes) -> Any:
    """Return the message with its arrays as bytes, or, where that does not give back every
    byte (unpacked arrays, arrays in pieces, unknown fields), with its arrays as numbers."""
    message = message_class(message_type.name, True)()
    message.ParseFromString(data)
    message.DiscardUnknownFields()
    if message.ByteSize() == len(data):
        return message
    message = message_class(message_type.name)()
    message.ParseFromString(data)
    return message


def _protobuf_numbers(value: Any, dtype: str) -> Array:
    if isinstance(value, bytes):
        return np.frombuffer(value, dtype)
    return np.array(value, dtype)


def _frame_from_protobuf(data: bytes) -> Frame:
    m = _parse_protobuf(CENTROID_FRAME, data)
    return Frame(
        _protobuf_time(m),
        m.sensor_id,
        m.frame_number,
        m.exposure_s,
        _protobuf_numbers(m.x_px, "<f4"),
        _protobuf_numbers(m.y_px, "<f4"),
        _protobuf_numbers(m.flux, "<f4"),
        _protobuf_numbers(m.sigma_px, "<f4"),
    )


def _state_from_protobuf(data: bytes) -> State:
    m = _parse_protobuf(SENSOR_STATE, data)
    return State(
        _protobuf_time(m),
        m.sensor_id,
        m.frame,
        _protobuf_numbers(m.position_km, "<f8"),
        _protobuf_numbers(m.velocity_km_s, "<f8"),
        m.position_sigma_km,
        _protobuf_numbers(m.attitude_xyzw, "<f8"),
        m.attitude_sigma_arcsec,
    )


def _calibration_from_protobuf(data: bytes) -> Calibration:
    m = CameraCalibration.FromString(data)
    return Calibration(
        _protobuf_time(m),
        m.frame_id,
        m.width,
        m.height,
        m.distortion_model,
        np.array(m.D, float),
        np.array(m.K, float),
    )


# JSON

_RFC3339 = re.compile(r"(\d{4}-\d\d-\d\d[Tt]\d\d:\d\d:\d\d)(?:\.(\d{1,9}))?([Zz]|[+-]\d\d:\d\d)")


def _json_time(value: Any) -> int | None:
    """Return the time of {"sec", "nsec"}, or of protobuf's JSON mapping, an RFC 3339 text."""
    if value is None:
        return None
    if isinstance(value, str):
        match = _RFC3339.fullmatch(value)
        if match is None:
            raise ValueError(f"time {value!r}")
        zone = "+00:00" if match[3] in "Zz" else match[3]
        seconds = int((datetime.fromisoformat(match[1] + zone) - _EPOCH).total_seconds())
        return _time(seconds, int((match[2] or "0").ljust(9, "0")))
    nanos = value["nsec"] if "nsec" in value else value.get("nanosec", value.get("nanos", 0))
    return _time(int(value["sec"] if "sec" in value else value["seconds"]), int(nanos))


_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def _json_values(data: bytes) -> Mapping[str, Any]:
    try:
        values = orjson.loads(data)
    except orjson.JSONDecodeError:
        values = json.loads(data)  # knows NaN and Infinity too, which some writers put there
    if not isinstance(values, dict):
        raise ValueError("not an object")
    return values


def _json_array(value: Any) -> Array:
    array = np.array([] if value is None else value, dtype=float)
    if array.ndim != 1:
        raise ValueError("not a list of numbers")
    return array


def _json_text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError("not a text")
    return value


def _json_integer(value: Any) -> int:
    number = int(value)
    if isinstance(value, float) and value != number:
        raise ValueError("not an integer")
    return number


_JSON_KINDS: dict[str, tuple[Callable[[Any], Any], Any]] = {
    "time": (_json_time, None),
    "string": (_json_text, ""),
    "uint64": (_json_integer, 0),
    "double": (float, 0.0),
    "float": (float, 0.0),
}


def _from_json(carries: str) -> Callable[[bytes], Record]:
    members = OWN_MESSAGES[carries].members
    plan = [
        (
            m.name,
            json_name(m.name),
            *((_json_array, None) if m.repeated else _JSON_KINDS[m.kind]),
        )
        for m in members
    ]

    def decode(data: bytes) -> Record:
        values = _json_values(data)
        return _RECORDS[carries](
            *[
                convert(values[name] if name in values else values.get(other, default))
                for name, other, convert, default in plan
            ]
        )

    return decode


def _calibration_from_json(data: bytes) -> Calibration:
    values = _json_values(data)
    return Calibration(
        _json_time(values.get("timestamp")),
        _json_text(values.get("frame_id", values.get("frameId", ""))),
        _json_integer(values.get("width", 0)),
        _json_integer(values.get("height", 0)),
        _json_text(values.get("distortion_model", values.get("distortionModel", ""))),
        _json_array(values.get("D")),
        _json_array(values.get("K")),
    )


# ROS 2 CDR


class _CdrReader:
    """Reads one message front to back; raises struct.error or ValueError where it is short."""

    def __init__(self, data: bytes) -> None:
        if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1, 6, 7):
            raise ValueError("no CDR header")
        self._data, self._at = data, 4
        self._order = "<" if data[1] & 1 else ">"
        self._widest = 4 if data[1] > 1 else 8  # XCDR2 aligns to 4 at most

    def number(self, kind: str) -> Any:
        size = struct.calcsize(kind)
        self._align(size)
        (value,) = struct.unpack_from(self._order + kind, self._data, self._at)
        self._at += size
        return value

    def _align(self, size: int) -> None:
        self._at += -(self._at - 4) % min(size, self._widest)

    def time(self) -> int | None:
        return _time(self.number("i"), self.number("I"))

    def text(self) -> str:
        length = self.number("I")
        body = self._take(length)
        return body[:-1].decode() if body.endswith(b"\0") else body.decode()

    def numbers(self, kind: str, count: int | None = None) -> Array:
        count = self.number("I") if count is None else count
        dtype = np.dtype(self._order + kind)
        if count:
            self._align(dtype.itemsize)
        return np.frombuffer(self._take(count * dtype.itemsize), dtype)

    def _take(self, length: int) -> bytes:
        if self._at + length > len(self._data):
            raise ValueError("message ends early")
        self._at += length
        return self._data[self._at - length : self._at]


_CDR_NUMBERS = {"double": "f8", "float": "f4"}


def _from_cdr(carries: str) -> Callable[[bytes], Record]:
    members = OWN_MESSAGES[carries].members

    def decode(data: bytes) -> Record:
        reader = _CdrReader(data)
        values: list[Any] = []
        for member in members:
            if member.repeated:
                values.append(reader.numbers(_CDR_NUMBERS[member.kind]))
            elif member.kind == "time":
                values.append(reader.time())
            elif member.kind == "string":
                values.append(reader.text())
            else:
                values.append(reader.number("Q" if member.kind == "uint64" else "d"))
        return _RECORDS[carries](*values)

    return decode


def _calibration_from_cdr(data: bytes) -> Calibration:
    reader = _CdrReader(data)
    time_ns, sensor_id = reader.time(), reader.text()
    height, width = reader.number("I"), reader.number("I")
    model = reader.text()
    distortion, matrix = reader.numbers("f8"), reader.numbers("f8", 9)
    return Calibration(time_ns, sensor_id, width, height, model, distortion, matrix)


_DECODERS: dict[tuple[str, str], Callable[[bytes], Record]] = {
    ("protobuf", FRAME): _frame_from_protobuf,
    ("protobuf", STATE): _state_from_protobuf,
    ("protobuf", CALIBRATION): _calibration_from_protobuf,
    ("json", FRAME): _from_json(FRAME),
    ("json", STATE): _from_json(STATE),
    ("json", CALIBRATION): _calibration_from_json,
    ("cdr", FRAME): _from_cdr(FRAME),
    ("cdr", STATE): _from_cdr(STATE),
    ("cdr", CALIBRATION): _calibration_from_cdr,
}
