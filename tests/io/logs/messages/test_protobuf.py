"""Protobuf as the library and other programs write it."""

import struct

import pytest
from google.protobuf import descriptor_pb2
from hypothesis import given
from hypothesis import strategies as st

from epipole.io.logs.messages.protobuf import (
    ENCODING,
    encode,
    message_class,
    protobuf_schema,
    varint,
)
from epipole.schemas.log_messages import (
    CALIBRATION,
    CALIBRATION_NAME,
    CENTROID_FRAME,
    FRAME,
    KINDS,
    SENSOR_STATE,
    STATE,
)

VALUES = {
    "timestamp": 1_554_091_200_123_456_789,
    "sensor_id": "sat1",
    "frame_number": (1 << 40) + 1,
    "exposure_s": 0.25,
    "x_px": [1.5, -2.0],
    "y_px": [3.25, 4.0],
    "flux": [],
    "sigma_px": [0.5, 0.125],
}


def test_the_field_by_field_encoding_is_what_the_library_writes():
    message = message_class(CENTROID_FRAME)(**{k: v for k, v in VALUES.items() if k != "timestamp"})
    message.timestamp.seconds, message.timestamp.nanos = divmod(VALUES["timestamp"], 10**9)
    assert encode(FRAME, VALUES) == message.SerializeToString()


def test_unpacked_arrays_arrays_in_pieces_and_unknown_fields_are_read():
    rest = encode(FRAME, {**VALUES, "x_px": [], "y_px": []})
    unpacked = b"".join(b"\x2d" + struct.pack("<f", x) for x in VALUES["x_px"])
    pieces = b"".join(b"\x32\x04" + struct.pack("<f", y) for y in VALUES["y_px"])
    unknown = varint(77 << 3 | 0) + b"\x05"
    frame = ENCODING.decoded(FRAME, rest + unpacked + pieces + unknown)
    assert (frame.time_ns, frame.frame_number) == (VALUES["timestamp"], VALUES["frame_number"])
    for name in ("x_px", "y_px", "flux", "sigma_px"):
        assert getattr(frame, name).tolist() == VALUES[name]


@given(st.integers(0, 2**64 - 1))
def test_varints_are_those_of_the_library(number):
    message = message_class(CENTROID_FRAME)(frame_number=number)
    expected = message.SerializeToString()[1:] if number else b"\0"
    assert varint(number) == expected


@pytest.mark.parametrize("kind", KINDS)
def test_a_schema_holds_the_message_and_all_that_it_needs(kind):
    files = descriptor_pb2.FileDescriptorSet.FromString(protobuf_schema(kind)).file
    known = set()
    for file in files:  # dependencies first
        assert set(file.dependency) <= known
        known.add(file.name)
    names = {FRAME: CENTROID_FRAME.name, STATE: SENSOR_STATE.name, CALIBRATION: CALIBRATION_NAME}
    package, _, short = names[kind].rpartition(".")
    assert files[-1].package == package
    assert short in [m.name for m in files[-1].message_type]


@pytest.mark.parametrize("message", [CENTROID_FRAME, SENSOR_STATE])
def test_arrays_declared_as_bytes_are_the_packed_numbers(message):
    numbers = [m for m in message.members if m.repeated]
    whole = message_class(message)(**{m.name: [1.5, -2.0, 4.25] for m in numbers})
    raw = message_class(message, True).FromString(whole.SerializeToString())
    for member in numbers:
        assert len(getattr(raw, member.name)) == 3 * (4 if member.type == "float" else 8)
    assert raw.SerializeToString() == whole.SerializeToString()
