"""Messages with one odd value in them, in a log that is sound otherwise.

What becomes of each is known: it is read, or it is counted in `rejects`.
"""

import json
import math
import struct
from collections.abc import Iterator
from random import Random
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration

from damage.sound_logs import FORMS, Form, Message, messages, written
from epipole.io.logs.messages.protobuf import varint
from epipole.io.logs.messages.registry import encoding_named
from epipole.schemas.log_messages import CALIBRATION, DECLARED, FRAME, STATE

NAN, INF = math.nan, math.inf
NUMBERS = (
    NAN, INF, -INF, 0.0, -0.0, 1.0, -1.0, 0.5, 1e-320, 1e-300, -1e-300, 1e-30, 1e9, 1e18, 1e30,
    1e38, 1e39, 1e300, -1e300, 1.7e308,
)  # fmt: skip
INTEGERS = (
    0, 1, -1, 1 << 31, (1 << 31) - 1, 1 << 32, (1 << 53) + 1, (1 << 63) - 1, 1 << 63,
    (1 << 64) - 1, 1 << 64, 10**30, -(10**30),
)  # fmt: skip
TEXTS = (
    "", " ", "x" * 64, "x" * 200_000, "\0", "a\0b", "\x1b[31m", "a\nb", "\u202e", "é", "..", "../a",
    "a/b", "-a", "ITRF ", "itrf", "GCRF", "TEME", "nobody", b"\xff\xfe", b"\xed\xa0\x80",
)  # fmt: skip
SECONDS = (
    0, -1, 1, 10**9, 1_554_091_200, 4_102_444_801, 9_223_372_036, 1 << 62, -(1 << 63),
)  # fmt: skip
NANOS = (0, 1, 999_999_999, 1_000_000_000, -1, (1 << 31) - 1)
TIMES = tuple((sec, nsec) for sec in SECONDS for nsec in NANOS)
ANYTHING = (None, True, [], {}, [[1.0]], [None], ["1"], "NaN", "1", {"sec": "a"}, [{}], 1e400)
KINDS = {"time": TIMES, "string": TEXTS, "uint64": INTEGERS, "fixed32": INTEGERS, "double": NUMBERS}
_CALIBRATION = {
    "timestamp": "time", "frame_id": "string", "width": "fixed32", "height": "fixed32",
    "distortion_model": "string", "D": "doubles", "K": "doubles", "R": "doubles", "P": "doubles",
}  # fmt: skip
ENCODINGS = ("protobuf", "json", "ros2")


def fields() -> Iterator[tuple[str, str]]:
    """Yield the fields of all messages, each with its message's kind."""
    for kind in (FRAME, STATE):
        for member in DECLARED[kind].members:
            yield kind, member.name
    for name in _CALIBRATION:
        yield CALIBRATION, name


def odd_values(encoding: str, message: Message, field: str) -> Iterator[Any]:
    """Yield the odd values of a field; `message` is one that has it."""
    of_type = _type(message.kind, field)
    if of_type in KINDS:
        yield from KINDS[of_type]
    else:
        yield from _odd_arrays(message.values[field])
    if encoding == "json":
        yield from ANYTHING


def _odd_arrays(array: Any) -> Iterator[list[float]]:
    usual = [float(value) for value in ([] if array is None else array)]
    yield []
    yield usual[:-1]
    yield [*usual, 0.0]
    yield [0.0] * 20_000
    for value in NUMBERS:
        yield [value]
        yield [value] * len(usual)
        yield [*usual[:-1], value]


def with_value(encoding: str, message: Message, field: str, value: Any) -> bytes | None:
    """Return the bytes of a message with another value; None if the encoding cannot hold it."""
    if encoding == "json":
        return _json(message, field, value)
    if encoding == "protobuf":
        return _protobuf(message, field, value)
    if _type(message.kind, field) == "time":
        value = value[0] * 1_000_000_000 + value[1]
    try:
        return encoding_named(encoding).encode(message.kind, message.values | {field: value})
    except (struct.error, ValueError, OverflowError, AttributeError, TypeError):
        return None


def log_of_field(encoding: str, kind: str, field: str) -> tuple[bytes, int]:
    """Return a log with all odd values of a field, and how many messages it has."""
    sound = messages()
    first = next(m for m in sound if m.kind == kind)
    odd = [with_value(encoding, first, field, v) for v in odd_values(encoding, first, field)]
    encode = encoding_named(encoding).encode
    encoded = [(m, encode(m.kind, m.values)) for m in sound]
    encoded += [(first, data) for data in odd if data is not None]
    return written(encoded, Form(encoding)), len(encoded)


def log_of_chance(chance: Random) -> tuple[str, bytes, int]:
    """Return a log with odd values in some messages: what it has, the log, how many messages."""
    form = FORMS[chance.choice(list(FORMS))]
    encode = encoding_named(form.encoding).encode
    share = chance.choice((0.02, 0.1, 1.0))
    same = chance.choice(list(fields())) if chance.random() < 0.5 else None
    encoded, altered = [], set()
    for message in messages():
        kind, field = same or chance.choice([f for f in fields() if f[0] == message.kind])
        data = None
        if message.kind == kind and chance.random() < share:
            value = chance.choice(list(odd_values(form.encoding, message, field)))
            data = with_value(form.encoding, message, field, value)
            altered.add(f"{kind}.{field}")
        encoded.append((message, data or encode(message.kind, message.values)))
    name = ", ".join(sorted(altered)[:3])
    return f"{form.encoding}: {name}", written(encoded, form), len(encoded)


def _type(kind: str, field: str) -> str:
    if kind == CALIBRATION:
        return _CALIBRATION[field]
    member = next(member for member in DECLARED[kind].members if member.name == field)
    return member.type + "s" if member.repeated else member.type


def _json(message: Message, field: str, value: Any) -> bytes | None:
    if isinstance(value, bytes):
        return None
    if isinstance(value, tuple):
        value = {"sec": value[0], "nsec": value[1]}
    usual = json.loads(encoding_named("json").encode(message.kind, message.values))
    return json.dumps(usual | {field: value}).encode()


def _protobuf(message: Message, field: str, value: Any) -> bytes:
    """Return the message without the field, and the field behind it, as raw as it may come."""
    of_type = _type(message.kind, field)
    number = _number(message.kind, field)
    if message.kind == CALIBRATION:
        sent = CameraCalibration.FromString(
            encoding_named("protobuf").encode(message.kind, message.values)
        )
        sent.ClearField(field)
        rest = bytes(sent.SerializeToString(deterministic=True))
    else:
        nothing = {"time": 0, "string": "", "uint64": 0, "double": 0.0}.get(of_type)
        rest = encoding_named("protobuf").encode(message.kind, message.values | {field: nothing})
    return rest + _wire(number, of_type, value)


def _number(kind: str, field: str) -> int:
    if kind == CALIBRATION:
        return int(CameraCalibration.DESCRIPTOR.fields_by_name[field].number)
    return next(member.number for member in DECLARED[kind].members if member.name == field)


def _wire(number: int, of_type: str, value: Any) -> bytes:
    if of_type == "uint64":
        return varint(number << 3) + varint(value % (1 << 64))
    if of_type == "fixed32":
        return varint(number << 3 | 5) + (value % (1 << 32)).to_bytes(4, "little")
    if of_type == "double":
        return varint(number << 3 | 1) + struct.pack("<d", value)
    if of_type == "string":
        body = value if isinstance(value, bytes) else value.encode()
    elif of_type == "time":
        sec, nsec = (part % (1 << 64) for part in value)
        body = b"\x08" + varint(sec) + b"\x10" + varint(nsec)
    else:
        with np.errstate(over="ignore"):
            body = np.array(value, "<f4" if of_type == "floats" else "<f8").tobytes()
    return varint(number << 3 | 2) + varint(len(body)) + body
