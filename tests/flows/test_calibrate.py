"""What `epipole calibrate` prints of a fitted camera."""

import pytest

from epipole.flows.calibrate import calibrate, calibration_message, lines
from epipole.io.logs.writer import LogWriter
from epipole.schemas.errors import LogError
from epipole.tasks.algorithms.geometry.camera import Camera
from epipole.tasks.calibrate.calibrate_unknown import CameraReport

TERMS = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2")
CAMERA = Camera(1024, 1024, 2000.0, 2000.0, 511.5, 511.5, k3=0.1)


@pytest.mark.parametrize(
    # At the corner, 0.362 focal lengths off, the term moves the image by 0.8 of these pixels.
    ("sigma_k3", "says"),
    [(0.5, "k3 0.10000 +- 0.50000"), (2.0, "k3 not known")],
)
def test_a_term_that_the_stars_do_not_show_is_not_printed(sigma_k3, says):
    sigma = dict.fromkeys(TERMS, 1e-3) | {"k3": sigma_k3}
    report = CameraReport("a", CAMERA, 1.1, True, True, CAMERA, sigma, 3, 3, 90, 0.1)
    (line,) = (line for line in lines(report) if line.startswith("  distortion"))
    assert line.endswith(f"p1 0.00000 +- 0.00100, p2 0.00000 +- 0.00100, {says}")


def test_the_calibration_to_write_has_the_time_from_row_to_row():
    rolling = CAMERA._replace(line_time_s=-2e-5)
    for camera, expected in ((rolling, -2e-5), (CAMERA, None)):
        report = CameraReport("a", camera, 1.1, True, True, camera, {}, 3, 3, 90, 0.1)
        assert calibration_message(report).get("line_time_s") == expected


def test_a_broken_file_in_a_folder_is_left_out_as_in_a_run(tmp_path, caplog):
    (tmp_path / "broken.mcap").write_bytes(b"not a log")
    with LogWriter(tmp_path / "n.mcap") as log:
        log.frame("a", 10**18, frame_number=0, exposure_s=0.1, x_px=[1.0], y_px=[2.0])
    (report,) = calibrate([str(tmp_path)], 12.0)
    assert (report.sensor_id, report.n_frames, report.camera) == ("a", 1, None)
    assert "broken.mcap: not an MCAP file" in caplog.text
    with pytest.raises(LogError, match=r"broken\.mcap: not an MCAP file"):
        calibrate([str(tmp_path), str(tmp_path / "broken.mcap")], 12.0)
