"""A sensor that holds an object on the middle of a pixel, as a hot pixel stands, keeps it."""

import polars as pl
import pytest

from epipole.schemas.scene import validate_scene

pytestmark = pytest.mark.long

KEY = ["sensor_id", "frame_number", "centroid"]
GEO_KM = [-39359.89, 15125.76, 64.30]


def scene(seed, n_sensors, hot_pixels):
    """Each sensor points at one object, whose place is the middle of pixel (256, 256)."""
    sensors = [
        {
            "id": f"s{k}",
            "magnitude_limit": 8.0,
            "orbit": {"a_km": 7000.0, "i_deg": 35.0 + 20 * k, "raan_deg": 354.0,
                      "argp_deg": 71.0, "true_anomaly_deg": 39.0 - 25 * k},
            "camera": {"width": 512, "height": 512, "fov_deg": 6.0, "cx_px": 256.0, "cy_px": 256.0},
            "detection": {"sigma_px": 0.15, "false_points": 1.0, "hot_pixels": hot_pixels,
                          "target_drop": 0.05},
            "pointing": {"mode": "track", "target": 0},
        }
        for k in range(n_sensors)
    ]  # fmt: skip
    target = {"count": 1, "orbit": {"position_km": GEO_KM}, "magnitude": 7.0}
    return validate_scene(
        {"name": "held", "duration_s": 40.0, "seed": seed, "sensors": sensors, "targets": [target]},
        "test",
    )


@pytest.mark.parametrize(
    ("seed", "n_sensors", "outcome"), [(1, 1, "seen_by_one"), (2, 2, "object")]
)
def test_an_object_that_stays_on_a_pixel_is_no_hot_pixel(
    prefect, tmp_path, seed, n_sensors, outcome
):
    from epipole.flows.nightly import nightly
    from epipole.flows.simulate import simulate

    hot_pixels = 4
    simulate(scene(seed, n_sensors, hot_pixels), tmp_path / "held.mcap")
    nightly([str(tmp_path / "held.mcap")], str(tmp_path / "out"))
    truth = pl.read_parquet(tmp_path / "held.mcap.truth/points.parquet").rename({"kind": "true"})
    night = {
        name: pl.read_parquet(tmp_path / f"out/night=*/{name}/*.parquet")
        for name in ("detections", "tracklets", "rejects")
    }
    detections = night["detections"].join(truth, on=KEY)
    held = detections.filter(pl.col("true") == 1)
    assert set(held["kind"]) == {"object"}
    assert held["tracklet_id"].n_unique() == n_sensors
    own = night["tracklets"].filter(pl.col("tracklet_id").is_in(held["tracklet_id"].to_list()))
    assert own["outcome"].to_list() == [outcome] * n_sensors
    # Hot pixels that scatter as light does: most are found, and each that is has a row.
    hot = detections.filter((pl.col("true") == 2) & (pl.col("kind") == "hot_pixel"))
    assert len(hot) >= 0.7 * hot_pixels * n_sensors * 40
    assert hot["tracklet_id"].null_count() == len(hot)
    rows = night["rejects"].filter(pl.col("reason") == "hot_pixel")
    assert rows["count"].sum() == len(hot)
