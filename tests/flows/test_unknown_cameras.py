"""Logs whose calibration is wrong or missing: what a run makes of them, and `calibrate`."""

import logging

import numpy as np
import polars as pl
import pytest
from scenes.altered_logs import altered, table_rows
from scenes.mirrored_logs import write_mirrored
from scenes.simulated import scene_of

from epipole.flows.calibrate import as_dict, calibrate, lines
from epipole.flows.nightly import nightly
from epipole.flows.simulate import simulate
from epipole.io.logs.reader import read_log
from epipole.io.logs.writer import LogWriter
from epipole.schemas.bridge import array
from epipole.schemas.errors import LogError
from epipole.schemas.given_settings import with_assumptions
from epipole.schemas.settings import Settings
from epipole.tasks.calibrate import calibrate_sensors

pytestmark = pytest.mark.long

FOCAL = 0.05  # by which the true focal length is longer than logged


def simulated(folder, **departure):
    """Frames of one sensor in a low orbit, a field of 12 degrees, no prior attitudes."""
    camera = {"fov_deg": 12.0, "departure": departure}
    pointing = {"mode": "random", "clear_of_earth_deg": 15.0}
    scene = scene_of({"camera": camera, "pointing": pointing})
    return simulate(scene, folder / "n.mcap", seed=3).logs[0]


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return simulated(tmp_path_factory.mktemp("log"), focal=FOCAL)


@pytest.fixture(scope="module")
def right_log(tmp_path_factory):
    return simulated(tmp_path_factory.mktemp("right_log"))


@pytest.fixture(scope="module")
def told_px(log):
    return float(array(read_log(str(log)).cameras, "fx_px")[0])


def run(log, out, principal_point_sigma_px=None, **identification):
    sensors = {"principal_point_sigma_px": principal_point_sigma_px}
    settings = Settings.model_validate({"identification": identification, "sensors": sensors})
    nightly([str(log)], str(out), settings)
    return {
        name: pl.read_parquet(f"{out}/night=*/{name}/*.parquet")
        for name in ("frames", "calibrations")
    }


@pytest.mark.usefixtures("prefect")
def test_a_run_finds_a_focal_length_and_says_so(log, told_px, tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        made = run(log, tmp_path / "out")
    assert (made["frames"]["attitude_source"] == "stars").mean() > 0.9
    assert made["calibrations"]["fx_px"][0] == pytest.approx(told_px * (1 + FOCAL), rel=2e-3)
    assert any(
        "a: the focal length is 5.0 % longer than logged" in r.message for r in caplog.records
    )
    assert any(r.message.endswith("; used") for r in caplog.records)


@pytest.mark.usefixtures("prefect")
def test_a_fisheye_with_another_focal_length_than_logged_is_found(tmp_path):
    # 80 degrees along the sides, 113 to the corners.
    camera = {"fov_deg": 80.0, "width": 2048, "height": 2048, "fisheye": True, "k1": -0.02,
              "k2": 5e-3, "k3": -1e-3, "k4": 2e-4, "departure": {"focal": 0.03}}  # fmt: skip
    pointing = {"mode": "random", "clear_of_earth_deg": 50.0}
    scene = scene_of({"camera": camera, "pointing": pointing, "magnitude_limit": 4.5})
    log = simulate(scene, tmp_path / "n.mcap", seed=3).logs[0]
    made = run(log, tmp_path / "out")
    assert (made["frames"]["attitude_source"] == "stars").mean() > 0.9
    assert made["frames"]["residual_px"].median() < 0.2
    assert made["calibrations"]["fisheye"][0]
    focal_px = 1024 / np.radians(40.0) * 1.03
    assert made["calibrations"]["fx_px"][0] == pytest.approx(focal_px, rel=5e-4)


@pytest.mark.usefixtures("prefect")
@pytest.mark.parametrize(("mode", "said"), [("report", True), ("off", False)])
def test_a_camera_is_not_used_where_the_settings_say_so(log, tmp_path, caplog, mode, said):
    with caplog.at_level(logging.WARNING):
        made = run(log, tmp_path / "out", calibrate=mode)
    assert (made["frames"]["attitude_source"] == "stars").sum() == 0
    assert any("longer than logged" in r.message for r in caplog.records) == said


@pytest.mark.usefixtures("prefect")
def test_a_mirrored_log_is_solved(log, tmp_path, caplog):
    mirrored = write_mirrored(log, tmp_path / "m.mcap")
    with caplog.at_level(logging.WARNING):
        made = run(mirrored, tmp_path / "out")
    straight = run(log, tmp_path / "straight")["frames"]
    assert (made["frames"]["attitude_source"] == "stars").mean() > 0.9
    assert made["calibrations"]["fy_px"][0] < 0
    assert any("mirrored (y up?)" in r.message for r in caplog.records)
    # The same boresights as of the log with rows that count down.
    off = made["frames"].join(straight, on="frame_number", suffix="_straight")
    assert (off["dec_deg"] - off["dec_deg_straight"]).abs().max() < 2e-3


@pytest.mark.usefixtures("prefect")
@pytest.mark.parametrize("mode", ["use", "off"])
def test_a_principal_point_that_is_uncertain_makes_attitudes_as_uncertain(
    right_log, tmp_path, mode
):
    made = run(right_log, tmp_path / "out", principal_point_sigma_px=4.0, calibrate=mode)
    sigma = made["frames"].filter(pl.col("attitude_source") == "stars")["sigma_x_arcsec"]
    told = read_log(str(right_log)).cameras
    pixel_arcsec = np.degrees(1 / array(told, "fx_px")[0]) * 3600
    assert 0.5 < sigma.median() / (4.0 * pixel_arcsec) < 1.05  # the stars tell a little


@pytest.mark.usefixtures("prefect")
def test_optics_with_which_frames_are_lost_are_not_used(
    right_log, told_px, tmp_path, caplog, monkeypatch
):
    fitted = calibrate_sensors.calibrate_sensors

    def misled(stars, cameras, told, sigma_px):
        fit = fitted(stars, cameras, told, sigma_px)
        wrong = calibrate_sensors.with_optics(cameras, {0: {"fx_px": 2 * told_px}})
        return fit._replace(cameras=wrong, departed=["a"])

    monkeypatch.setattr(calibrate_sensors, "calibrate_sensors", misled)
    with caplog.at_level(logging.WARNING):
        made = run(right_log, tmp_path / "out")
    assert (made["frames"]["attitude_source"] == "stars").mean() > 0.9
    assert not len(made["calibrations"])
    assert any("fitted to the stars of a identify hardly any" in r.message for r in caplog.records)


@pytest.mark.parametrize("field_deg", [None, 10.0])
def test_a_camera_without_a_calibration_is_calibrated(log, told_px, tmp_path, field_deg):
    bare = write_mirrored(log, tmp_path / "m.mcap", calibrated=False)
    (report,) = calibrate([str(bare)], field_deg)
    assert report.camera.fx_px == pytest.approx(told_px * (1 + FOCAL), rel=2e-3)
    assert report.camera.fy_px < 0
    assert as_dict(report)["stated"] is None
    assert any("no calibration in the log" in line for line in lines(report))


def test_what_calibrate_prints_makes_the_log_right(log, told_px):
    (report,) = calibrate([str(log)])
    assert report.n_identified > 0.9 * report.n_frames
    K = as_dict(report)["calibration"]["K"]
    assert K[0] == pytest.approx(told_px * (1 + FOCAL), rel=2e-3)
    assert any(f'"K": [{K[0]}' in line for line in lines(report))


def test_of_several_calibrations_the_one_of_the_last_frames_is_calibrated(right_log, tmp_path):
    contents = read_log(str(right_log))
    times = np.sort(array(contents.exposures, "time"))
    half_ns = int(times[len(times) // 2])
    (row,) = table_rows(contents.cameras)

    def binned(frame):
        scale = 0.5 if frame["time_ns"] >= half_ns else 1.0
        pixels = {name: scale * (np.array(frame[name]) + 0.5) - 0.5 for name in ("x_px", "y_px")}
        return pixels | {"sigma_px": scale * np.array(frame["sigma_px"])}

    log = altered(right_log, tmp_path / "a.mcap", frame=binned)
    smaller = {name: (row[name] + 0.5) / 2 - 0.5 for name in ("cx_px", "cy_px")}
    smaller |= {name: row[name] // 2 for name in ("width", "height")}
    smaller |= {name: row[name] / 2 for name in ("fx_px", "fy_px")}
    with LogWriter(tmp_path / "b.mcap") as writer:
        writer.camera("a", half_ns, row | smaller)
    (report,) = calibrate([str(log), str(tmp_path / "b.mcap")])
    assert report.nominal.fx_px == row["fx_px"] / 2
    assert report.camera.fx_px == pytest.approx(row["fx_px"] / 2, rel=1e-3)
    assert report.n_identified == report.n_frames == np.count_nonzero(times >= half_ns)


def test_a_log_is_calibrated_as_the_settings_read_it(right_log):
    (report,) = calibrate([str(right_log)], None, with_assumptions(Settings(), ["a.line_time_s=0"]))
    assert "line_time_s" not in as_dict(report)["calibration"]
    assumed = with_assumptions(Settings(), ["*.line_time_s=1e-9"])
    (report,) = calibrate([str(right_log)], None, assumed)
    assert as_dict(report)["calibration"]["line_time_s"] == 1e-9


def test_frames_without_stars_are_not_calibrated(tmp_path):
    path = tmp_path / "n.mcap"
    with LogWriter(path) as writer:
        for k in range(8):
            at = [100.0 * (1 + (j * 7 + k * 3) % 9) + j for j in range(8)]
            writer.frame("a", 10**18 + k * 10**9, frame_number=k, exposure_s=0.1, x_px=at,
                         y_px=at[::-1])  # fmt: skip
    (report,) = calibrate([str(path)], 12.0)
    assert report.camera is None
    assert as_dict(report)["calibration"] is None
    assert any("not found" in line for line in lines(report))


def test_a_log_without_frames_is_refused(tmp_path):
    path = tmp_path / "n.mcap"
    with LogWriter(path) as writer:
        writer.state("a", 10**18, position_km=[7000.0, 0.0, 0.0])
    with pytest.raises(LogError, match="no frames"):
        calibrate([str(path)])
