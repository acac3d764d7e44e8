"""Clocks of a night end to end: told, put right or left out; frames and places follow."""

import tomllib
from pathlib import Path

import numpy as np
import polars as pl
import pyarrow as pa
import pytest

from epipole.schemas.bridge import array, empty, table, to_polars
from epipole.schemas.scene import validate_scene
from epipole.schemas.settings import Settings
from epipole.schemas.tables import ASSOCIATIONS, POSITIONS
from epipole.schemas.work_tables import PLACES, SOLUTIONS, VIEWS
from epipole.tasks.check.correct_clock import at_places, at_true_times
from epipole.tasks.check.estimate_clocks import Clock, clocks_of, total_offsets
from epipole.tasks.solve.collect_clock_views import collect_clock_views
from epipole.tasks.solve.leave_out_sensors import leave_out_sensors

FOUR_SENSORS = Path(__file__).parents[3] / "io/simulation/built_in/four_sensor_geo.toml"
LATE, EARLY, SOUND = Clock("a", 0.25, 0.01, True), Clock("b", -0.5, 0.01, True), Clock(
    "c", 0.01, 0.01, False
)  # fmt: skip


def frames(schema, **columns):
    """Two frames each of sensors a, b and c, a second apart; what is not given is null or 0."""
    n = 6
    given = {
        "sensor_id": ["a", "a", "b", "b", "c", "c"],
        "frame_number": np.array([1, 2] * 3),
        "time": np.array([0, 1_000_000_000] * 3),
    } | columns
    for field in schema:
        if field.name not in given:
            fill = "stars" if field.type == pa.string() else 0
            given[field.name] = pa.array([None if field.nullable else fill] * n, field.type)
    return table(schema, given)


def test_frames_of_wrong_clocks_are_put_at_their_true_times():
    for clock, shift_s in ((LATE, -0.25), (EARLY, 0.5)):
        moved = at_true_times(frames(PLACES), clock)
        expected = (np.array([0, 1] * 3) + shift_s) * 1e9
        np.testing.assert_array_equal(array(moved, "time"), expected)
        assert moved.schema.equals(PLACES)


def test_places_are_taken_by_frame_whatever_their_order():
    places = frames(PLACES, **{f"{a}_km": np.arange(6.0) for a in "xyz"})
    solutions = frames(SOLUTIONS, x_km=np.full(6, 7.0))
    moved = at_places(solutions, places.take([5, 3, 1, 0, 2, 4]))
    assert moved["x_km"].to_pylist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    assert moved["sensor_id"].equals(solutions["sensor_id"])
    lost = at_places(solutions, places.slice(1))
    assert lost["x_km"].to_pylist() == [None, 1.0, 2.0, 3.0, 4.0, 5.0]


def test_what_was_put_right_is_told_with_what_is_left():
    again = [Clock("a", 0.001, 0.008, False), SOUND]
    told = total_offsets([LATE, EARLY], again)
    assert [clock.sensor_id for clock in told] == ["a", "b", "c"]
    assert told[0] == Clock("a", 0.251, 0.008, True)
    assert told[1:] == [EARLY, SOUND]


def test_nothing_seen_tells_nothing_of_clocks():
    tables = (empty(s) for s in (VIEWS, ASSOCIATIONS, POSITIONS, SOLUTIONS))
    assert clocks_of(to_polars(collect_clock_views(*tables, Settings()))) == []
    remaining = leave_out_sensors(empty(VIEWS), ["a"])
    assert [rows.num_rows for rows in remaining] == [0, 0, 0]


def run(folder, offset_s, **alignment):
    """Four sensors and nine objects, the third sensor's clock off."""
    from epipole.flows.nightly import nightly
    from epipole.flows.simulate import simulate

    log = folder / "late.mcap"
    scene = tomllib.loads(FOUR_SENSORS.read_text()) | {"duration_s": 40.0, "seed": 3}
    scene["sensors"][2]["clock_offset_s"] = offset_s
    simulate(validate_scene(scene, "late"), log)
    out = folder / f"out{len(alignment)}"
    return nightly([str(log)], str(out), {"alignment": alignment}), out


def scan(out, name):
    return pl.read_parquet(out / f"night=*/{name}/*.parquet")


@pytest.mark.parametrize("offset_s", [-2.0, 0.2])
def test_a_sensor_whose_clock_was_put_right_takes_part(prefect, tmp_path, offset_s):
    summary, out = run(tmp_path, offset_s, correct_clocks=True)
    assert len(summary.clocks) == 1
    side = "late" if offset_s > 0 else "early"
    assert summary.clocks[0].startswith("the clock of sat3 is")
    told = float(summary.clocks[0].split()[5])
    assert side in summary.clocks[0]
    assert abs(told - abs(offset_s)) < 0.06  # four sigma
    assert scan(out, "positions")["n_sensors"].mean() > 3.8
    truth = pl.read_parquet(tmp_path / "late.mcap.truth/frames.parquet")
    late = scan(out, "frames").join(truth, on=["sensor_id", "frame_number"], suffix="_true")
    off_s = (late["time"].cast(pl.Int64) - late["t_ns"]).abs().max() / 1e9
    assert off_s < 0.06
    assert "clock_off" not in summary.rejects


def test_a_sensor_whose_clock_stays_wrong_is_named_and_left_out(prefect, tmp_path):
    summary, out = run(tmp_path, 0.2)
    assert summary.clocks[0].startswith("the clock of sat3 is 0.")
    assert summary.rejects["clock_off"] > 0
    assert "sat3" not in set(scan(out, "associations")["sensor_id"])
    assert scan(out, "positions")["object_id"].n_unique() == 9
