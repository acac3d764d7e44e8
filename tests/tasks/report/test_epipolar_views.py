"""Epipolar lines: of two sensors that are apart from each other."""

from scenes.made_nights import START_NS, filled, reader_of

from epipole.tasks.report.epipolar_views import OPTICS, read_epipolar_views

SENSORS = ["a", "b", "c"]


def views_of(seen):
    """Return the views of sensors a and b at one position, and c; `seen` are sensor and object."""
    night = reader_of({
        "frames": filled("frames", sensor_id=SENSORS, qx=[0.0] * 3, qy=[0.0] * 3, qz=[0.0] * 3,
                         qw=[1.0] * 3, x_km=[7000.0, 7000.0, 0.0], y_km=[0.0, 0.0, 7000.0],
                         z_km=[0.0] * 3),
        "associations": filled("associations", sensor_id=[sensor for sensor, _ in seen],
                               object_id=[name for _, name in seen],
                               x_px=[50.0] * len(seen), y_px=[60.0] * len(seen)),
        "calibrations": filled("calibrations", sensor_id=SENSORS, fx_px=[900.0] * 3,
                               fy_px=[900.0] * 3, fisheye=[False] * 3),
    })  # fmt: skip
    calibrations = night.read("calibrations", ["sensor_id", *OPTICS])
    return read_epipolar_views(night, START_NS, calibrations, dict.fromkeys(SENSORS, (100, 100)))


def test_two_sensors_at_one_position_have_no_epipolar_lines():
    of_two = [("a", "o1"), ("b", "o1"), ("a", "o2"), ("b", "o2")]
    assert views_of(of_two) is None
    found = views_of([*of_two, ("c", "o1")])
    assert {found.from_sensor, found.in_sensor} == {"a", "c"}
