"""ROS 2 messages: the published definitions, and CDR in the other byte order."""

import struct

import pytest

from epipole.io.logs.messages.ros2_cdr import ENCODING, message_definition, ros2_schema
from epipole.io.logs.writer import calibration_values
from epipole.schemas.log_messages import CALIBRATION, DECLARED, FRAME, STATE

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


def camera_info(bins=(0, 0), window=(0, 0, 0, 0)):
    """Return the CameraInfo of a sensor of 1024 x 768 pixels, with binning and a window."""
    camera = {
        "width": 1024, "height": 768, "fx_px": 2000.0, "fy_px": 1900.0, "cx_px": 511.5,
        "cy_px": 383.5, "k1": 0.1, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0,
    }  # fmt: skip
    data = ENCODING.encode(
        CALIBRATION, calibration_values("sat1", 1_600_000_000_000_000_000, camera)
    )
    return data[:-25] + struct.pack("<6I", *bins, *window) + b"\0"


@pytest.mark.parametrize(
    ("bins", "window", "sides", "focal", "middle"),
    [
        ((0, 0), (0, 0, 0, 0), (1024, 768), (2000.0, 1900.0), (511.5, 383.5)),
        ((1, 1), (0, 0, 768, 1024), (1024, 768), (2000.0, 1900.0), (511.5, 383.5)),
        ((2, 4), (0, 0, 0, 0), (512, 192), (1000.0, 475.0), (255.5, 95.5)),
        ((0, 0), (256, 128, 512, 512), (512, 512), (2000.0, 1900.0), (255.5, 255.5)),
        ((2, 2), (256, 128, 512, 512), (256, 256), (1000.0, 950.0), (127.5, 127.5)),
    ],
)  # fmt: skip
def test_a_camera_info_is_read_for_the_pixels_of_its_images(bins, window, sides, focal, middle):
    # ROS states the optics of all pixels; images may be binned, or show a part of them.
    found = ENCODING.decoded(CALIBRATION, camera_info(bins, window))
    assert (found.width, found.height) == sides
    assert (found.K[0], found.K[4]) == focal
    assert (found.K[2], found.K[5]) == middle
    assert found.D[0] == 0.1
