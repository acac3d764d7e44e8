"""Calibrate sensors: optics that differ are found, others are unchanged."""

import numpy as np
import pyarrow as pa
import pytest
from scenes.cameras import cameras_of
from scipy.spatial.transform import Rotation

from epipole.schemas.bridge import array, concat, rows_of, stack_covariance, table
from epipole.schemas.columns import OPTICS_AXES
from epipole.schemas.tables import STARS
from epipole.schemas.work_tables import CAMERAS
from epipole.tasks.algorithms.geometry.camera import Camera, inside, project
from epipole.tasks.calibrate.calibrate_sensors import calibrate_sensors
from epipole.tasks.read.order_frames import with_uncertain_principal_points

SENT = Camera(1024, 1024, 3660.0, 3660.0, 511.5, 511.5)
TRUE = SENT._replace(fx_px=3671.0, fy_px=3671.0, k1=-0.08)


def stars_of(sensor_id, camera, seed=0, n_frames=40, used=SENT):
    """Return STARS of a sensor, identified with the camera `used` and attitudes with errors."""
    rng = np.random.default_rng(seed)
    parts = []
    for k in range(n_frames):
        v = np.column_stack([rng.uniform(-0.15, 0.15, (25, 2)), np.ones(25)])
        x, y = project(camera, v)
        seen = inside(camera, x, y)
        x, y = (c[seen] + rng.normal(0, 0.15, seen.sum()) for c in (x, y))
        px, py = project(used, Rotation.from_rotvec(rng.normal(0, 3e-4, 3)).apply(v[seen]))
        n = len(x)
        parts.append(
            table(
                STARS,
                {"sensor_id": [sensor_id] * n, "frame_number": [k] * n, "time": [k * 10**9] * n}
                | {"centroid": np.arange(n), "star_id": np.arange(n) + 1, "magnitude": [5.0] * n}
                | {"x_px": x, "y_px": y, "dx_px": x - px, "dy_px": y - py},
            )
        )
    return concat(STARS, parts)


def cameras(*sensor_ids, **changes):
    return cameras_of({name: SENT._replace(**changes) for name in sensor_ids})


def test_only_a_sensor_whose_optics_differ_gets_new_ones():
    stars, told = concat(STARS, [stars_of("a", TRUE), stars_of("b", SENT)]), cameras("a", "b")
    found = calibrate_sensors(stars, told, told)
    assert found.departed == ["a"]
    assert found.calibrations["sensor_id"].to_pylist() == ["a", "b"]
    fx = array(found.cameras, "fx_px")
    assert fx[0] == pytest.approx(TRUE.fx_px, abs=1.0)
    assert fx[1] == SENT.fx_px
    assert found.cameras["time"].equals(told["time"])
    off = array(found.calibrations, "fx_px") - [TRUE.fx_px, SENT.fx_px]
    assert np.all(np.abs(off) < 4 * array(found.calibrations, "sigma_fx_px"))


def test_only_new_optics_have_a_covariance_and_it_is_the_published_one():
    stars, told = concat(STARS, [stars_of("a", TRUE), stars_of("b", SENT)]), cameras("a", "b")
    found = calibrate_sensors(stars, told, told)
    cov = stack_covariance(found.cameras, "cov_{}", OPTICS_AXES)
    assert not cov[1].any()
    assert array(found.cameras, "cx_px")[0] == SENT.cx_px  # the stars do not demand another
    assert 2.0 < np.sqrt(cov[0, 2, 2]) < 10.0  # but it is as uncertain as it was not calibrated
    published = [array(found.calibrations, f"sigma_{name}")[0] for name in ("cx_px", "k1")]
    np.testing.assert_allclose(np.sqrt(np.diagonal(cov[0])[[2, 4]]), published)


def test_frames_identified_with_the_fitted_optics_are_not_identified_again():
    told = cameras("a")
    first = calibrate_sensors(stars_of("a", TRUE), told, told).cameras
    fitted = Camera(**first.select(list(Camera._fields)).to_pylist()[0])
    again = calibrate_sensors(stars_of("a", TRUE, used=fitted), first, told)
    assert again.departed == []
    assert again.cameras.equals(first)
    assert array(again.calibrations, "fx_px")[0] == pytest.approx(TRUE.fx_px, abs=1.0)


def test_other_optics_than_the_log_tells_get_a_covariance_once():
    present = cameras_of({"a": TRUE})  # right, but from elsewhere: nothing says how uncertain
    found = calibrate_sensors(stars_of("a", TRUE, used=TRUE), present, cameras("a"))
    assert found.departed == ["a"]
    assert stack_covariance(found.cameras, "cov_{}", OPTICS_AXES)[0, 2, 2] > 1.0


def place_sigma(found):
    """Return the 1-sigma error of the principal point along the columns, of each sensor [px]."""
    return np.sqrt(stack_covariance(found.cameras, "cov_{}", OPTICS_AXES)[:, 2, 2])


@pytest.mark.parametrize("sigma_px", [1.0, 3.0])
def test_a_principal_point_is_as_uncertain_as_the_settings_say(sigma_px):
    """Where the stars do not contradict the log, too. In 16 degrees they hardly say more."""
    stars = concat(STARS, [stars_of("a", TRUE), stars_of("b", SENT)])
    told = with_uncertain_principal_points(cameras("a", "b"), sigma_px)
    found = calibrate_sensors(stars, told, told, sigma_px)
    assert found.departed == ["a", "b"]
    np.testing.assert_array_less(0.5 * sigma_px, place_sigma(found))
    np.testing.assert_array_less(place_sigma(found), 1.1 * sigma_px)
    again = calibrate_sensors(stars_of("b", SENT), found.cameras, told, sigma_px)
    assert again.departed == []


def test_a_principal_point_that_is_known_stays_and_has_no_error():
    told = with_uncertain_principal_points(cameras("a"), 0.0)
    found = calibrate_sensors(stars_of("a", TRUE), told, told, 0.0)
    assert found.departed == ["a"]
    assert array(found.cameras, "cx_px")[0] == SENT.cx_px
    assert place_sigma(found)[0] < 0.01


def test_few_stars_give_no_row_and_an_unchanged_camera():
    told = cameras("a", "b")
    found = calibrate_sensors(stars_of("a", TRUE, n_frames=2), told, told)
    assert found.calibrations.num_rows == 0
    assert found.cameras.equals(told)


OTHER = SENT._replace(fx_px=3720.0, fy_px=3720.0)
TRUE_OTHER = OTHER._replace(fx_px=3740.0, fy_px=3740.0, k1=0.05)


def in_periods(*optics):
    """Return STARS of sensor a and its CAMERAS, for periods of (sent, true) optics: 40 s each."""
    stars, sent = [], []
    for k, (given, true) in enumerate(optics):
        rows = stars_of("a", true, seed=k, used=given)
        columns = {name: rows[name] for name in STARS.names}
        later = {
            "time": array(rows, "time") + 40 * k * 10**9,
            "frame_number": array(rows, "frame_number") + 40 * k,
        }
        stars.append(table(STARS, columns | later))
        row = rows_of(cameras_of({"a": given}))[0] | {"time": 40 * k * 10**9}
        sent.append(pa.Table.from_pylist([row], schema=CAMERAS))
    return concat(STARS, stars), concat(CAMERAS, sent)


def test_each_calibration_is_fitted_to_the_stars_of_its_frames():
    stars, sent = in_periods((SENT, TRUE), (OTHER, TRUE_OTHER))
    found = calibrate_sensors(stars, sent, sent)
    assert found.departed == ["a"]
    off = array(found.cameras, "fx_px") - [TRUE.fx_px, TRUE_OTHER.fx_px]
    assert np.all(np.abs(off) < 4 * np.sqrt(array(found.cameras, "cov_fxfx")))
    np.testing.assert_allclose(array(found.cameras, "k1"), [TRUE.k1, TRUE_OTHER.k1], atol=0.02)


def test_the_row_of_a_sensor_is_of_the_calibration_with_most_stars():
    stars, sent = in_periods((SENT, TRUE), (OTHER, TRUE_OTHER), (SENT, TRUE))
    found = calibrate_sensors(stars, sent, sent)
    assert found.calibrations.num_rows == 1
    assert array(found.calibrations, "fx_px")[0] == pytest.approx(TRUE.fx_px, abs=1.0)
    # It holds again after the other one: both of its periods are fitted together.
    fx_px = array(found.cameras, "fx_px")
    assert fx_px[0] == fx_px[2] != fx_px[1]
    frames = array(stars, "frame_number")
    of_it = np.count_nonzero((frames < 40) | (frames >= 80))
    assert array(found.calibrations, "n_stars")[0] == of_it


def test_only_the_calibration_that_differs_gets_new_optics():
    stars, sent = in_periods((SENT, TRUE), (OTHER, OTHER))
    found = calibrate_sensors(stars, sent, sent)
    assert found.departed == ["a"]
    assert found.cameras.slice(1).equals(sent.slice(1))
    assert array(found.cameras, "fx_px")[0] == pytest.approx(TRUE.fx_px, abs=1.0)


def test_a_star_that_is_predicted_beyond_the_fold_of_the_distortion_takes_no_part():
    # Folds at 673 px from the middle, before the corners; there x - dx has no direction.
    lens = Camera(1024, 1024, 900.0, 900.0, 511.5, 511.5, k1=-0.265)
    stars = stars_of("a", lens, used=lens)
    at_fold = array(stars, "x_px").copy()
    at_fold[7], dx = 1020.0, array(stars, "dx_px").copy()
    y, dy = array(stars, "y_px").copy(), array(stars, "dy_px").copy()
    y[7], dx[7], dy[7] = 951.5, -0.5, -0.5
    columns = {name: stars[name] for name in STARS.names}
    changed = table(STARS, columns | {"x_px": at_fold, "y_px": y, "dx_px": dx, "dy_px": dy})
    told = cameras_of({"a": lens})
    found = calibrate_sensors(changed, told, told)
    assert found.departed == []
    assert array(found.calibrations, "n_stars").tolist() == [stars.num_rows - 1]
    assert array(found.calibrations, "k1")[0] == pytest.approx(lens.k1, abs=0.02)
