"""The nightly flow: a simulated night compared with its truth, and nights with missing data."""

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from prefect.task_runners import ThreadPoolTaskRunner
from scenes.dataset_tables import contents

from epipole.flows.nightly import nightly
from epipole.flows.simulate import simulate
from epipole.io.datasets.dataset import read_table
from epipole.io.logs.writer import LogWriter
from epipole.schemas.errors import DatasetError, LogError
from epipole.schemas.tables import TABLES

NIGHT = "2019-04-01"
SECOND_NS = 1_000_000_000
START_NS = int(np.datetime64("2019-04-01T04:00:00", "ns").astype(np.int64))
ARCSEC_DEG = 1 / 3600

OPTICS = {
    "width": 512, "height": 512, "fx_px": 14666.0, "fy_px": 14666.0, "cx_px": 255.5,
    "cy_px": 255.5, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0,
}  # fmt: skip

pytestmark = pytest.mark.usefixtures("prefect")


def scan(dataset: Path, table: str) -> pl.DataFrame:
    return pl.read_parquet(f"{dataset}/night=*/{table}/*.parquet")


def truth(log: Path, table: str) -> pl.DataFrame:
    return pl.read_parquet(f"{log}.truth/{table}.parquet")


def write_log(path: Path, sensors: dict[str, dict], start_ns: int = START_NS) -> Path:
    """Write a log: ten frames per sensor with three centroids each; options leave things out."""
    with LogWriter(path) as log:
        for sensor_id, leave in sensors.items():
            if leave.get("camera", True):
                log.camera(sensor_id, start_ns, OPTICS)
            for k in range(10):
                t = start_ns + k * SECOND_NS
                if leave.get("states", True):
                    log.state(
                        sensor_id, t, position_km=[7000.0, 7.5 * k, 0.0],
                        velocity_km_s=[0.0, 7.5, 0.0], attitude_xyzw=[0.0, 0.0, 0.0, 1.0],
                        attitude_sigma_arcsec=30.0,
                    )  # fmt: skip
                x = [100.0, 200.0, np.nan if leave.get("nan_frame") == k else 300.0]
                log.frame(
                    sensor_id, t, frame_number=k, exposure_s=0.1, x_px=x, y_px=[50.0, 250.0, 400.0]
                )
    return path


def test_stars_and_attitudes_are_those_of_the_truth(night_log, night_dataset):
    points = truth(night_log, "points")
    key = ["sensor_id", "frame_number", "centroid"]
    stars = scan(night_dataset, "stars").join(points, on=key, how="left")
    right = (stars["kind"] == 0) & (stars["source"] == stars["star_id"])
    assert right.mean() >= 0.999
    assert len(stars) >= 0.95 * (points["kind"] == 0).sum()
    frames = scan(night_dataset, "frames").join(
        truth(night_log, "frames"), on=key[:2], how="left", suffix="_true"
    )
    assert (frames["attitude_source"] == "stars").mean() >= 0.9
    names = [f"q{a}" for a in "xyzw"]
    q = frames.select(names).to_numpy() * frames.select(f"{n}_true" for n in names).to_numpy()
    cosine = np.abs(q.sum(axis=1))
    turned_arcsec = np.degrees(2 * np.arccos(np.minimum(cosine, 1))) / ARCSEC_DEG
    assert np.median(turned_arcsec) < 120  # about the boresight, in a 2 degree field
    assert np.max(turned_arcsec) < 1800


def test_views_of_an_object_are_of_one_object(night_log, night_dataset):
    points = truth(night_log, "points")
    views = scan(night_dataset, "associations").filter("used").drop_nulls("centroid")
    views = views.join(points, on=["sensor_id", "frame_number", "centroid"], how="left")
    assert (views["kind"] == 1).mean() >= 0.99
    sources = (
        views.filter(pl.col("kind") == 1).group_by("object_id").agg(pl.col("source").n_unique())
    )
    assert sources["source"].to_list() == [1] * len(sources)
    assert views["object_id"].n_unique() == 9


def test_every_object_has_a_position_at_nearly_every_epoch(night_dataset):
    positions = scan(night_dataset, "positions")
    epochs = scan(night_dataset, "epochs")["epoch"].n_unique()
    assert epochs >= 58
    assert positions.group_by("object_id").len()["len"].min() >= 0.9 * epochs
    radius_km = (positions["x_km"] ** 2 + positions["y_km"] ** 2 + positions["z_km"] ** 2).sqrt()
    # Geostationary distance, and the error of two arcseconds seen from 40,000 km.
    np.testing.assert_allclose(radius_km, 42164.0, atol=30.0)


@pytest.mark.long
def test_a_run_again_on_more_workers_gives_the_same_bytes(night_log, night_dataset, tmp_path):
    for workers in (1, 3):
        runner = ThreadPoolTaskRunner(max_workers=workers)
        nightly.with_options(task_runner=runner)(
            [str(night_log)], str(tmp_path / "out"), again=True
        )
        assert contents(tmp_path / "out") == contents(night_dataset)


@pytest.mark.long
def test_the_parts_of_a_night_in_any_order_give_the_same_rows(night_log, night_dataset, tmp_path):
    simulate("four_sensor_geo", tmp_path / "cut.mcap", seed=7, logs=2)
    parts = sorted(str(p) for p in tmp_path.glob("*.mcap"))
    nightly(parts, str(tmp_path / "a"))
    nightly([*parts[::-1], parts[0]], str(tmp_path / "b"))
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    for table in set(TABLES) - {"sources", "nights"}:
        whole, cut = (read_table(d, table, NIGHT) for d in (night_dataset, tmp_path / "a"))
        assert cut.equals(whole), table


@pytest.mark.long
def test_a_run_without_a_log_of_the_night_is_refused_and_names_it(tmp_path):
    simulate("four_sensor_geo", tmp_path / "cut.mcap", seed=7, logs=2)
    parts = sorted(str(p) for p in tmp_path.glob("*.mcap"))
    out = tmp_path / "out"
    nightly(parts, str(out))
    before = contents(out)
    with pytest.raises(DatasetError, match=r"was also made from cut-2\.mcap"):
        nightly(parts[:1], str(out))
    assert contents(out) == before
    nightly(parts[:1], str(out), replace=True)
    assert read_table(out, "sources", NIGHT)["name"].to_pylist() == ["cut-1.mcap"]


@pytest.mark.long
def test_a_log_over_midnight_makes_two_nights_and_one_can_be_chosen(tmp_path):
    midnight_ns = int(np.datetime64("2019-04-02", "ns").astype(np.int64))
    log = write_log(tmp_path / "n.mcap", {"a": {}}, midnight_ns - 5 * SECOND_NS)
    nightly([str(log)], str(tmp_path / "both"))
    both = contents(tmp_path / "both")
    counts = [read_table(tmp_path / "both", "frames", f"2019-04-0{d}").num_rows for d in (1, 2)]
    assert counts == [5, 5]
    nightly([str(log)], str(tmp_path / "one"), night="2019-04-02")
    one = contents(tmp_path / "one")
    of_second = {name: data for name, data in both.items() if name.startswith("night=2019-04-02")}
    assert one.keys() == of_second.keys()
    row = "night=2019-04-02/nights/part-0.parquet"  # tells that there was no night before
    assert {name for name in one if one[name] != of_second[name]} == {row}
    state = nightly([str(log)], str(tmp_path / "none"), night="2019-04-03", return_state=True)
    assert state.is_completed()
    assert "no frames on 2019-04-03 in these logs; they have" in state.message
    assert not (tmp_path / "none").exists()


def test_a_sensor_without_calibration_is_left_out_and_named(tmp_path):
    log = write_log(tmp_path / "n.mcap", {"seeing": {}, "blind": {"camera": False}})
    summary = nightly([str(log)], str(tmp_path / "out"))
    assert summary.rejects["no_calibration"] == 10
    rejects = scan(tmp_path / "out", "rejects").filter(pl.col("reason") == "no_calibration")
    assert rejects["sensor_id"].to_list() == ["blind"]
    assert set(scan(tmp_path / "out", "frames")["sensor_id"]) == {"seeing"}


def test_no_sensor_with_calibration_is_an_error_that_names_them(tmp_path):
    log = write_log(tmp_path / "n.mcap", {"blind": {"camera": False}})
    with pytest.raises(LogError, match=r"n\.mcap: no sensor has a calibration \(blind\)"):
        nightly([str(log)], str(tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_sensor_without_states_keeps_its_frames_and_gives_no_positions(tmp_path):
    log = write_log(tmp_path / "n.mcap", {"placed": {}, "lost": {"states": False}})
    nightly([str(log)], str(tmp_path / "out"))
    frames = scan(tmp_path / "out", "frames").filter(pl.col("sensor_id") == "lost")
    assert len(frames) == 10
    assert frames["x_km"].null_count() == 10
    rejects = scan(tmp_path / "out", "rejects").filter(pl.col("reason") == "no_state")
    assert rejects.select("sensor_id", "count").rows() == [("lost", 10)]
    assert "lost" not in set(scan(tmp_path / "out", "epochs")["sensor_id"])


def test_a_bad_frame_is_a_reject_and_the_others_are_used(tmp_path):
    log = write_log(tmp_path / "n.mcap", {"a": {"nan_frame": 4}})
    nightly([str(log)], str(tmp_path / "out"))
    assert scan(tmp_path / "out", "frames")["frame_number"].to_list() == [0, 1, 2, 3, *range(5, 10)]
    rejects = scan(tmp_path / "out", "rejects").filter(pl.col("stage") == "read")
    assert rejects.select("sensor_id", "source", "count").rows() == [("a", "n.mcap", 1)]


def test_what_was_left_out_is_counted_by_reason(night_run):
    night_dataset, summary = night_run
    rejects = scan(night_dataset, "rejects")
    assert sum(summary.rejects.values()) == rejects["count"].sum()
    assert summary.positions == len(scan(night_dataset, "positions"))
    assert summary.objects == 9
