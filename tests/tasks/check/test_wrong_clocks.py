"""A night with a wrong clock, end to end: corrected, or named and its sensor left out."""

import tomllib
from pathlib import Path

import polars as pl
import pytest

from epipole.schemas.scene import validate_scene

pytestmark = pytest.mark.long

FOUR_SENSORS = Path(__file__).parents[3] / "io/simulation/built_in/four_sensor_geo.toml"


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
def test_a_sensor_whose_clock_was_corrected_takes_part(prefect, tmp_path, offset_s):
    summary, out = run(tmp_path, offset_s, correct_clocks=True)
    assert len(summary.faults) == 1
    side = "late" if offset_s > 0 else "early"
    assert summary.faults[0].startswith("the clock of sat3 is")
    offset_told_s = float(summary.faults[0].split()[5])
    assert side in summary.faults[0]
    assert abs(offset_told_s - abs(offset_s)) < 0.06  # four sigma
    assert scan(out, "positions")["n_sensors"].mean() > 3.8
    truth = pl.read_parquet(tmp_path / "late.mcap.truth/frames.parquet")
    late = scan(out, "frames").join(truth, on=["sensor_id", "frame_number"], suffix="_true")
    off_s = (late["time"].cast(pl.Int64) - late["t_ns"]).abs().max() / 1e9
    assert off_s < 0.06
    assert "clock_off" not in summary.rejects


def test_a_sensor_whose_clock_stays_wrong_is_named_and_left_out(prefect, tmp_path):
    summary, out = run(tmp_path, 0.2)
    assert summary.faults[0].startswith("the clock of sat3 is 0.")
    assert summary.rejects["clock_off"] > 0
    assert "sat3" not in set(scan(out, "associations")["sensor_id"])
    assert scan(out, "positions")["object_id"].n_unique() == 9
