"""Messages as ROS 2 writes them: CDR, each number aligned to its size."""

import struct
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from epipole.io.logs.mcap.record_scan import kernel, load_uint32, load_uint64
from epipole.io.logs.messages.encoding import (
    DOUBLE,
    DOUBLES,
    FLOATS,
    INTEGER,
    SECOND_NS,
    TEXT,
    TIME,
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
    CENTROID_FRAME,
    DECLARED,
    FRAME,
    LINE_TIME,
    SENSOR_STATE,
    STATE,
    MessageType,
)

# Schemas

_PACKAGE = "epipole_msgs"
_TYPES = {
    "time": "builtin_interfaces/Time",
    "string": "string",
    "uint64": "uint64",
    "double": "float64",
    "float": "float32",
}
_RULE = "=" * 80
_TIME = f"{_RULE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
_CAMERA_INFO = f"""std_msgs/Header header
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
{_RULE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_RULE}
MSG: sensor_msgs/RegionOfInterest
uint32 x_offset
uint32 y_offset
uint32 height
uint32 width
bool do_rectify
"""


def _schema_names(package: str, name: str) -> tuple[str, str]:
    """Return the name of a ROS 2 message, and the name that ROS 1 would give it."""
    return f"{package}/msg/{name}", f"{package}/{name}"


def _names_of(message: MessageType) -> tuple[str, str]:
    return _schema_names(_PACKAGE, message.name.rpartition(".")[2])


def message_definition(message: MessageType) -> str:
    """Return the text of a message's .msg file."""
    lines = [f"# {_names_of(message)[0]}: {message.doc}"]
    for member in message.members:
        array = "[]" if member.repeated else ""
        lines.append(f"{_TYPES[member.type]}{array} {member.name}")
    return "\n".join(lines) + "\n"


def ros2_schema(kind: str) -> bytes:
    """Return the content of an MCAP schema of encoding `ros2msg`: the message and its types."""
    text = _CAMERA_INFO if kind == CALIBRATION else message_definition(DECLARED[kind])
    return (text + _TIME).encode()


# Messages to bytes

_NUMBERS = {"double": "f8", "float": "f4"}
_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_LAST_SECOND = 2**31 - 1  # of an int32, since 1970


class CdrWriter:
    """The bytes of one message, little-endian."""

    def __init__(self) -> None:
        self._body = bytearray()

    def put(self, code: str, value: Any) -> None:
        """Add one number, of a type code of `struct`."""
        size = struct.calcsize(code)
        self._body += b"\0" * (-len(self._body) % size) + struct.pack("<" + code, value)

    def put_time(self, time_ns: int) -> None:
        """Add a builtin_interfaces/Time."""
        seconds, nanos = divmod(time_ns, SECOND_NS)
        if seconds > _LAST_SECOND:
            raise ValueError("ROS 2 has no times after 2038-01-19: take another encoding")
        self.put("i", seconds)
        self.put("I", nanos)

    def put_string(self, text: str) -> None:
        """Add a string: its length with the final zero, its bytes, the zero."""
        body = text.encode() + b"\0"
        self.put("I", len(body))
        self._body += body

    def put_numbers(self, numbers: Any, dtype: str, counted: bool = True) -> None:
        """Add an array, with its length before it unless its type fixes the length."""
        values = np.asarray([] if numbers is None else numbers, "<" + dtype)
        if counted:
            self.put("I", len(values))
        if len(values):  # an empty sequence has no padding
            self._body += b"\0" * (-len(self._body) % values.itemsize) + values.tobytes()

    def message(self) -> bytes:
        """Return the message with its encapsulation header."""
        return _LITTLE_ENDIAN + bytes(self._body)


def encode(kind: str, values: Values) -> bytes:
    """Return a message as CDR; a calibration as sensor_msgs/msg/CameraInfo."""
    out = CdrWriter()
    if kind == CALIBRATION:
        if values.get(LINE_TIME.name):
            raise ValueError("a CameraInfo has no line time: assume it where the log is read")
        _put_camera_info(out, values)
        return out.message()
    for member in DECLARED[kind].members:
        value = values[member.name]
        if member.repeated:
            out.put_numbers(value, _NUMBERS[member.type])
        elif member.type == "time":
            out.put_time(value)
        elif member.type == "string":
            out.put_string(value)
        else:
            out.put("Q" if member.type == "uint64" else "d", value)
    return out.message()


def _put_camera_info(out: CdrWriter, values: Values) -> None:
    out.put_time(values["timestamp"])
    out.put_string(values["frame_id"])
    out.put("I", values["height"])
    out.put("I", values["width"])
    out.put_string(values["distortion_model"])
    for name in "DKRP":
        out.put_numbers(values[name], "f8", counted=name == "D")
    for _ in range(6):  # binning in x and y, and the region of interest: all pixels
        out.put("I", 0)
    out.put("B", 0)


# Bytes to messages


class CdrReader:
    """Reads one message front to back; raises struct.error or ValueError where it is short."""

    def __init__(self, data: bytes) -> None:
        if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1, 6, 7):
            raise ValueError("no CDR header")
        self._data, self._at = data, 4
        self._order = "<" if data[1] & 1 else ">"
        self._widest = 4 if data[1] > 1 else 8  # XCDR2 aligns to 4 at most

    def number(self, code: str) -> Any:
        """Return the next number, of a type code of `struct`."""
        size = struct.calcsize(code)
        self._align(size)
        (value,) = struct.unpack_from(self._order + code, self._data, self._at)
        self._at += size
        return value

    def _align(self, size: int) -> None:
        self._at += -(self._at - 4) % min(size, self._widest)

    def time_ns(self) -> int | None:
        """Return the next builtin_interfaces/Time, or None where it is invalid."""
        return valid_time_ns(self.number("i"), self.number("I"))

    def text(self) -> str:
        """Return the next string."""
        length = self.number("I")
        body = self._take(length)
        return body[:-1].decode() if body.endswith(b"\0") else body.decode()

    def numbers(self, dtype: str, count: int | None = None) -> Array:
        """Return the next array, of `count` numbers or of the length that is sent before it."""
        count = self.number("I") if count is None else count
        ordered = np.dtype(self._order + dtype)
        if count:
            self._align(ordered.itemsize)
        return np.frombuffer(self._take(count * ordered.itemsize), ordered)

    def _take(self, length: int) -> bytes:
        if self._at + length > len(self._data):
            raise ValueError("message ends early")
        self._at += length
        return self._data[self._at - length : self._at]


_DECLARED_MESSAGES: dict[str, Callable[..., DecodedMessage]] = {
    FRAME: FrameMessage,
    STATE: StateMessage,
}


def decode(kind: str, data: bytes) -> DecodedMessage:
    """Return the message that CDR of either byte order holds; raise as `CdrReader` does."""
    reader = CdrReader(data)
    if kind == CALIBRATION:
        return _camera_info(reader)
    values: list[Any] = []
    for member in DECLARED[kind].members:
        if member.repeated:
            values.append(reader.numbers(_NUMBERS[member.type]))
        elif member.type == "time":
            values.append(reader.time_ns())
        elif member.type == "string":
            values.append(reader.text())
        else:
            values.append(reader.number("Q" if member.type == "uint64" else "d"))
    return _DECLARED_MESSAGES[kind](*values)


def _camera_info(reader: CdrReader) -> CalibrationMessage:
    time_ns, sensor_id = reader.time_ns(), reader.text()
    height, width = reader.number("I"), reader.number("I")
    model = reader.text()
    distortion, matrix = reader.numbers("f8"), reader.numbers("f8", 9)
    for count in (9, 12):  # R and P: not used
        reader.numbers("f8", count)
    bins, window = ([reader.number("I") for _ in range(n)] for n in (2, 4))
    whole = CalibrationMessage(time_ns, sensor_id, width, height, model, distortion, matrix)
    return _of_images(whole, bins, window) if max(bins) > 1 or any(window) else whole


def _of_images(
    whole: CalibrationMessage, bins: Sequence[int], window: Sequence[int]
) -> CalibrationMessage:
    """Return the calibration of the pixels that images have, from that of all pixels of a sensor.

    As ROS defines binning and the region of interest in REP 104.

    Parameters
    ----------
    whole
        The calibration as a CameraInfo states it.
    bins
        Pixels in a pixel of the image, along columns and rows; 0 is 1.
    window
        Left, top, height and width of the part that images show [px]; without a size it is all.
    """
    (bins_x, bins_y), (left, top, height, width) = (max(n, 1) for n in bins), window
    K = whole.K.astype(float)
    K[[0, 1]] /= bins_x
    K[[3, 4]] /= bins_y
    # The middle of a pixel is that of the pixels in it.
    K[2] = (K[2] - left + 0.5) / bins_x - 0.5
    K[5] = (K[5] - top + 0.5) / bins_y - 0.5
    sides = (width or whole.width) // bins_x, (height or whole.height) // bins_y
    return whole._replace(width=sides[0], height=sides[1], K=K)


# Where fields lie


@kernel
def _locate_fields(data, at, end, types, fields, i):
    """Fill in row `i` of a little-endian message; return whether it is well formed."""
    if end - at < 4 or data[at] != 0 or (data[at + 1] != 1 and data[at + 1] != 7):
        return False
    widest = 8 if data[at + 1] == 1 else 4
    origin = at + 4
    at = origin
    for number in range(1, len(types)):
        kind = types[number]
        width = 8 if kind in (INTEGER, DOUBLE) else 4
        at += -(at - origin) % min(width, widest)
        if end - at < width:
            return False
        if kind in (INTEGER, DOUBLE):
            fields[i, 2 * number] = np.int64(load_uint64(data, at))
            at += 8
            continue
        head = np.int64(load_uint32(data, at))
        at += 4
        if kind == TIME:
            if end - at < 4:
                return False
            nanos = np.int64(load_uint32(data, at))
            at += 4
            if head > 0x7FFFFFFF or nanos >= SECOND_NS:
                return False
            fields[i, 2 * number] = head * SECOND_NS + nanos
            continue
        size = 8 if kind == DOUBLES else 4 if kind == FLOATS else 1
        if size > 1 and head:
            at += -(at - origin) % min(size, widest)
        if head > (end - at) // size:
            return False
        fields[i, 2 * number], fields[i, 2 * number + 1] = at, head
        at += head * size
        if kind == TEXT and head and data[at - 1] == 0:
            fields[i, 2 * number + 1] = head - 1
    return True


@kernel
def locate(data, start, end, mine, types, fields):
    """Fill in the rows of `fields` of the messages that are `mine`; see `messages.encoding`."""
    for i in range(len(start)):
        if mine[i]:
            good = _locate_fields(data, start[i], end[i], types, fields, i)
            fields[i, 0] = good and fields[i, 2] > 0


ENCODING = MessageEncoding(
    message_encoding="cdr",
    schema_encoding="ros2msg",
    schema_names={
        FRAME: _names_of(CENTROID_FRAME),
        STATE: _names_of(SENSOR_STATE),
        CALIBRATION: _schema_names("sensor_msgs", "CameraInfo"),
    },
    schema=ros2_schema,
    encode=encode,
    decode=decode,
    locate=locate,
    profile="ros2",
)
