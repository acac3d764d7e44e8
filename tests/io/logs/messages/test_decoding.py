"""Messages as other programs may write them."""

import json
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from epipole.io.logs.messages.decoding import ENCODINGS, UndecodableError, decoder
from epipole.io.logs.messages.encoding import encode_cdr, encode_json, encode_protobuf, varint
from epipole.schemas.messages import (
    CALIBRATION,
    CENTROID_FRAME,
    FRAME,
    SENSOR_STATE,
    STATE,
    message_class,
)

START_NS = 1_554_091_200_000_000_000
VALUES = {
    "timestamp": START_NS + 123_456_789,
    "sensor_id": "sat1",
    "frame_number": (1 << 40) + 1,
    "exposure_s": 0.25,
    "x_px": [1.5, -2.0],
    "y_px": [3.25, 4.0],
    "flux": [],
    "sigma_px": [0.5, 0.125],
}


def check(frame):
    assert (frame.time_ns, frame.sensor_id) == (VALUES["timestamp"], "sat1")
    assert (frame.frame_number, frame.exposure_s) == (VALUES["frame_number"], 0.25)
    for name in ("x_px", "y_px", "flux", "sigma_px"):
        assert getattr(frame, name).tolist() == VALUES[name]


@pytest.mark.parametrize(
    ("encoding", "encode"),
    [("protobuf", encode_protobuf), ("json", encode_json), ("cdr", encode_cdr)],
)
def test_a_message_comes_back_as_it_was(encoding, encode):
    check(decoder(FRAME, encoding)(encode(CENTROID_FRAME, VALUES)))


def test_the_field_by_field_protobuf_is_what_the_library_writes():
    message = message_class(CENTROID_FRAME.name)(
        **{k: v for k, v in VALUES.items() if k != "timestamp"}
    )
    message.timestamp.seconds, message.timestamp.nanos = divmod(VALUES["timestamp"], 10**9)
    assert encode_protobuf(CENTROID_FRAME, VALUES) == message.SerializeToString()


def test_unpacked_arrays_arrays_in_pieces_and_new_fields_are_read():
    rest = encode_protobuf(CENTROID_FRAME, {**VALUES, "x_px": [], "y_px": []})
    unpacked = b"".join(b"\x2d" + struct.pack("<f", x) for x in VALUES["x_px"])
    pieces = b"".join(b"\x32\x04" + struct.pack("<f", y) for y in VALUES["y_px"])
    unknown = varint(77 << 3 | 0) + b"\x05"
    check(decoder(FRAME, "protobuf")(rest + unpacked + pieces + unknown))


def test_big_endian_cdr_is_read():
    body = struct.pack(">iI", *divmod(VALUES["timestamp"], 10**9))
    body += struct.pack(">I5s", 5, b"sat1\0") + bytes(7)  # aligned to 8 from here
    body += struct.pack(">Qd", VALUES["frame_number"], VALUES["exposure_s"])
    for name in ("x_px", "y_px", "flux", "sigma_px"):
        body += struct.pack(f">I{len(VALUES[name])}f", len(VALUES[name]), *VALUES[name])
    check(decoder(FRAME, "cdr")(b"\x00\x00\x00\x00" + body))


@pytest.mark.parametrize(
    "text",
    ["2019-04-01T04:00:00.123456789Z", "2019-04-01T06:00:00.123456789+02:00"],
)
def test_times_of_protobufs_json_mapping_are_read(text):
    values = json.loads(encode_json(CENTROID_FRAME, VALUES)) | {"timestamp": text}
    check(decoder(FRAME, "json")(json.dumps(values).encode()))


@pytest.mark.parametrize(
    "timestamp",
    [
        None,
        {"sec": 0, "nsec": 0},
        {"sec": -5, "nsec": 0},
        {"sec": 1 << 62, "nsec": 0},
        {"sec": 1, "nsec": 1_000_000_000},
    ],
)
def test_a_time_that_no_log_can_have_is_no_time(timestamp):
    values = json.loads(encode_json(CENTROID_FRAME, VALUES)) | {"timestamp": timestamp}
    assert decoder(FRAME, "json")(json.dumps(values).encode()).time_ns is None


@pytest.mark.parametrize(
    "changes",
    [
        {"x_px": "12"},
        {"x_px": [[1, 2]]},
        {"x_px": [1, "a"]},
        {"sensor_id": 5},
        {"frame_number": 1.5},
        {"exposure_s": None},
        {"timestamp": "yesterday"},
    ],
)
def test_json_of_the_wrong_kind_is_undecodable(changes):
    values = json.loads(encode_json(CENTROID_FRAME, VALUES)) | changes
    with pytest.raises(UndecodableError):
        decoder(FRAME, "json")(json.dumps(values).encode())


def test_a_state_keeps_empty_arrays_empty():
    values = {
        "timestamp": START_NS,
        "sensor_id": "a",
        "frame": "ITRF",
        "position_km": [1.0, 2.0, 3.0],
        "velocity_km_s": None,
        "position_sigma_km": 0.5,
        "attitude_xyzw": None,
        "attitude_sigma_arcsec": 0.0,
    }
    for encoding, encode in (
        ("protobuf", encode_protobuf),
        ("json", encode_json),
        ("cdr", encode_cdr),
    ):
        state = decoder(STATE, encoding)(encode(SENSOR_STATE, values))
        assert (state.frame, state.position_sigma_km) == ("ITRF", 0.5)
        assert state.position_km.tolist() == [1.0, 2.0, 3.0]
        assert len(state.velocity_km_s) == len(state.attitude_xyzw) == 0


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("carries", [FRAME, STATE, CALIBRATION])
@given(data=st.binary(max_size=200))
def test_arbitrary_bytes_are_a_message_or_undecodable(encoding, carries, data):
    for bytes_ in (data, b"\x00\x01\x00\x00" + data):
        try:
            record = decoder(carries, encoding)(bytes_)
        except UndecodableError:
            continue
        assert isinstance(record.sensor_id, str)


@given(st.integers(0, 2**64 - 1))
def test_varints_are_those_of_protobuf(number):
    message = message_class(CENTROID_FRAME.name)(frame_number=number)
    expected = message.SerializeToString()[1:] if number else b"\0"
    assert varint(number) == expected


def test_numbers_keep_every_bit_of_a_double():
    exact = np.nextafter(7000.0, 8000.0)
    values = {"timestamp": START_NS, "sensor_id": "a", "frame": "GCRF", "position_km": [exact] * 3}
    values |= {"velocity_km_s": None, "position_sigma_km": 0.1, "attitude_xyzw": None}
    values |= {"attitude_sigma_arcsec": 0.3}
    for encoding, encode in (
        ("protobuf", encode_protobuf),
        ("json", encode_json),
        ("cdr", encode_cdr),
    ):
        state = decoder(STATE, encoding)(encode(SENSOR_STATE, values))
        assert state.position_km.tolist() == [exact] * 3
        assert (state.position_sigma_km, state.attitude_sigma_arcsec) == (0.1, 0.3)


@pytest.mark.parametrize("text", ["NaN", "Infinity", "-Infinity"])
def test_numbers_that_are_none_in_json_are_read_where_writers_put_them(text):
    data = b'{"timestamp": {"sec": 5, "nsec": 6}, "sensor_id": "a", "x_px": [1.5, %s]}'
    read = decoder(FRAME, "json")(data % text.encode())
    assert read.time_ns == 5_000_000_006
    np.testing.assert_array_equal(read.x_px, [1.5, float(text)])
