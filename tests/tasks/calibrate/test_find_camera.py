"""Find cameras: what is said of them, and the rows that hold from then on."""

from epipole.schemas.bridge import array, concat, table
from epipole.schemas.work_tables import CAMERAS
from epipole.tasks.algorithms.geometry.camera import Camera, mirrored
from epipole.tasks.calibrate.find_camera import CameraFinding

TOLD = Camera(1024, 1024, 3660.0, 3660.0, 511.5, 511.5)
TIME = 1_554_091_200_630_490_482  # not a whole number of microseconds


def row(sensor_id):
    values = {name: [value] for name, value in TOLD._asdict().items()}
    return table(CAMERAS, {"sensor_id": [sensor_id], "time": [TIME]} | values)


def test_a_finding_says_what_is_different():
    longer = TOLD._replace(fx_px=3813.7, fy_px=3813.7)
    said = str(CameraFinding("a", TOLD, longer))
    assert said == ("a: the focal length is 4.2 % longer than told (3813.7 px, not 3660.0)")
    said = str(CameraFinding("a", TOLD, mirrored(TOLD)))
    assert said == "a: the image is mirrored (y up?)"
    assert "show no stars" in str(CameraFinding("a", TOLD, None))


def test_the_rows_of_the_sensor_get_its_camera_and_keep_their_time():
    told = concat(CAMERAS, [row("a"), row("b")])
    found = CameraFinding("b", TOLD, mirrored(TOLD)).cameras(told)
    assert found["sensor_id"].to_pylist() == ["b"]
    assert array(found, "fy_px").tolist() == [-TOLD.fy_px]
    assert array(found, "time").tolist() == [TIME]
