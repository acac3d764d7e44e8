"""Correct a clock: frames at their true times, with the states of their sensor then."""

import numpy as np
import pyarrow as pa

from epipole.schemas.bridge import array, table
from epipole.schemas.work_tables import SENSOR_STATES_AT_FRAMES, SOLUTIONS
from epipole.tasks.check.check_sensors import SensorVerdict
from epipole.tasks.check.correct_clock import at_true_times, with_sensor_states

LATE, EARLY = SensorVerdict("a", 0.25, 0.01, "clock"), SensorVerdict("b", -0.5, 0.01, "clock")


def frames(schema, **columns):
    """Two frames each of sensors a, b and c, a second apart; other columns are null or 0."""
    n = 6
    values = {
        "sensor_id": ["a", "a", "b", "b", "c", "c"],
        "frame_number": np.array([1, 2] * 3),
        "time": np.array([0, 1_000_000_000] * 3),
    } | columns
    for field in schema:
        if field.name not in values:
            fill = "stars" if field.type == pa.string() else 0
            values[field.name] = pa.array([None if field.nullable else fill] * n, field.type)
    return table(schema, values)


def test_frames_of_wrong_clocks_are_put_at_their_true_times():
    for clock, shift_s in ((LATE, -0.25), (EARLY, 0.5)):
        moved = at_true_times(frames(SENSOR_STATES_AT_FRAMES), clock)
        expected = (np.array([0, 1] * 3) + shift_s) * 1e9
        np.testing.assert_array_equal(array(moved, "time"), expected)
        assert moved.schema.equals(SENSOR_STATES_AT_FRAMES)


def test_states_are_joined_by_frame_whatever_their_order():
    at_frames = frames(SENSOR_STATES_AT_FRAMES, **{f"{a}_km": np.arange(6.0) for a in "xyz"})
    solutions = frames(SOLUTIONS, x_km=np.full(6, 7.0))
    moved = with_sensor_states(solutions, at_frames.take([5, 3, 1, 0, 2, 4]))
    assert moved["x_km"].to_pylist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    assert moved["sensor_id"].equals(solutions["sensor_id"])
    missing = with_sensor_states(solutions, at_frames.slice(1))
    assert missing["x_km"].to_pylist() == [None, 1.0, 2.0, 3.0, 4.0, 5.0]
