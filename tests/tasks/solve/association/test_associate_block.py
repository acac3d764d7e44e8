"""Sensors that are left out: their views are set apart and counted, the others are unchanged."""

import pyarrow as pa
from scenes.associations import filled

from epipole.schemas.bridge import array, empty
from epipole.schemas.rejects import Reason
from epipole.schemas.work_tables import VIEWS
from epipole.tasks.solve.leave_out_sensors import leave_out_sensors


def views() -> pa.Table:
    sensors = ["a", "b", "a", "c", "b", "b"]
    return filled(VIEWS, 6, {"sensor_id": sensors, "epoch": [60, 50, 40, 30, 20, 90]})


def test_views_of_these_sensors_are_set_apart_and_counted():
    remaining = leave_out_sensors(
        views(),
        {"b": Reason.CLOCK_OFF, "c": Reason.EPHEMERIS_OFF, "absent": Reason.DISAGREES},
    )
    assert remaining.views["sensor_id"].to_pylist() == ["a", "a"]
    assert remaining.left_out["sensor_id"].to_pylist() == ["b", "c", "b", "b"]
    rows = remaining.rejects
    assert rows.select(["sensor_id", "stage", "reason", "count"]).to_pylist() == [
        {"sensor_id": "b", "stage": "check", "reason": "clock_off", "count": 3},
        {"sensor_id": "c", "stage": "check", "reason": "ephemeris_off", "count": 1},
    ]
    assert array(rows, "time").tolist() == [20, 30]  # the first view of each


def test_without_such_sensors_nothing_changes():
    remaining = leave_out_sensors(views(), {})
    assert remaining.views.equals(views())
    assert remaining.left_out.num_rows == remaining.rejects.num_rows == 0


def test_without_views_nothing_is_left_out():
    remaining = leave_out_sensors(empty(VIEWS), {"a": Reason.CLOCK_OFF})
    assert [rows.num_rows for rows in remaining] == [0, 0, 0]
