"""The messages of a log, declared once: every encoding follows from here.

A log has three kinds of message. Frames and states are declared here. Calibrations are public
messages: `foxglove.CameraCalibration`, or `sensor_msgs/msg/CameraInfo` in ROS 2. The name of a
channel's schema gives the kind of its messages. The topic does not matter.
"""

from typing import NamedTuple

FRAME, STATE, CALIBRATION = "frame", "state", "calibration"
KINDS = (FRAME, STATE, CALIBRATION)

SENSOR_ID_PATTERN = "[A-Za-z0-9][A-Za-z0-9_-]{0,62}"
SENSOR_ID_RULE = "1 to 63 letters of A-Z and a-z, digits, - and _; the first a letter or digit"


class Member(NamedTuple):
    """A field of a message; `type` is time, string, uint64, double or float."""

    name: str
    number: int
    type: str
    doc: str
    repeated: bool = False


class MessageType(NamedTuple):
    """A message: its full name, its meaning and its fields, numbered from 1 in this order."""

    name: str
    doc: str
    members: tuple[Member, ...]


CENTROID_FRAME = MessageType(
    "epipole.CentroidFrame",
    "One exposure of one star sensor, reduced to the centroids of its bright spots.",
    (
        Member("timestamp", 1, "time", "Middle of the exposure, UTC."),
        Member("sensor_id", 2, "string", SENSOR_ID_PATTERN),
        Member("frame_number", 3, "uint64", "Unique per sensor, increasing with time."),
        Member("exposure_s", 4, "double", "Exposure time."),
        Member("x_px", 5, "float", "Column; (0, 0) is the middle of the top-left pixel.", True),
        Member("y_px", 6, "float", "Row, downwards.", True),
        Member("flux", 7, "float", "Linear, any unit; empty where unknown.", True),
        Member("sigma_px", 8, "float", "1-sigma error per axis; empty where unknown.", True),
    ),
)

SENSOR_STATE = MessageType(
    "epipole.SensorState",
    "Where a sensor is and, where known, how it is turned.",
    (
        Member("timestamp", 1, "time", "Time of the state, UTC."),
        Member("sensor_id", 2, "string", "Star sensor."),
        Member("frame", 3, "string", "GCRF, EME2000, TEME or ITRF."),
        Member("position_km", 4, "double", "(3) in that frame.", True),
        Member("velocity_km_s", 5, "double", "(3) in that frame; empty where unknown.", True),
        Member("position_sigma_km", 6, "double", "1-sigma per axis; 0 where unknown."),
        Member(
            "attitude_xyzw",
            7,
            "double",
            "Unit quaternion, scalar last, that turns GCRF into sensor coordinates; a prior.",
            True,
        ),
        Member("attitude_sigma_arcsec", 8, "double", "1-sigma per axis; 0 where unknown."),
    ),
)

# The messages that this project declares, by kind.
DECLARED = {FRAME: CENTROID_FRAME, STATE: SENSOR_STATE}
CALIBRATION_NAME = "foxglove.CameraCalibration"
# A field that this project adds to it; messages without it, and other readers, are not affected.
LINE_TIME = Member(
    "line_time_s",
    1000,
    "double",
    "Rolling shutter: time from the exposure of one row to that of the next; negative where the "
    "image is read from its last row; 0 or missing: all rows are exposed together.",
)
