"""JSON as other programs may write it."""

import json

import numpy as np
import pytest

from epipole.io.logs.messages.encoding import UndecodableError
from epipole.io.logs.messages.json_text import ENCODING, json_schema
from epipole.schemas.log_messages import DECLARED, FRAME, STATE

VALUES = {
    "timestamp": {"sec": 1_554_091_200, "nsec": 123_456_789},
    "sensor_id": "sat1",
    "frame_number": 7,
    "exposure_s": 0.25,
    "x_px": [1.5, -2.0],
    "y_px": [3.25, 4.0],
}


def decoded(changes):
    return ENCODING.decoded(FRAME, json.dumps(VALUES | changes).encode())


@pytest.mark.parametrize(
    "text",
    ["2019-04-01T04:00:00.123456789Z", "2019-04-01T06:00:00.123456789+02:00"],
)
def test_times_of_protobufs_json_mapping_are_read(text):
    assert decoded({"timestamp": text}).time_ns == 1_554_091_200_123_456_789


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
def test_an_invalid_time_is_none(timestamp):
    assert decoded({"timestamp": timestamp}).time_ns is None


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
        {"timestamp": {"sec": 1_554_091_200.5, "nsec": 0}},
    ],
)
def test_values_of_the_wrong_type_are_undecodable(changes):
    with pytest.raises(UndecodableError):
        decoded(changes)


@pytest.mark.parametrize("text", ["NaN", "Infinity", "-Infinity"])
def test_nan_and_infinity_are_read_although_json_has_neither(text):
    data = b'{"timestamp": {"sec": 5, "nsec": 6}, "sensor_id": "a", "x_px": [1.5, %s]}'
    frame = ENCODING.decoded(FRAME, data % text.encode())
    assert frame.time_ns == 5_000_000_006
    np.testing.assert_array_equal(frame.x_px, [1.5, float(text)])


@pytest.mark.parametrize("kind", [FRAME, STATE])
def test_a_schema_names_every_field(kind):
    schema = json.loads(json_schema(kind))
    assert list(schema["properties"]) == [m.name for m in DECLARED[kind].members]
