"""Find cameras: for which sensors, what is said of them, and the rows that hold from then on."""

import numpy as np
import pyarrow as pa
import pytest
from scenes.cameras import cameras_of

from epipole.schemas.bridge import array
from epipole.schemas.work_tables import CAMERAS
from epipole.tasks.algorithms.geometry.camera import Camera, mirrored
from epipole.tasks.calibrate.find_camera import (
    CameraFinding,
    residuals_are_large,
    rich_frames,
    stars_are_clustered,
)

TOLD = Camera(1024, 1024, 3660.0, 3660.0, 511.5, 511.5)
TIME = 1_554_091_200_630_490_482  # not a whole number of microseconds


def test_a_finding_says_what_is_different():
    longer = TOLD._replace(fx_px=3813.7, fy_px=3813.7)
    said = str(CameraFinding("a", TOLD, longer))
    assert said == ("a: the focal length is 4.2 % longer than logged (3813.7 px, not 3660.0)")
    said = str(CameraFinding("a", TOLD, mirrored(TOLD)))
    assert said == "a: the image is mirrored (y up?)"
    assert "no search finds stars" in str(CameraFinding("a", TOLD, None))


def test_a_finding_says_how_far_distortion_moves_the_corners():
    found = TOLD._replace(k1=-1.0)
    said = str(CameraFinding("a", TOLD, found))
    moved = 3660 * (np.hypot(512, 512) / 3660) ** 3
    assert said == (
        f"a: distortion moves its corners by some {moved:.0f} px more than logged "
        "(k1 about -1, not 0)"
    )


def stars(x_px, y_px, frame):
    columns = {"frame_number": np.asarray(frame, np.int64), "x_px": x_px, "y_px": y_px}
    return pa.table(columns)


@pytest.mark.parametrize(("size_px", "is_one"), [(1023.0, False), (600.0, False), (150.0, True)])
def test_stars_all_over_the_image_are_told_from_clusters(size_px, is_one):
    """Clusters of six stars that move through the image."""
    rng = np.random.default_rng(0)
    frame = np.repeat(np.arange(30), 6)
    corner = rng.uniform(0, 1023 - size_px, (30, 2))[frame]
    x, y = (corner + rng.uniform(0, size_px, (180, 2))).T
    assert stars_are_clustered(stars(x, y, frame), TOLD) == is_one


@pytest.mark.parametrize(
    ("n_stars", "residual_px", "is_far"),
    [(12, 4.0, True), (24, 4.0, False), (12, 0.4, False), (24, 0.2, False)],
)
def test_stars_that_are_few_and_far_from_their_places_contradict_a_camera(
    n_stars, residual_px, is_far
):
    """Many false points alone do not, nor does a sensor with large errors."""
    solved = {"n_centroids": [25] * 9, "n_stars": [n_stars] * 9, "residual_px": [residual_px] * 9}
    assert residuals_are_large(pa.table(solved)) == is_far
    assert not residuals_are_large(pa.table(solved).slice(0, 0))


def test_few_frames_with_a_cluster_say_nothing():
    rng = np.random.default_rng(1)
    frame = np.repeat(np.arange(10), 5)
    x, y = rng.uniform(0, 1023, (2, 50))
    x[:15], y[:15] = 500 + 0.05 * x[:15], 500 + 0.05 * y[:15]
    assert not stars_are_clustered(stars(x, y, frame), TOLD)
    assert not stars_are_clustered(stars(*np.empty((2, 0)), []), TOLD)
    assert not stars_are_clustered(stars(np.array([3.0]), np.array([4.0]), [7]), TOLD)


def test_the_rows_of_the_sensor_get_its_camera_and_keep_their_time():
    told = cameras_of({"a": TOLD, "b": TOLD})
    told = told.set_column(
        1, CAMERAS.field("time"), pa.array([TIME] * 2, CAMERAS.field("time").type)
    )
    finding = CameraFinding("b", TOLD, mirrored(TOLD))
    found = finding.cameras(told, finding.camera)
    assert finding.nominal == mirrored(TOLD)
    assert found["sensor_id"].to_pylist() == ["b"]
    assert array(found, "fy_px").tolist() == [-TOLD.fy_px]
    assert array(found, "time").tolist() == [TIME]


def test_frames_with_many_centroids_of_all_parts_of_the_night_are_tried():
    n_centroids = np.tile(np.arange(100), 3)
    assert (rich_frames(n_centroids) % 100 == 74).all()
    assert (rich_frames(n_centroids) // 100).tolist() == [1, 2, 0]  # the middle comes first


@pytest.mark.parametrize("n", [1, 2, 3])
def test_each_of_few_frames_is_tried(n):
    assert sorted(rich_frames(np.full(n, 7))) == list(range(n))
