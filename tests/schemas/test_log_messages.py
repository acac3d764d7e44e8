"""The declared messages are those that recorders write: names, numbers and types are fixed."""

import pytest

from epipole.schemas.log_messages import CENTROID_FRAME, SENSOR_STATE

# As in epipole.proto, which recorders compile.
FIELDS = {
    CENTROID_FRAME: """
        time timestamp = 1;
        string sensor_id = 2;
        uint64 frame_number = 3;
        double exposure_s = 4;
        repeated float x_px = 5;
        repeated float y_px = 6;
        repeated float flux = 7;
        repeated float sigma_px = 8;
    """,
    SENSOR_STATE: """
        time timestamp = 1;
        string sensor_id = 2;
        string frame = 3;
        repeated double position_km = 4;
        repeated double velocity_km_s = 5;
        double position_sigma_km = 6;
        repeated double attitude_xyzw = 7;
        double attitude_sigma_arcsec = 8;
    """,
}


@pytest.mark.parametrize(("message", "fields"), FIELDS.items())
def test_fields_are_those_that_recorders_write(message, fields):
    declared = [
        f"{'repeated ' if m.repeated else ''}{m.type} {m.name} = {m.number};"
        for m in message.members
    ]
    assert declared == [line.strip() for line in fields.strip().splitlines()]
