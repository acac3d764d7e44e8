"""Find cameras: what is said of them, and the rows that hold from then on."""

import pyarrow as pa
from scenes.cameras import cameras_of

from epipole.schemas.bridge import array
from epipole.schemas.work_tables import CAMERAS
from epipole.tasks.algorithms.geometry.camera import Camera, mirrored
from epipole.tasks.calibrate.find_camera import CameraFinding

TOLD = Camera(1024, 1024, 3660.0, 3660.0, 511.5, 511.5)
TIME = 1_554_091_200_630_490_482  # not a whole number of microseconds


def test_a_finding_says_what_is_different():
    longer = TOLD._replace(fx_px=3813.7, fy_px=3813.7)
    said = str(CameraFinding("a", TOLD, longer))
    assert said == ("a: the focal length is 4.2 % longer than told (3813.7 px, not 3660.0)")
    said = str(CameraFinding("a", TOLD, mirrored(TOLD)))
    assert said == "a: the image is mirrored (y up?)"
    assert "show no stars" in str(CameraFinding("a", TOLD, None))


def test_the_rows_of_the_sensor_get_its_camera_and_keep_their_time():
    told = cameras_of({"a": TOLD, "b": TOLD})
    told = told.set_column(
        1, CAMERAS.field("time"), pa.array([TIME] * 2, CAMERAS.field("time").type)
    )
    finding = CameraFinding("b", TOLD, mirrored(TOLD))
    found = finding.cameras(told, finding.camera)
    assert finding.as_told == mirrored(TOLD)
    assert found["sensor_id"].to_pylist() == ["b"]
    assert array(found, "fy_px").tolist() == [-TOLD.fy_px]
    assert array(found, "time").tolist() == [TIME]
