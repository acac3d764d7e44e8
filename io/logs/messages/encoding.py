"""Messages to bytes: protobuf, JSON and ROS 2 CDR.

Encoders are plain functions of one message. Protobuf is written field by field rather
than through a message object: the packed arrays are the array's own bytes, which makes
a frame cost a few microseconds.
"""

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration

from epipole.schemas.messages import CENTROID_FRAME, SENSOR_STATE, MessageType

Values = Mapping[str, Any]
SECOND_NS = 1_000_000_000


def varint(value: int) -> bytes:
    """Return an unsigned integer in protobuf's base-128 form."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _protobuf_time(time_ns: int) -> bytes:
    seconds, nanos = divmod(time_ns, SECOND_NS)
    body = b""
    if seconds:
        body += b"\x08" + varint(seconds & 0xFFFFFFFFFFFFFFFF)
    if nanos:
        body += b"\x10" + varint(nanos)
    return varint(len(body)) + body


def _tag(number: int, wire_type: int) -> bytes:
    return varint(number << 3 | wire_type)


# Of each field: name, kind, whether an array, tag, NumPy type of its numbers.
_WIRE = {"time": 2, "string": 2, "uint64": 0, "double": 1, "float": 5}
_NUMBERS = {"double": "<f8", "float": "<f4"}
_PLANS = {
    message.name: [
        (m.name, m.kind, m.repeated, _tag(m.number, 2 if m.repeated else _WIRE[m.kind]))
        for m in message.members
    ]
    for message in (CENTROID_FRAME, SENSOR_STATE)
}


def encode_protobuf(message: MessageType, values: Values) -> bytes:
    """Return a message as protobuf; what is zero or empty is left out, as proto3 does."""
    parts: list[bytes] = []
    for name, kind, repeated, tag in _PLANS[message.name]:
        value = values[name]
        if repeated:
            if value is not None and len(value):
                body = np.asarray(value, _NUMBERS[kind]).tobytes()
                parts += (tag, varint(len(body)), body)
        elif kind == "time":
            parts += (tag, _protobuf_time(value))
        elif kind == "string":
            if value:
                body = value.encode()
                parts += (tag, varint(len(body)), body)
        elif kind == "uint64":
            if value:
                parts += (tag, varint(value))
        elif value:
            parts += (tag, struct.pack("<d", value))
    return b"".join(parts)


def encode_json(message: MessageType, values: Values) -> bytes:
    """Return a message as JSON; numbers have the digits that give the same float again."""
    out: dict[str, Any] = {}
    for member in message.members:
        value = values[member.name]
        if member.repeated:
            numbers = np.asarray([] if value is None else value, _NUMBERS[member.kind])
            out[member.name] = numbers.tolist()
        elif member.kind == "time":
            out[member.name] = _json_time(value)
        else:
            out[member.name] = value
    return json.dumps(out, separators=(",", ":")).encode()


def _json_time(time_ns: int) -> dict[str, int]:
    seconds, nanos = divmod(time_ns, SECOND_NS)
    return {"sec": seconds, "nsec": nanos}


class CdrWriter:
    """Bytes of one ROS 2 message: little-endian CDR, each number aligned to its own size."""

    def __init__(self) -> None:
        self._body = bytearray()

    def put(self, kind: str, value: Any) -> None:
        """Add one number of a `struct` type."""
        size = struct.calcsize(kind)
        self._body += b"\0" * (-len(self._body) % size) + struct.pack("<" + kind, value)

    def put_time(self, time_ns: int) -> None:
        """Add a builtin_interfaces/Time."""
        seconds, nanos = divmod(time_ns, SECOND_NS)
        self.put("i", seconds)
        self.put("I", nanos)

    def put_string(self, text: str) -> None:
        """Add a string: its length with the final zero, its bytes, the zero."""
        body = text.encode() + b"\0"
        self.put("I", len(body))
        self._body += body

    def put_numbers(self, numbers: Any, dtype: str, counted: bool = True) -> None:
        """Add an array, with its length before it unless its type fixes that."""
        values = np.asarray([] if numbers is None else numbers, dtype)
        if counted:
            self.put("I", len(values))
        if len(values):  # an empty sequence has no padding
            self._body += b"\0" * (-len(self._body) % values.itemsize) + values.tobytes()

    def message(self) -> bytes:
        """Return the message with its encapsulation header."""
        return b"\x00\x01\x00\x00" + bytes(self._body)


def encode_cdr(message: MessageType, values: Values) -> bytes:
    """Return a message as ROS 2 CDR."""
    out = CdrWriter()
    for member in message.members:
        value = values[member.name]
        if member.repeated:
            out.put_numbers(value, _NUMBERS[member.kind])
        elif member.kind == "time":
            out.put_time(value)
        elif member.kind == "string":
            out.put_string(value)
        else:
            out.put("Q" if member.kind == "uint64" else "d", value)
    return out.message()


def encode_calibration(encoding: str, sensor_id: str, time_ns: int, camera: Values) -> bytes:
    """Return a camera as foxglove.CameraCalibration, or sensor_msgs/msg/CameraInfo in ROS 2.

    Parameters
    ----------
    encoding
        protobuf, json or cdr.
    camera
        width, height, fx_px, fy_px, cx_px, cy_px, k1, k2, p1, p2, k3.
    """
    fx, fy, cx, cy = (float(camera[n]) for n in ("fx_px", "fy_px", "cx_px", "cy_px"))
    size: dict[str, Any] = {"width": int(camera["width"]), "height": int(camera["height"])}
    matrices: dict[str, Any] = {
        "D": [float(camera[n]) for n in ("k1", "k2", "p1", "p2", "k3")],
        "K": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        "R": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "P": [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    }
    model = "plumb_bob"
    if encoding == "protobuf":
        message = CameraCalibration(frame_id=sensor_id, distortion_model=model, **size, **matrices)
        message.timestamp.seconds, message.timestamp.nanos = divmod(time_ns, SECOND_NS)
        return bytes(message.SerializeToString(deterministic=True))
    if encoding == "json":
        values = {"timestamp": _json_time(time_ns), "frame_id": sensor_id, **size}
        text = json.dumps({**values, "distortion_model": model, **matrices}, separators=(",", ":"))
        return text.encode()
    out = CdrWriter()
    out.put_time(time_ns)
    out.put_string(sensor_id)
    out.put("I", size["height"])
    out.put("I", size["width"])
    out.put_string(model)
    for name in "DKRP":
        out.put_numbers(matrices[name], "<f8", counted=name == "D")
    for _ in range(6):  # binning x and y, region of interest: none
        out.put("I", 0)
    out.put("B", 0)
    return out.message()
