"""The line time of a rolling shutter, in calibrations of each encoding."""

import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration

from epipole.io.logs.messages.registry import encoding_named
from epipole.io.logs.writer import calibration_values
from epipole.schemas.log_messages import CALIBRATION

CAMERA = {
    "width": 512, "height": 512, "fx_px": 1000.0, "fy_px": 1000.0, "cx_px": 255.5, "cy_px": 255.5,
    "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0,
}  # fmt: skip


def values(line_time_s):
    return calibration_values(
        "sat1", 1_600_000_000_000_000_000, CAMERA | {"line_time_s": line_time_s}
    )


@pytest.mark.parametrize("name", ["protobuf", "json"])
@pytest.mark.parametrize("line_time_s", [0.0, 2.5e-5, -1e-6])
def test_it_is_read_as_it_was_written(name, line_time_s):
    encoding = encoding_named(name)
    data = encoding.encode(CALIBRATION, values(line_time_s))
    assert encoding.decoded(CALIBRATION, data).line_time_s == line_time_s


def test_a_public_calibration_has_none_and_ignores_it():
    public = CameraCalibration(frame_id="sat1", width=512)
    encoding = encoding_named("protobuf")
    assert encoding.decoded(CALIBRATION, public.SerializeToString()).line_time_s == 0.0
    data = encoding.encode(CALIBRATION, values(2.5e-5))
    assert CameraCalibration.FromString(data).K[0] == 1000.0


def test_ros_has_no_field_for_it_and_says_so():
    encoding = encoding_named("ros2")
    data = encoding.encode(CALIBRATION, values(0.0))
    assert encoding.decoded(CALIBRATION, data).line_time_s == 0.0
    with pytest.raises(ValueError, match="has no line time"):
        encoding.encode(CALIBRATION, values(2.5e-5))
