"""ROS 2 messages: the published definitions, and CDR in the other byte order."""

import struct

import pytest

from epipole.io.logs.messages.ros2_cdr import ENCODING, message_definition, ros2_schema
from epipole.schemas.log_messages import DECLARED, FRAME, STATE

# The .msg files of epipole_msgs, which recorders compile.
DEFINITIONS = {
    FRAME: """\
builtin_interfaces/Time timestamp
string sensor_id
uint64 frame_number
float64 exposure_s
float32[] x_px
float32[] y_px
float32[] flux
float32[] sigma_px
""",
    STATE: """\
builtin_interfaces/Time timestamp
string sensor_id
string frame
float64[] position_km
float64[] velocity_km_s
float64 position_sigma_km
float64[] attitude_xyzw
float64 attitude_sigma_arcsec
""",
}


@pytest.mark.parametrize(("kind", "fields"), DEFINITIONS.items())
def test_definitions_are_those_that_recorders_write(kind, fields):
    assert message_definition(DECLARED[kind]).partition("\n")[2] == fields


@pytest.mark.parametrize("kind", [FRAME, STATE])
def test_a_schema_defines_the_time_it_uses(kind):
    text = ros2_schema(kind).decode()
    assert "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec" in text


def test_big_endian_cdr_is_read():
    arrays = {"x_px": [1.5, -2.0], "y_px": [3.25, 4.0], "flux": [], "sigma_px": [0.5, 0.125]}
    body = struct.pack(">iI", 1_554_091_200, 123_456_789)
    body += struct.pack(">I5s", 5, b"sat1\0") + bytes(7)  # aligned to 8 from here
    body += struct.pack(">Qd", (1 << 40) + 1, 0.25)
    for numbers in arrays.values():
        body += struct.pack(f">I{len(numbers)}f", len(numbers), *numbers)
    frame = ENCODING.decoded(FRAME, b"\x00\x00\x00\x00" + body)
    assert (frame.time_ns, frame.sensor_id) == (1_554_091_200_123_456_789, "sat1")
    assert (frame.frame_number, frame.exposure_s) == ((1 << 40) + 1, 0.25)
    for name, numbers in arrays.items():
        assert getattr(frame, name).tolist() == numbers
