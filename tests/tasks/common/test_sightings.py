"""Lone detections: frames too few for a tracklet still take part, under unpublished ids."""

import numpy as np
import polars as pl
import pyarrow as pa
import pytest

from epipole.schemas.settings import TrackletSettings
from epipole.tasks.algorithms.times import instants_of
from epipole.tasks.common.sightings import MARK, in_lone_frames, published_ids

SECOND = 1_000_000_000


def lone(*seconds):
    return in_lone_frames(np.array(seconds, np.int64) * SECOND, TrackletSettings()).tolist()


def test_a_single_frame_stands_alone():
    assert lone() == []
    assert lone(5) == [True]
    assert lone(5, 6) == [True, True]
    assert lone(5, 6, 7) == [False] * 3


def test_a_frame_hours_from_the_others_stands_alone():
    assert lone(0, 1, 2, 3, 7200) == [False] * 4 + [True]


def test_where_the_rate_of_frames_changes_none_stands_alone():
    slow, fast = np.arange(100), np.arange(100, 200, 0.1)
    assert not in_lone_frames(
        np.round(np.concatenate([slow, fast]) * SECOND).astype(np.int64), TrackletSettings()
    ).any()


def test_ids_of_lone_detections_are_not_published():
    ids = pa.chunked_array([pa.array(["sat1-3-4", f"{MARK}sat1-5-6"])])
    assert published_ids(ids).to_pylist() == ["sat1-3-4", None]


def test_frames_that_lie_together_make_one_epoch():
    times = np.array([10, 12, 20, 5 * SECOND, 5 * SECOND + 10], np.int64)
    assert instants_of(times, SECOND).tolist() == [14, 5 * SECOND + 5]
    assert instants_of(np.zeros(0, np.int64), SECOND).tolist() == []


SCENE = """
name = "one_frame"
start = 2019-04-01T04:00:00Z
duration_s = 1.0
seed = 3
[sensor_defaults]
magnitude_limit = 8.0
rate_hz = 1.0
phase = 0.4
camera = { width = 1024, height = 1024, fov_deg = 6.0 }
detection = { sigma_px = 0.15, false_points = 4.0, target_drop = 0.0 }
states = { prior_noise_arcsec = 20.0 }
pointing = { mode = "track", orbit = { position_km = [-39359.89, 15125.76, 64.30] } }
[[sensors]]
id = "a"
orbit = { a_km = 6977.0, i_deg = 35.0, raan_deg = 354.4, argp_deg = 71.8, true_anomaly_deg = 39.8 }
[[sensors]]
id = "b"
orbit = { a_km = 7470.0, i_deg = 63.4, raan_deg = 328.6, argp_deg = 7.2, true_anomaly_deg = 144.7 }
[[sensors]]
id = "c"
orbit = { a_km = 6995.0, i_deg = 98.1, raan_deg = 124.5, argp_deg = 189.7, true_anomaly_deg = 234 }
[[targets]]
count = 4
orbit = { position_km = [-39359.89, 15125.76, 64.30] }
spread_km = 400.0
magnitude = 7.0
"""


@pytest.fixture(scope="module")
def one_frame_dataset(prefect, tmp_path_factory):
    from epipole.flows.nightly import nightly
    from epipole.flows.simulate import simulate

    folder = tmp_path_factory.mktemp("one")
    (folder / "scene.toml").write_text(SCENE)
    log = folder / "one.mcap"
    simulate(str(folder / "scene.toml"), log)
    nightly([str(log)], str(folder / "out"))
    return folder


def test_sensors_of_one_frame_give_positions(one_frame_dataset):
    positions = pl.read_parquet(one_frame_dataset / "out/night=*/positions/*.parquet")
    assert len(positions) == 4
    assert positions["epoch"].n_unique() == 1


def test_views_of_lone_detections_have_no_tracklet(one_frame_dataset):
    views = pl.read_parquet(one_frame_dataset / "out/night=*/associations/*.parquet")
    assert len(views) == 12
    assert views["tracklet_id"].null_count() == 12
    assert views["centroid"].null_count() == 0


def test_lone_detections_that_positions_used_are_objects(one_frame_dataset):
    views = pl.read_parquet(one_frame_dataset / "out/night=*/associations/*.parquet")
    detections = pl.read_parquet(one_frame_dataset / "out/night=*/detections/*.parquet")
    key = ["sensor_id", "frame_number", "centroid"]
    used = detections.join(views.filter("used"), on=key, how="semi")
    assert used["kind"].to_list() == ["object"] * 12
    assert used["tracklet_id"].null_count() == 12
    others = detections.join(views.filter("used"), on=key, how="anti")
    assert set(others["kind"]) == {"unknown"}
