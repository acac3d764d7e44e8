"""Sensors without stars: with a prior they take part, else they are tracked in the image."""

import numpy as np
import polars as pl
import pytest

from epipole.schemas.scene import validate_scene

pytestmark = pytest.mark.long

MIDDLE = [-39367.69, 15079.54, 454.20]
# Two sensors see stars, the third has a prior attitude alone, the fourth nothing at all.
SIGHT = {"a": (10.0, True), "b": (10.0, True), "c": (1.0, True), "d": (1.0, False)}
ORBITS = {
    "a": {"a_km": 6977.6, "i_deg": 35.0, "raan_deg": 354.4, "argp_deg": 71.8,
          "true_anomaly_deg": 39.8},
    "b": {"a_km": 7470.9, "i_deg": 63.4, "raan_deg": 328.6, "argp_deg": 7.2,
          "true_anomaly_deg": 144.7},
    "c": {"a_km": 6978.8, "i_deg": 35.1, "raan_deg": 115.2, "argp_deg": 83.2,
          "true_anomaly_deg": 337.0},
    "d": {"a_km": 6995.7, "i_deg": 98.1, "raan_deg": 124.5, "argp_deg": 189.7,
          "true_anomaly_deg": 234.5},
}  # fmt: skip


def scene():
    sensors = [
        {
            "id": name,
            "orbit": ORBITS[name],
            "magnitude_limit": limit,
            "rate_hz": 1.0,
            "camera": {"width": 512, "height": 512, "fov_deg": 2.0},
            "detection": {"sigma_px": 0.15, "false_points": 2.0, "target_drop": 0.05},
            "states": {"prior_noise_arcsec": 10.0, "prior_bias_arcsec": 20.0} if prior else {},
            "pointing": {"mode": "track", "orbit": {"position_km": MIDDLE}},
        }
        for name, (limit, prior) in SIGHT.items()
    ]
    targets = [{"count": 5, "orbit": {"position_km": MIDDLE}, "spread_km": 150.0, "magnitude": 0.5}]
    return validate_scene(
        {"name": "starless", "duration_s": 45.0, "seed": 2, "sensors": sensors, "targets": targets},
        "test",
    )


@pytest.fixture(scope="module")
def night(prefect, tmp_path_factory):
    from epipole.flows.nightly import nightly
    from epipole.flows.simulate import simulate

    folder = tmp_path_factory.mktemp("starless")
    simulate(scene(), folder / "s.mcap")
    # No camera is searched for in frames without stars: that takes most of the time.
    settings = {"identification": {"calibrate": "off"}}
    nightly([str(folder / "s.mcap")], str(folder / "out"), settings=settings)

    def scan(name):
        return pl.read_parquet(folder / f"out/night=*/{name}/*.parquet")

    truth = pl.read_parquet(folder / "s.mcap.truth/points.parquet")
    return scan, truth


def test_each_sensor_has_the_attitude_it_can_have(night):
    scan, _ = night
    source = scan("frames").group_by("sensor_id").agg(pl.col("attitude_source").mode().first())
    assert dict(source.iter_rows()) == {"a": "stars", "b": "stars", "c": "prior", "d": "none"}


@pytest.mark.parametrize("sensor", ["c", "d"])
def test_a_sensor_without_stars_tracks_its_objects(night, sensor):
    scan, truth = night
    seen = scan("detections").filter(pl.col("sensor_id") == sensor)
    seen = seen.rename({"kind": "taken_for"}).join(
        truth, on=["sensor_id", "frame_number", "centroid"]
    )
    objects = seen.filter(pl.col("kind") == 1)
    assert (objects["taken_for"] == "object").mean() > 0.97
    assert objects["tracklet_id"].null_count() == (objects["taken_for"] != "object").sum()
    of_track = objects.drop_nulls("track_id").group_by("track_id").agg(pl.col("source").n_unique())
    assert of_track["source"].to_list() == [1] * 5
    strays = seen.filter(pl.col("kind") == 2)
    assert (strays["taken_for"] == "object").mean() < 0.05
    assert scan("tracklets").filter(pl.col("sensor_id") == sensor).height == 5


def test_without_an_attitude_a_detection_has_no_direction_and_takes_no_part(night):
    scan, _ = night
    lost = scan("detections").filter(pl.col("sensor_id") == "d")
    assert lost["ra_deg"].null_count() == lost["dec_deg"].null_count() == len(lost)
    assert np.isfinite(lost["sigma_arcsec"].to_numpy()).all()
    assert "d" not in set(scan("associations")["sensor_id"])
    assert "d" not in set(scan("epochs")["sensor_id"])


def test_a_sensor_with_a_prior_takes_part(night):
    scan, _ = night
    positions = scan("positions")
    assert positions["object_id"].n_unique() == 5
    assert positions["n_sensors"].mean() > 2.8
    assert scan("rejects").filter(pl.col("stage") == "identify").height == 0
