"""Messages as JSON, with the field names of the protobuf messages."""

import json
import re
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import Any

import numpy as np
import orjson

from epipole.io.logs.messages.encoding import (
    SECOND_NS,
    Array,
    CalibrationMessage,
    DecodedMessage,
    FrameMessage,
    MessageEncoding,
    StateMessage,
    Values,
    valid_time_ns,
)
from epipole.io.logs.messages.protobuf import json_name
from epipole.schemas.log_messages import (
    CALIBRATION,
    CALIBRATION_NAME,
    CENTROID_FRAME,
    DECLARED,
    FRAME,
    LINE_TIME,
    SENSOR_STATE,
    STATE,
)

# Schemas

_TIME = {
    "type": "object",
    "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
    "required": ["sec", "nsec"],
}
_TYPES: dict[str, dict[str, Any]] = {
    "time": _TIME,
    "string": {"type": "string"},
    "uint64": {"type": "integer"},
    "double": {"type": "number"},
    "float": {"type": "number"},
}
_CALIBRATION: dict[str, Any] = {
    "timestamp": _TIME,
    "frame_id": {"type": "string"},
    "width": {"type": "integer"},
    "height": {"type": "integer"},
    "distortion_model": {"type": "string"},
    **{name: {"type": "array", "items": {"type": "number"}} for name in "DKRP"},
    LINE_TIME.name: {"type": "number", "description": LINE_TIME.doc},
}


def json_schema(kind: str) -> bytes:
    """Return the content of an MCAP schema of encoding `jsonschema`."""
    if kind == CALIBRATION:
        name, properties, doc = CALIBRATION_NAME, _CALIBRATION, "Camera calibration."
    else:
        message = DECLARED[kind]
        name, properties, doc = message.name, {}, message.doc
        for member in message.members:
            declared = _TYPES[member.type]
            if member.repeated:
                declared = {"type": "array", "items": declared}
            properties[member.name] = {**declared, "description": member.doc}
    schema = {"title": name, "description": doc, "type": "object", "properties": properties}
    return json.dumps(schema).encode()


# Messages to bytes

_NUMBERS = {"double": "<f8", "float": "<f4"}


def encode(kind: str, values: Values) -> bytes:
    """Return a message as JSON; numbers have the digits that give the same float again."""
    out: dict[str, Any] = {}
    if kind == CALIBRATION:
        out.update(values)
        out["timestamp"] = _time_object(values["timestamp"])
    else:
        for member in DECLARED[kind].members:
            value = values[member.name]
            if member.repeated:
                numbers = np.asarray([] if value is None else value, _NUMBERS[member.type])
                out[member.name] = numbers.tolist()
            elif member.type == "time":
                out[member.name] = _time_object(value)
            else:
                out[member.name] = value
    return json.dumps(out, separators=(",", ":")).encode()


def _time_object(time_ns: int) -> dict[str, int]:
    seconds, nanos = divmod(time_ns, SECOND_NS)
    return {"sec": seconds, "nsec": nanos}


# Bytes to messages

_RFC3339 = re.compile(r"(\d{4}-\d\d-\d\d[Tt]\d\d:\d\d:\d\d)(?:\.(\d{1,9}))?([Zz]|[+-]\d\d:\d\d)")
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def decode(kind: str, data: bytes) -> DecodedMessage:
    """Return the message that a JSON object holds; raise ValueError and the like if it does not.

    Field names may also be those of protobuf's JSON mapping: ``xPx`` for ``x_px``.
    """
    values = _object(data)
    if kind == CALIBRATION:
        return _calibration(values)
    return _DECLARED_MESSAGES[kind](
        *[
            convert(values[name] if name in values else values.get(mapped_name, default))
            for name, mapped_name, convert, default in _PLANS[kind]
        ]
    )


def _object(data: bytes) -> Mapping[str, Any]:
    try:
        values = orjson.loads(data)
    except orjson.JSONDecodeError:
        values = json.loads(data)  # accepts NaN and Infinity, which some programs write
    if not isinstance(values, dict):
        raise ValueError("not an object")
    return values


def _calibration(values: Mapping[str, Any]) -> CalibrationMessage:
    return CalibrationMessage(
        _time_ns(values.get("timestamp")),
        _text(values.get("frame_id", values.get("frameId", ""))),
        _integer(values.get("width", 0)),
        _integer(values.get("height", 0)),
        _text(values.get("distortion_model", values.get("distortionModel", ""))),
        _array(values.get("D")),
        _array(values.get("K")),
        float(values.get(LINE_TIME.name, values.get(json_name(LINE_TIME.name), 0.0))),
    )


def _time_ns(value: Any) -> int | None:
    """Return the time of {"sec", "nsec"}, or of protobuf's JSON mapping, an RFC 3339 text."""
    if value is None:
        return None
    if isinstance(value, str):
        match = _RFC3339.fullmatch(value)
        if match is None:
            raise ValueError(f"time {value!r}")
        zone = "+00:00" if match[3] in "Zz" else match[3]
        seconds = int((datetime.fromisoformat(match[1] + zone) - _EPOCH).total_seconds())
        return valid_time_ns(seconds, int((match[2] or "0").ljust(9, "0")))
    nanos = value["nsec"] if "nsec" in value else value.get("nanosec", value.get("nanos", 0))
    seconds = _integer(value["sec"] if "sec" in value else value["seconds"])
    return valid_time_ns(seconds, int(nanos))


def _array(value: Any) -> Array:
    array = np.array([] if value is None else value, dtype=float)
    if array.ndim != 1:
        raise ValueError("not a list of numbers")
    return array


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError("not a text")
    return value


def _integer(value: Any) -> int:
    number = int(value)
    if isinstance(value, float) and value != number:
        raise ValueError("not an integer")
    return number


_CONVERTERS: dict[str, tuple[Callable[[Any], Any], Any]] = {
    "time": (_time_ns, None),
    "string": (_text, ""),
    "uint64": (_integer, 0),
    "double": (float, 0.0),
}
_DECLARED_MESSAGES: dict[str, Callable[..., DecodedMessage]] = {
    FRAME: FrameMessage,
    STATE: StateMessage,
}
# Of each field: its name, its mapped name, how its value is converted, its default.
_PLANS = {
    kind: [
        (m.name, json_name(m.name), *((_array, None) if m.repeated else _CONVERTERS[m.type]))
        for m in message.members
    ]
    for kind, message in DECLARED.items()
}

ENCODING = MessageEncoding(
    message_encoding="json",
    schema_encoding="jsonschema",
    schema_names={
        FRAME: (CENTROID_FRAME.name,),
        STATE: (SENSOR_STATE.name,),
        CALIBRATION: (CALIBRATION_NAME,),
    },
    schema=json_schema,
    encode=encode,
    decode=decode,
)
