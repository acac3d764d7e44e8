"""A night with a sensor at fault: it is corrected, or its errors are as large as its fault."""

import tomllib
from pathlib import Path

import polars as pl
import pytest

from epipole.flows.evaluate import evaluate
from epipole.flows.night import stages
from epipole.schemas.scene import validate_scene

pytestmark = pytest.mark.long

FOUR_SENSORS = Path(__file__).parents[3] / "io/simulation/built_in/four_sensor_geo.toml"


def run(folder, offset_s, offset_km=0.0, **alignment):
    """Four sensors and nine objects; the third sensor's clock is off, or its ephemeris."""
    from epipole.flows.nightly import nightly
    from epipole.flows.simulate import simulate

    log = folder / "late.mcap"
    scene = tomllib.loads(FOUR_SENSORS.read_text()) | {"duration_s": 40.0, "seed": 3}
    scene["sensors"][2]["clock_offset_s"] = offset_s
    scene["sensors"][2]["faults"] = {"position_offset_km": offset_km}
    simulate(validate_scene(scene, "late"), log)
    out = folder / f"out{len(alignment)}"
    return nightly([str(log)], str(out), {"alignment": alignment}), out


def scan(out, name):
    return pl.read_parquet(out / f"night=*/{name}/*.parquet")


@pytest.mark.parametrize("offset_s", [-2.0, 0.2])
def test_a_sensor_whose_clock_was_corrected_takes_part(prefect, tmp_path, monkeypatch, offset_s):
    tracked = []
    submit = stages.track_spans.submit

    def counted(batch, *others):
        tracked.extend(each.sensor.sensor_id for each in batch)
        return submit(batch, *others)

    monkeypatch.setattr(stages.track_spans, "submit", counted)
    summary, out = run(tmp_path, offset_s)
    others = [name for name in tracked if name != "sat3"]
    assert (sorted(others), len(tracked) > 4) == (["sat1", "sat2", "sat4"], True)
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


@pytest.mark.parametrize(
    ("offset_s", "offset_km", "fault", "added_km", "sigma_km"),
    [
        (0.2, 0.0, "the clock of sat3 is 0.", 1.5, 1.5),
        (0.0, 2.0, "the ephemeris of sat3 is ", 1.4, 0.05),  # its tracklets are undecided at first
        (0.0, 6.0, "the ephemeris of sat3 is ", 4.2, 0.05),  # its tracklets join none at first
    ],
)
def test_a_sensor_at_fault_takes_part_with_an_error_as_large(
    prefect, tmp_path, offset_s, offset_km, fault, added_km, sigma_km
):
    summary, out = run(tmp_path, offset_s, offset_km, correct_clocks=False)
    assert summary.faults[0].startswith(fault)
    (mistake,) = summary.mistakes
    assert mistake.startswith("sat3: lines of sight meet those of other sensors if its ")
    assert (summary.outcomes, summary.verdicts) == ({"object": 36}, {"sound": 9})
    assert summary.rejects == {}
    (row,) = scan(out, "checks").filter(check="sensor_fault").to_dicts()
    assert (row["sensor_id"], row["unit"]) == ("sat3", "km")
    assert sigma_km < row["value"] < 4 * sigma_km
    seen = scan(out, "observations")
    stated = dict(seen.group_by("sensor_id").agg(pl.col("position_sigma_km").min()).iter_rows())
    assert added_km < stated["sat3"] < 1.6 * added_km
    assert stated["sat1"] < 0.1
    report = evaluate(out, tmp_path / "late.mcap")
    assert 0.6 < report.nees_mean < 1.4
    assert report.nees_in_99 > 0.97


def test_a_sensor_that_is_far_too_wrong_is_left_out(prefect, tmp_path):
    summary, out = run(tmp_path, 0.0, 20.0)
    assert summary.faults[0].startswith("the ephemeris of sat3 is ")
    assert summary.mistakes == []
    assert summary.rejects["ephemeris_off"] > 0
    assert summary.outcomes == {"object": 27, "sensor_left_out": 9}
    assert "sat3" not in set(scan(out, "associations")["sensor_id"])
    assert scan(out, "positions")["object_id"].n_unique() == 9
