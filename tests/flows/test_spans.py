"""Spans: tracks and frames at their borders are complete."""

import datetime
import tomllib
from pathlib import Path

import polars as pl
import pytest

from epipole.flows.nightly import nightly
from epipole.flows.simulate import simulate
from epipole.io.datasets.dataset import read_table
from epipole.schemas.scene import validate_scene

NIGHT = "2019-04-01"
FOUR_SENSORS = Path(__file__).parents[2] / "io/simulation/built_in/four_sensor_geo.toml"
# Sensors high enough to see their objects for hours.
SLOW = """
name = "slow"
start = 2019-04-01T04:20:00Z
duration_s = 4200.0
seed = 5
[sensor_defaults]
magnitude_limit = 10.0
rate_hz = 0.1
outages_s = [[480.0, 2580.0]]
camera = { width = 512, height = 512, fov_deg = 2.0 }
detection = { sigma_px = 0.15, false_points = 1.0, target_drop = 0.05 }
states = { rate_hz = 0.1, prior_noise_arcsec = 20.0 }
pointing = { mode = "track", target = 0 }
[[sensors]]
id = "s1"
orbit = { a_km = 30000.0, i_deg = 35.0, raan_deg = 100.0, true_anomaly_deg = 40.0 }
[[sensors]]
id = "s2"
orbit = { a_km = 31000.0, i_deg = 10.0, raan_deg = 90.0, true_anomaly_deg = 60.0 }
[[targets]]
orbit = { position_km = [-39360.0, 15126.0, 64.0] }
magnitude = 8.0
"""

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("prefect")]


def rows(out: Path, table: str) -> pl.DataFrame:
    return pl.DataFrame(read_table(out, table, NIGHT))


def test_a_broken_track_is_joined_over_a_span_without_frames(tmp_path):
    # No frames from 04:28 to 05:03, so there is no span from 04:30 to 05:00.
    simulate(validate_scene(tomllib.loads(SLOW), "slow"), tmp_path / "slow.mcap")
    settings = {"tracklets": {"link_gap_s": 3600.0}}
    nightly([str(tmp_path / "slow.mcap")], str(tmp_path / "out"), settings)
    tracklets = rows(tmp_path / "out", "tracklets")
    assert tracklets["sensor_id"].to_list() == ["s1", "s2"] * 2
    assert tracklets["track_id"].to_list() == tracklets["tracklet_id"].to_list()[:2] * 2
    assert rows(tmp_path / "out", "positions")["object_id"].n_unique() == 1


@pytest.mark.parametrize(("start", "offset_s"), [("04:29:20", -1.5), ("04:29:59", 1.5)])
def test_frames_whose_true_times_lie_in_another_span_keep_all_centroids(tmp_path, start, offset_s):
    # As told, all frames of sat3 are on one side of 04:30.
    scene = tomllib.loads(FOUR_SENSORS.read_text()) | {"duration_s": 41.0, "seed": 3}
    scene["start"] = datetime.datetime.fromisoformat(f"{NIGHT}T{start}Z")
    scene["sensors"][2]["clock_offset_s"] = offset_s
    simulate(validate_scene(scene, "off"), tmp_path / "off.mcap")
    settings = {"alignment": {"correct_clocks": True}}
    summary = nightly([str(tmp_path / "off.mcap")], str(tmp_path / "out"), settings)
    assert summary.faults[0].startswith("the clock of sat3 is 1.")
    key = ["sensor_id", "frame_number"]
    frames = rows(tmp_path / "out", "frames").filter(sensor_id="sat3")
    border = datetime.datetime.fromisoformat(f"{NIGHT}T04:30:00Z")
    assert 0 < (frames["time"] < border).sum() < len(frames) == 41
    found = pl.concat(rows(tmp_path / "out", name).select(key) for name in ("stars", "detections"))
    counted = frames.join(found.group_by(key).len(), on=key, how="left")
    assert counted["len"].to_list() == counted["n_centroids"].to_list()
