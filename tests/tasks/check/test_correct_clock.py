"""Correct a clock: frames at their true times, with the states of their sensor then."""

import numpy as np
import pyarrow as pa

from epipole.schemas.bridge import array, concat, nullable, stack, table, unstack
from epipole.schemas.rejects import Reason, reject_rows
from epipole.schemas.tables import DETECTIONS, REJECTS
from epipole.schemas.work_tables import SENSOR_STATES_AT_FRAMES, SOLUTIONS
from epipole.tasks.algorithms.geometry.directions import (
    matrix_from_quaternion,
    quaternion_from_rotation_vector,
    radec_from_unit,
    unit_from_radec,
)
from epipole.tasks.check.check_sensors import SensorVerdict
from epipole.tasks.check.correct_clock import (
    at_true_times,
    rejects_at_true_times,
    with_prior_attitudes,
    with_sensor_states,
)
from epipole.tasks.identify.identify_span import without_state

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


def test_frames_that_have_no_state_at_their_true_times_are_counted():
    by_clock = frames(SENSOR_STATES_AT_FRAMES, x_km=pa.array([None, *[1.0] * 5]))
    other = reject_rows(Reason.OUTSIDE_IMAGE, sensor_id=["a"], time=[5], count=[2])
    before = concat(REJECTS, [other, without_state(by_clock)])
    at_true = frames(SENSOR_STATES_AT_FRAMES, x_km=pa.array([1.0, *[None] * 2, *[1.0] * 3]))
    for now, count in ((at_true, 2), (by_clock, 1), (by_clock.slice(1), 0)):
        after = rejects_at_true_times(before, now)
        found = dict(zip(after["reason"].to_pylist(), after["count"].to_pylist(), strict=True))
        assert found == {"outside_image": 2} | ({"no_state": count} if count else {})


def test_prior_attitudes_are_those_at_the_true_times():
    """The sensor turns by 0.1 degree between a frame's time by the clock and the true one."""
    before = quaternion_from_rotation_vector(np.array([[0.1 * k, 0.3, -0.2] for k in range(6)]))
    after = quaternion_from_rotation_vector(np.array([[0.1 * k, 0.3, -0.1983] for k in range(6)]))
    after[5] = np.nan
    source = ["stars", "prior", "prior", "stars", "prior", "prior"]
    solutions = frames(
        SOLUTIONS, frame_number=np.array([2, 1, 3, 5, 4, 6]), attitude_source=source,
        **{name: np.full(6, 9.0) for name in ("ra_deg", "dec_deg", "roll_deg")},
        **unstack("q{}", before, "xyzw"),
    )  # fmt: skip
    at_frames = frames(
        SENSOR_STATES_AT_FRAMES, frame_number=np.array([2, 1, 3, 5, 4, 6]),
        **{name: nullable(values) for name, values in unstack("q{}", after, "xyzw").items()},
    )  # fmt: skip
    # The same spot of the image in all frames: rows of frames 6, 4, 1, 2, 3 and 5.
    row = np.array([5, 4, 1, 0, 2, 3])
    spot = np.array([0.1, -0.2, 1.0]) / np.linalg.norm([0.1, -0.2, 1.0])
    ra, dec = np.degrees(radec_from_unit(spot @ matrix_from_quaternion(before[row])))
    detections = frames(
        DETECTIONS, frame_number=np.array([6, 4, 1, 2, 3, 5]), ra_deg=ra, dec_deg=dec
    )
    moved = with_prior_attitudes(solutions, detections, at_frames)
    turns = np.array([False, True, True, False, True, False])
    expected = np.where(turns[:, None], after, before)
    np.testing.assert_allclose(stack(moved["solutions"], "q{}", "xyzw"), expected, atol=1e-15)
    angles = [array(moved["solutions"], name) for name in ("ra_deg", "dec_deg")]
    u = unit_from_radec(*np.radians(angles))
    np.testing.assert_allclose(u[turns], matrix_from_quaternion(after[turns])[:, 2], atol=1e-15)
    assert (np.stack(angles)[:, ~turns] == 9.0).all()
    u = unit_from_radec(*np.radians([array(moved["detections"], n) for n in ("ra_deg", "dec_deg")]))
    R = matrix_from_quaternion(expected[row])
    np.testing.assert_allclose(np.einsum("nij,nj->ni", R, u), np.tile(spot, (6, 1)), atol=1e-15)
    others = detections.drop_columns(["ra_deg", "dec_deg"])
    assert moved["detections"].select(others.column_names).equals(others)
    stars = solutions.set_column(
        solutions.schema.get_field_index("attitude_source"),
        solutions.schema.field("attitude_source"),
        [["stars"] * 6],
    )
    same = with_prior_attitudes(stars, detections, at_frames)
    assert same["solutions"].equals(stars)
    assert same["detections"].equals(detections)
