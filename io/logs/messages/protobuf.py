"""Messages as protobuf.

They are encoded field by field and not through a message object. A packed array is then the
array's bytes, and a frame takes a few microseconds.
"""

import struct
from functools import cache
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from google.protobuf.message import DecodeError

from epipole.io.logs.mcap.record_scan import kernel, load_uint64
from epipole.io.logs.messages.encoding import (
    DOUBLE,
    DOUBLES,
    FLOATS,
    INTEGER,
    MAX_SECONDS,
    SECOND_NS,
    TEXT,
    TIME,
    UNKNOWN,
    Array,
    CalibrationMessage,
    DecodedMessage,
    FrameMessage,
    MessageEncoding,
    StateMessage,
    Values,
    valid_time_ns,
)
from epipole.schemas.log_messages import (
    CALIBRATION,
    CALIBRATION_NAME,
    CENTROID_FRAME,
    DECLARED,
    FRAME,
    LINE_TIME,
    SENSOR_STATE,
    STATE,
    MessageType,
)

# Schemas

_FieldProto = descriptor_pb2.FieldDescriptorProto
_TYPES = {
    "time": _FieldProto.TYPE_MESSAGE,
    "string": _FieldProto.TYPE_STRING,
    "uint64": _FieldProto.TYPE_UINT64,
    "double": _FieldProto.TYPE_DOUBLE,
    "float": _FieldProto.TYPE_FLOAT,
}


def file_descriptor(arrays_as_bytes: bool = False) -> descriptor_pb2.FileDescriptorProto:
    """Return the declared messages as a protobuf file, as a compiled `epipole.proto` would be.

    With `arrays_as_bytes` the repeated numbers are declared as bytes, which are encoded in the same
    way as a packed array. Arrays are then read as bytes, without a Python object per number.
    """
    file = descriptor_pb2.FileDescriptorProto(
        name="epipole.proto",
        package="epipole",
        syntax="proto3",
        dependency=["google/protobuf/timestamp.proto"],
    )
    for message in DECLARED.values():
        declared = file.message_type.add(name=message.name.rpartition(".")[2])
        for member in message.members:
            field = declared.field.add(
                name=member.name,
                number=member.number,
                label=_FieldProto.LABEL_OPTIONAL,
                type=_TYPES[member.type],
                json_name=json_name(member.name),
            )
            if member.type == "time":
                field.type_name = ".google.protobuf.Timestamp"
            if member.repeated and arrays_as_bytes:
                field.type = _FieldProto.TYPE_BYTES
            elif member.repeated:
                field.label = _FieldProto.LABEL_REPEATED
    return file


def json_name(name: str) -> str:
    """Return the name of a field in protobuf's JSON mapping: ``xPx`` for ``x_px``."""
    first, *rest = name.split("_")
    return first + "".join(word.capitalize() for word in rest)


@cache
def message_class(message: MessageType, arrays_as_bytes: bool = False) -> Any:
    """Return the protobuf class of a declared message; see `file_descriptor`."""
    pool = descriptor_pool.DescriptorPool()  # not the default: a user's epipole_pb2 may be there
    pool.AddSerializedFile(timestamp_pb2.DESCRIPTOR.serialized_pb)
    pool.Add(file_descriptor(arrays_as_bytes))
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(message.name))


def protobuf_schema(kind: str) -> bytes:
    """Return the content of an MCAP schema of encoding `protobuf`: the file and all it needs."""
    files = descriptor_pb2.FileDescriptorSet()
    if kind == CALIBRATION:
        add_file(files, CameraCalibration.DESCRIPTOR.file)
        _declare_line_time(files.file[-1])
    else:
        add_file(files, timestamp_pb2.DESCRIPTOR)
        files.file.append(file_descriptor())
    return files.SerializeToString(deterministic=True)


def _declare_line_time(file: descriptor_pb2.FileDescriptorProto) -> None:
    """Add the field of the line time to the file of a calibration."""
    message = next(m for m in file.message_type if m.name == CALIBRATION_NAME.rpartition(".")[2])
    message.field.add(
        name=LINE_TIME.name,
        number=LINE_TIME.number,
        label=_FieldProto.LABEL_OPTIONAL,
        type=_TYPES[LINE_TIME.type],
        json_name=json_name(LINE_TIME.name),
    )


@cache
def calibration_class() -> Any:
    """Return the protobuf class of a calibration, with its line time."""
    pool = descriptor_pool.DescriptorPool()
    files = descriptor_pb2.FileDescriptorSet.FromString(protobuf_schema(CALIBRATION))
    for file in files.file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(CALIBRATION_NAME))


def add_file(files: descriptor_pb2.FileDescriptorSet, file: Any) -> None:
    """Add a schema's file, and those that it needs, unless they are there."""
    for dependency in file.dependencies:
        add_file(files, dependency)
    if file.name not in [added.name for added in files.file]:
        file.CopyToProto(files.file.add())


# Messages to bytes


def varint(value: int) -> bytes:
    """Return an unsigned integer in protobuf's base-128 form."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _timestamp(time_ns: int) -> bytes:
    seconds, nanos = divmod(time_ns, SECOND_NS)
    body = b""
    if seconds:
        body += b"\x08" + varint(seconds & 0xFFFFFFFFFFFFFFFF)
    if nanos:
        body += b"\x10" + varint(nanos)
    return varint(len(body)) + body


_WIRE = {"time": 2, "string": 2, "uint64": 0, "double": 1, "float": 5}
_NUMBERS = {"double": "<f8", "float": "<f4"}
# For each kind of message, its fields: name, type, whether it is an array, tag.
_PLANS = {
    kind: [
        (m.name, m.type, m.repeated, varint(m.number << 3 | (2 if m.repeated else _WIRE[m.type])))
        for m in message.members
    ]
    for kind, message in DECLARED.items()
}


def encode(kind: str, values: Values) -> bytes:
    """Return a message as protobuf; a field that is zero or empty is not sent, as in proto3."""
    if kind == CALIBRATION:
        return _encode_calibration(values)
    pieces: list[bytes] = []
    for name, field_type, repeated, tag in _PLANS[kind]:
        value = values[name]
        if repeated:
            if value is not None and len(value):
                body = np.asarray(value, _NUMBERS[field_type]).tobytes()
                pieces += (tag, varint(len(body)), body)
        elif field_type == "time":
            pieces += (tag, _timestamp(value))
        elif field_type == "string":
            if value:
                body = value.encode()
                pieces += (tag, varint(len(body)), body)
        elif field_type == "uint64":
            if value:
                pieces += (tag, varint(value))
        elif value:
            pieces += (tag, struct.pack("<d", value))
    return b"".join(pieces)


def _encode_calibration(values: Values) -> bytes:
    message = calibration_class()(
        **{name: value for name, value in values.items() if name != "timestamp"}
    )
    message.timestamp.seconds, message.timestamp.nanos = divmod(values["timestamp"], SECOND_NS)
    return bytes(message.SerializeToString(deterministic=True))


# Bytes to messages


def decode(kind: str, data: bytes) -> DecodedMessage:
    """Return the message that the bytes encode; raise ValueError if they are invalid."""
    try:
        if kind == CALIBRATION:
            return _calibration(data)
        message = _parse(DECLARED[kind], data)
    except DecodeError as error:
        raise ValueError(str(error)) from error
    return _frame(message) if kind == FRAME else _state(message)


def _parse(message_type: MessageType, data: bytes) -> Any:
    """Return the message, with its arrays as bytes if that reads all of `data`.

    It does not if an array is unpacked or in pieces, or if a field is unknown. The arrays are then
    numbers.
    """
    message = message_class(message_type, True)()
    message.ParseFromString(data)
    message.DiscardUnknownFields()
    if message.ByteSize() == len(data):
        return message
    message = message_class(message_type)()
    message.ParseFromString(data)
    return message


def _time_ns(message: Any) -> int | None:
    if not message.HasField("timestamp"):
        return None
    return valid_time_ns(message.timestamp.seconds, message.timestamp.nanos)


def _numbers(value: Any, dtype: str) -> Array:
    return np.frombuffer(value, dtype) if isinstance(value, bytes) else np.array(value, dtype)


def _frame(m: Any) -> FrameMessage:
    return FrameMessage(
        _time_ns(m),
        m.sensor_id,
        m.frame_number,
        m.exposure_s,
        _numbers(m.x_px, "<f4"),
        _numbers(m.y_px, "<f4"),
        _numbers(m.flux, "<f4"),
        _numbers(m.sigma_px, "<f4"),
    )


def _state(m: Any) -> StateMessage:
    return StateMessage(
        _time_ns(m),
        m.sensor_id,
        m.frame,
        _numbers(m.position_km, "<f8"),
        _numbers(m.velocity_km_s, "<f8"),
        m.position_sigma_km,
        _numbers(m.attitude_xyzw, "<f8"),
        m.attitude_sigma_arcsec,
    )


def _calibration(data: bytes) -> CalibrationMessage:
    m = calibration_class().FromString(data)
    return CalibrationMessage(
        _time_ns(m),
        m.frame_id,
        m.width,
        m.height,
        m.distortion_model,
        np.array(m.D, float),
        np.array(m.K, float),
        m.line_time_s,
    )


# Where fields lie


@kernel
def _load_varint(data, at, end):
    """Return a varint and the offset after it, which is -1 where the varint is invalid.

    Only nine of the ten bytes that a varint may have are read: a number that needs the tenth is
    negative, or too large for any field here.
    """
    if at < end and data[at] < 0x80:
        return np.uint64(data[at]), at + 1
    value, shift = np.uint64(0), np.uint64(0)
    for k in range(at, min(at + 9, end)):
        value |= np.uint64(data[k] & 0x7F) << shift
        if data[k] < 0x80:
            return value, k + 1
        shift += np.uint64(7)
    return value, -1


@kernel
def _load_time_ns(data, at, end):
    """Return the nanoseconds of a Timestamp, or 0 where it is invalid."""
    seconds, nanos = np.uint64(0), np.uint64(0)
    while at < end:
        tag = data[at]
        value, at = _load_varint(data, at + 1, end)
        if at < 0:
            return 0
        if tag == 0x08:
            seconds = value
        elif tag == 0x10:
            nanos = value
        else:
            return 0
    if seconds > np.uint64(MAX_SECONDS) or nanos >= np.uint64(SECOND_NS):
        return 0
    return np.int64(seconds) * SECOND_NS + np.int64(nanos)


@kernel
def _locate_fields(data, at, end, types, fields, i):
    """Fill in row `i`; return whether the message is well formed and has no field twice."""
    sent = np.int64(0)  # a bit for each field number
    while at < end:
        tag, at = _load_varint(data, at, end)
        if at < 0 or tag > np.uint64(0xFFFFFFFF):
            return False
        number, wire = np.int64(tag >> np.uint64(3)), np.int64(tag & np.uint64(7))
        kind = types[number if number < len(types) else UNKNOWN]
        if kind != UNKNOWN:
            if sent >> number & 1:
                return False
            sent |= 1 << number
        elif number == 0:
            return False
        if wire == 2:
            size, at = _load_varint(data, at, end)
            if at < 0 or size > np.uint64(end - at):
                return False
            length = np.int64(size)
            if kind in (FLOATS, DOUBLES):
                width = 4 if kind == FLOATS else 8
                if length % width:
                    return False
                fields[i, 2 * number], fields[i, 2 * number + 1] = at, length // width
            elif kind == TEXT:
                fields[i, 2 * number], fields[i, 2 * number + 1] = at, length
            elif kind == TIME:
                fields[i, 2 * number] = _load_time_ns(data, at, at + length)
            elif kind != UNKNOWN:
                return False
            at += length
        elif wire == 0:
            value, at = _load_varint(data, at, end)
            if at < 0 or (kind != UNKNOWN and kind != INTEGER):
                return False
            if kind == INTEGER:
                fields[i, 2 * number] = np.int64(value)  # below 2**63: nine bytes are the maximum
        elif wire == 1 or wire == 5:
            width = 8 if wire == 1 else 4
            if end - at < width or (kind != UNKNOWN and (kind != DOUBLE or wire == 5)):
                return False
            if kind == DOUBLE:
                fields[i, 2 * number] = np.int64(load_uint64(data, at))
            at += width
        else:
            return False
    return True


@kernel
def locate(data, start, end, mine, types, fields):
    """Fill in the rows of `fields` of the messages that are `mine`; see `messages.encoding`."""
    for i in range(len(start)):
        if mine[i]:
            good = _locate_fields(data, start[i], end[i], types, fields, i)
            fields[i, 0] = good and fields[i, 2] > 0


ENCODING = MessageEncoding(
    message_encoding="protobuf",
    schema_encoding="protobuf",
    schema_names={
        FRAME: (CENTROID_FRAME.name,),
        STATE: (SENSOR_STATE.name,),
        CALIBRATION: (CALIBRATION_NAME,),
    },
    schema=protobuf_schema,
    encode=encode,
    decode=decode,
    locate=locate,
)
