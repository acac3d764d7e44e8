"""The messages of a log, declared once: protobuf, ROS 2 and JSON all follow from here.

A log has three kinds of message. Frames and states are this project's own; calibrations
are the public `foxglove.CameraCalibration`, in ROS 2 `sensor_msgs/msg/CameraInfo`. The
name of a channel's schema says what it carries; topics are a convention.
"""

import json
from functools import cache
from typing import Any, NamedTuple

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2


class Member(NamedTuple):
    """A field of a message; `kind` is time, string, uint64, double or float."""

    name: str
    number: int
    kind: str
    doc: str
    repeated: bool = False


class MessageType(NamedTuple):
    """A message: its name in each encoding, its meaning and its fields."""

    name: str
    ros_name: str
    doc: str
    members: tuple[Member, ...]


CENTROID_FRAME = MessageType(
    "epipole.CentroidFrame",
    "epipole_msgs/msg/CentroidFrame",
    "One exposure of one star sensor, reduced to the centroids of its bright spots.",
    (
        Member("timestamp", 1, "time", "Middle of the exposure, UTC."),
        Member("sensor_id", 2, "string", "[A-Za-z0-9][A-Za-z0-9_-]{0,62}"),
        Member("frame_number", 3, "uint64", "Unique per sensor, increasing with time."),
        Member("exposure_s", 4, "double", "Exposure time."),
        Member("x_px", 5, "float", "Column; (0, 0) is the middle of the top-left pixel.", True),
        Member("y_px", 6, "float", "Row, downwards.", True),
        Member("flux", 7, "float", "Linear, any unit; empty where unknown.", True),
        Member("sigma_px", 8, "float", "1-sigma error per axis; empty where unknown.", True),
    ),
)

SENSOR_STATE = MessageType(
    "epipole.SensorState",
    "epipole_msgs/msg/SensorState",
    "Where a sensor is and, where known, how it is turned.",
    (
        Member("timestamp", 1, "time", "Time of the state, UTC."),
        Member("sensor_id", 2, "string", "Star sensor."),
        Member("frame", 3, "string", "GCRF, EME2000, TEME or ITRF."),
        Member("position_km", 4, "double", "(3) in that frame.", True),
        Member("velocity_km_s", 5, "double", "(3) in that frame; empty where unknown.", True),
        Member("position_sigma_km", 6, "double", "1-sigma per axis; 0 where unknown."),
        Member(
            "attitude_xyzw",
            7,
            "double",
            "Unit quaternion, scalar last, that turns GCRF into sensor coordinates; a prior.",
            True,
        ),
        Member("attitude_sigma_arcsec", 8, "double", "1-sigma per axis; 0 where unknown."),
    ),
)

CALIBRATION_NAME = "foxglove.CameraCalibration"
CAMERA_INFO_NAME = "sensor_msgs/msg/CameraInfo"

# What a channel carries, by the name of its schema. ROS 1 style names have no "/msg/".
FRAME, STATE, CALIBRATION = "frame", "state", "calibration"
CARRIES = {
    CENTROID_FRAME.name: FRAME,
    CENTROID_FRAME.ros_name: FRAME,
    "epipole_msgs/CentroidFrame": FRAME,
    SENSOR_STATE.name: STATE,
    SENSOR_STATE.ros_name: STATE,
    "epipole_msgs/SensorState": STATE,
    CALIBRATION_NAME: CALIBRATION,
    CAMERA_INFO_NAME: CALIBRATION,
    "sensor_msgs/CameraInfo": CALIBRATION,
}
OWN_MESSAGES = {FRAME: CENTROID_FRAME, STATE: SENSOR_STATE}


# Protobuf

_FieldProto = descriptor_pb2.FieldDescriptorProto
_PROTO_TYPE = {
    "time": _FieldProto.TYPE_MESSAGE,
    "string": _FieldProto.TYPE_STRING,
    "uint64": _FieldProto.TYPE_UINT64,
    "double": _FieldProto.TYPE_DOUBLE,
    "float": _FieldProto.TYPE_FLOAT,
}


def file_descriptor(arrays_as_bytes: bool = False) -> descriptor_pb2.FileDescriptorProto:
    """Return the messages as a protobuf file, as a compiled `epipole.proto` would be.

    With `arrays_as_bytes` the repeated numbers are declared as bytes. A packed array and
    bytes look alike on the wire, so a message read this way gives its arrays as they
    stand, with no Python object a number.
    """
    file = descriptor_pb2.FileDescriptorProto(
        name="epipole.proto",
        package="epipole",
        syntax="proto3",
        dependency=["google/protobuf/timestamp.proto"],
    )
    for message in (CENTROID_FRAME, SENSOR_STATE):
        declared = file.message_type.add(name=message.name.rpartition(".")[2])
        for member in message.members:
            field = declared.field.add(
                name=member.name,
                number=member.number,
                label=_FieldProto.LABEL_OPTIONAL,
                type=_PROTO_TYPE[member.kind],
                json_name=json_name(member.name),
            )
            if member.kind == "time":
                field.type_name = ".google.protobuf.Timestamp"
            if member.repeated and arrays_as_bytes:
                field.type = _FieldProto.TYPE_BYTES
            elif member.repeated:
                field.label = _FieldProto.LABEL_REPEATED
    return file


@cache
def message_class(name: str, arrays_as_bytes: bool = False) -> Any:
    """Return the protobuf class of a message of ours; see `file_descriptor`."""
    pool = descriptor_pool.DescriptorPool()  # its own, so that a user's epipole_pb2 is no clash
    pool.AddSerializedFile(timestamp_pb2.DESCRIPTOR.serialized_pb)
    pool.Add(file_descriptor(arrays_as_bytes))
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


def protobuf_schema(name: str) -> bytes:
    """Return what an MCAP schema of encoding `protobuf` holds: the file and its dependencies."""
    files = descriptor_pb2.FileDescriptorSet()
    if name == CALIBRATION_NAME:
        _add_file(files, CameraCalibration.DESCRIPTOR.file)
    else:
        _add_file(files, timestamp_pb2.DESCRIPTOR)
        files.file.append(file_descriptor())
    return files.SerializeToString(deterministic=True)


def _add_file(files: descriptor_pb2.FileDescriptorSet, file: Any) -> None:
    for dependency in file.dependencies:
        _add_file(files, dependency)
    if file.name not in [added.name for added in files.file]:
        file.CopyToProto(files.file.add())


# JSON


def json_name(name: str) -> str:
    """Return the name that protobuf's own JSON mapping gives a field: ``x_px`` is ``xPx``."""
    first, *rest = name.split("_")
    return first + "".join(part.capitalize() for part in rest)


_JSON_TIME = {
    "type": "object",
    "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
    "required": ["sec", "nsec"],
}
_JSON_TYPE: dict[str, dict[str, Any]] = {
    "time": _JSON_TIME,
    "string": {"type": "string"},
    "uint64": {"type": "integer"},
    "double": {"type": "number"},
    "float": {"type": "number"},
}
_JSON_CALIBRATION: dict[str, Any] = {
    "timestamp": _JSON_TIME,
    "frame_id": {"type": "string"},
    "width": {"type": "integer"},
    "height": {"type": "integer"},
    "distortion_model": {"type": "string"},
    **{name: {"type": "array", "items": {"type": "number"}} for name in "DKRP"},
}


def json_schema(name: str) -> bytes:
    """Return what an MCAP schema of encoding `jsonschema` holds."""
    if name == CALIBRATION_NAME:
        properties, doc = _JSON_CALIBRATION, "Camera calibration."
    else:
        message = next(m for m in (CENTROID_FRAME, SENSOR_STATE) if m.name == name)
        properties, doc = {}, message.doc
        for member in message.members:
            kind: dict[str, Any] = _JSON_TYPE[member.kind]
            kind = {"type": "array", "items": kind} if member.repeated else kind
            properties[member.name] = {**kind, "description": member.doc}
    schema = {"title": name, "description": doc, "type": "object", "properties": properties}
    return json.dumps(schema).encode()


# ROS 2

_ROS_TYPE = {
    "time": "builtin_interfaces/Time",
    "string": "string",
    "uint64": "uint64",
    "double": "float64",
    "float": "float32",
}
_ROS_RULE = "=" * 80
_ROS_TIME = f"{_ROS_RULE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
_ROS_CAMERA_INFO = f"""std_msgs/Header header
uint32 height
uint32 width
string distortion_model
float64[] d
float64[9] k
float64[9] r
float64[12] p
uint32 binning_x
uint32 binning_y
sensor_msgs/RegionOfInterest roi
{_ROS_RULE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_ROS_RULE}
MSG: sensor_msgs/RegionOfInterest
uint32 x_offset
uint32 y_offset
uint32 height
uint32 width
bool do_rectify
"""


def ros_definition(message: MessageType) -> str:
    """Return the text of a message's .msg file."""
    lines = [f"# {message.ros_name}: {message.doc}"]
    for member in message.members:
        array = "[]" if member.repeated else ""
        lines.append(f"{_ROS_TYPE[member.kind]}{array} {member.name}")
    return "\n".join(lines) + "\n"


def ros_schema(ros_name: str) -> bytes:
    """Return what an MCAP schema of encoding `ros2msg` holds: the message and all it names."""
    if ros_name == CAMERA_INFO_NAME:
        return (_ROS_CAMERA_INFO + _ROS_TIME).encode()
    message = next(m for m in (CENTROID_FRAME, SENSOR_STATE) if m.ros_name == ros_name)
    return (ros_definition(message) + _ROS_TIME).encode()
