"""Calibrate sensors: optics that differ are found, others are unchanged."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from epipole.schemas.bridge import array, concat, table
from epipole.schemas.tables import STARS
from epipole.schemas.work_tables import CAMERAS
from epipole.tasks.algorithms.geometry.camera import Camera, inside, project
from epipole.tasks.calibrate.calibrate_sensors import calibrate_sensors

SENT = Camera(1024, 1024, 3660.0, 3660.0, 511.5, 511.5)
TRUE = SENT._replace(fx_px=3671.0, fy_px=3671.0, k1=-0.08)


def stars_of(sensor_id, camera, seed=0, n_frames=40):
    """Return STARS of a sensor, identified with the camera SENT and attitudes with small errors."""
    rng = np.random.default_rng(seed)
    parts = []
    for k in range(n_frames):
        v = np.column_stack([rng.uniform(-0.15, 0.15, (25, 2)), np.ones(25)])
        x, y = project(camera, v)
        seen = inside(camera, x, y)
        x, y = (c[seen] + rng.normal(0, 0.15, seen.sum()) for c in (x, y))
        px, py = project(SENT, Rotation.from_rotvec(rng.normal(0, 3e-4, 3)).apply(v[seen]))
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
    values = SENT._replace(**changes)._asdict()
    n = len(sensor_ids)
    return table(
        CAMERAS,
        {"sensor_id": list(sensor_ids), "time": [0] * n} | {k: [v] * n for k, v in values.items()},
    )


def test_only_a_sensor_whose_optics_differ_gets_new_ones():
    stars = concat(STARS, [stars_of("a", TRUE), stars_of("b", SENT)])
    found = calibrate_sensors(stars, cameras("a", "b"))
    assert found.departed == ["a"]
    assert found.calibrations["sensor_id"].to_pylist() == ["a", "b"]
    fx = array(found.cameras, "fx_px")
    assert fx[0] == pytest.approx(TRUE.fx_px, abs=1.0)
    assert fx[1] == SENT.fx_px
    off = array(found.calibrations, "fx_px") - [TRUE.fx_px, SENT.fx_px]
    assert np.all(np.abs(off) < 4 * array(found.calibrations, "sigma_fx_px"))


def test_few_stars_give_no_row_and_an_unchanged_camera():
    found = calibrate_sensors(stars_of("a", TRUE, n_frames=2), cameras("a", "b"))
    assert found.calibrations.num_rows == 0
    assert found.cameras.equals(cameras("a", "b"))


def test_a_sensor_with_two_calibrations_is_unchanged():
    both = concat(CAMERAS, [cameras("a"), cameras("a", fx_px=3700.0)])
    found = calibrate_sensors(stars_of("a", TRUE), both)
    assert found.calibrations.num_rows == 0
    assert found.cameras.equals(both)
