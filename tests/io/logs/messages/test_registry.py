"""Every encoding keeps the same promises; a new one needs a line in the registry and no more."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from epipole.io.logs.messages import registry
from epipole.io.logs.messages.encoding import (
    CalibrationMessage,
    FrameMessage,
    MessageEncoding,
    StateMessage,
    UndecodableError,
)
from epipole.io.logs.messages.registry import ENCODINGS, encoding_named
from epipole.io.logs.reader import read_log
from epipole.io.logs.writer import LogWriter, calibration_values
from epipole.schemas.bridge import array, flatten
from epipole.schemas.log_messages import CALIBRATION, FRAME, KINDS, STATE

START_NS = 1_554_091_200_000_000_000
EXACT_KM = float(np.nextafter(7000.0, 8000.0))
CAMERA = {
    "width": 512,
    "height": 480,
    "fx_px": 1000.5,
    "fy_px": 1001.25,
    "cx_px": 255.5,
    "cy_px": 239.5,
    "k1": -0.05,
    "k2": 0.01,
    "p1": 1e-4,
    "p2": -1e-4,
    "k3": 0.001,
}
FRAME_VALUES = {
    "timestamp": START_NS + 123_456_789,
    "sensor_id": "sat1",
    "frame_number": (1 << 40) + 1,
    "exposure_s": 0.25,
    "x_px": [1.5, -2.0],
    "y_px": [3.25, 4.0],
    "flux": [],
    "sigma_px": [0.5, 0.125],
}
STATE_VALUES = {
    "timestamp": START_NS,
    "sensor_id": "a",
    "frame": "ITRF",
    "position_km": [EXACT_KM, 2.0, 3.0],
    "velocity_km_s": None,
    "position_sigma_km": 0.1,
    "attitude_xyzw": None,
    "attitude_sigma_arcsec": 0.3,
}


@pytest.mark.parametrize("name", ENCODINGS)
def test_a_frame_comes_back_as_it_was(name):
    encoding = encoding_named(name)
    frame = encoding.decoded(FRAME, encoding.encode(FRAME, FRAME_VALUES))
    assert (frame.time_ns, frame.sensor_id) == (FRAME_VALUES["timestamp"], "sat1")
    assert (frame.frame_number, frame.exposure_s) == (FRAME_VALUES["frame_number"], 0.25)
    for column in ("x_px", "y_px", "flux", "sigma_px"):
        assert getattr(frame, column).tolist() == FRAME_VALUES[column]


@pytest.mark.parametrize("name", ENCODINGS)
def test_a_state_keeps_every_bit_and_its_empty_arrays(name):
    encoding = encoding_named(name)
    state = encoding.decoded(STATE, encoding.encode(STATE, STATE_VALUES))
    assert (state.frame, state.position_km.tolist()) == ("ITRF", [EXACT_KM, 2.0, 3.0])
    assert (state.position_sigma_km, state.attitude_sigma_arcsec) == (0.1, 0.3)
    assert len(state.velocity_km_s) == len(state.attitude_xyzw) == 0


@pytest.mark.parametrize("name", ENCODINGS)
def test_a_calibration_comes_back_as_it_was(name):
    encoding, values = encoding_named(name), calibration_values("sat1", START_NS, CAMERA)
    camera = encoding.decoded(CALIBRATION, encoding.encode(CALIBRATION, values))
    assert (camera.time_ns, camera.sensor_id) == (START_NS, "sat1")
    assert (camera.width, camera.height, camera.distortion_model) == (512, 480, "plumb_bob")
    assert camera.D.tolist() == [-0.05, 0.01, 1e-4, -1e-4, 0.001]
    assert camera.K.tolist() == [1000.5, 0, 255.5, 0, 1001.25, 239.5, 0, 0, 1]


@pytest.mark.parametrize("name", ENCODINGS)
@pytest.mark.parametrize("kind", KINDS)
@given(data=st.binary(max_size=200))
def test_arbitrary_bytes_are_a_message_or_undecodable(name, kind, data):
    for message in (data, b"\x00\x01\x00\x00" + data):
        try:
            decoded = encoding_named(name).decoded(kind, message)
        except UndecodableError:
            continue
        assert isinstance(decoded.sensor_id, str)


def test_no_two_encodings_claim_the_same_messages():
    encodings = [encoding_named(name) for name in ENCODINGS]
    assert len({e.message_encoding for e in encodings}) == len(encodings)
    kinds = {(s, kind) for e in encodings for kind in KINDS for s in e.schema_names[kind]}
    assert len({schema for schema, _ in kinds}) == len(kinds)


def test_an_unknown_encoding_is_refused_with_those_that_are_known():
    with pytest.raises(ValueError, match="'cbor': not one of protobuf, json, ros2"):
        encoding_named("cbor")


# A fourth encoding: plain text, a line per field, "name value value ...".

_MESSAGES = {FRAME: FrameMessage, STATE: StateMessage, CALIBRATION: CalibrationMessage}
_TEXTS = ("sensor_id", "frame", "frame_id", "distortion_model")
_INTEGERS = ("timestamp", "frame_number", "width", "height")


def _encode_text(kind, values):
    lines = []
    for name, value in values.items():
        words = [] if value is None else np.atleast_1d(value).tolist()
        lines.append(" ".join([name, *(str(word) for word in words)]))
    return "\n".join(lines).encode()


def _decode_text(kind, data):
    lines = [line.split(" ") for line in data.decode().splitlines()]
    values = {}
    for name, *words in lines:
        if name in _TEXTS:
            values[name] = words[0]
        elif name in _INTEGERS:
            values[name] = int(words[0])
        elif name in ("exposure_s", "line_time_s") or "_sigma_" in name:
            values[name] = float(words[0])
        else:
            values[name] = np.array(words, float)
    values["time_ns"] = values.pop("timestamp")
    if kind == CALIBRATION:
        values["sensor_id"] = values.pop("frame_id")
    message = _MESSAGES[kind]
    return message(**{name: values[name] for name in message._fields if name in values})


ENCODING = MessageEncoding(
    message_encoding="plain",
    schema_encoding="plaintext",
    schema_names={kind: (f"plain.{kind}",) for kind in KINDS},
    schema=lambda kind: b"a line per field: name value value ...",
    encode=_encode_text,
    decode=_decode_text,
)


def write(path, encoding):
    rng = np.random.default_rng(0)
    with LogWriter(path, encoding=encoding, chunk_size=2000) as log:
        log.camera("sat1", START_NS, CAMERA)
        for i in range(50):
            x, time_ns = rng.uniform(0, 500, 4).astype(np.float32), START_NS + i
            log.state("sat1", time_ns, position_km=[7000.0, i, 2.0], attitude_xyzw=[0, 0.6, 0, 0.8])
            log.frame("sat1", time_ns, frame_number=i, exposure_s=0.2, x_px=x, y_px=x + 1)
    return path


def test_an_encoding_that_is_only_registered_is_written_and_read(tmp_path, monkeypatch):
    monkeypatch.setitem(registry.ENCODINGS, "text", __name__)
    as_text = read_log(write(tmp_path / "a.mcap", "text"))
    as_protobuf = read_log(write(tmp_path / "b.mcap", "protobuf"))
    assert as_text.exposures.num_rows == 50
    assert as_text.rejects.num_rows == 0
    places = ["source", "offset"]
    assert as_text.exposures.drop_columns(places).equals(as_protobuf.exposures.drop_columns(places))
    assert as_text.states.equals(as_protobuf.states)
    assert as_text.cameras.equals(as_protobuf.cameras)


def test_messages_of_a_registered_encoding_are_judged_like_others(tmp_path, monkeypatch):
    monkeypatch.setitem(registry.ENCODINGS, "text", __name__)
    path = tmp_path / "a.mcap"
    with LogWriter(path, encoding="text") as log:
        for number, x in enumerate(([1.0], [np.nan], ["?"], [4.0])):
            log.frame("s", START_NS, frame_number=number, exposure_s=1, x_px=x, y_px=[1.0])
    log = read_log(path)
    assert array(log.exposures, "frame_number").tolist() == [0, 3]
    assert flatten(log.exposures, "x_px")[0].tolist() == [1.0, 4.0]
    assert sorted(log.rejects["reason"].to_pylist()) == ["nan", "undecodable_frame"]
