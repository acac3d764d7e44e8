"""Agreement: a sensor at fault is found; a sound sensor and a blind sensor are not."""

import numpy as np
import pytest
from scenes.tracklet_scenes import GEO, Scene, solve

from epipole.tasks.algorithms.sensor_faults.agreement import agreement


def turned(scene, sensor, angle_rad):
    """Return the scene with all directions of one sensor rotated a little."""
    axis = np.cross(GEO, [0.0, 0.0, 1.0])
    axis /= np.linalg.norm(axis)
    for i, s in enumerate(scene.sensor):
        if s == sensor:
            u = scene.u[i] + np.cross(axis, scene.u[i]) * angle_rad
            scene.u[i] = u / np.linalg.norm(u, axis=1, keepdims=True)
    return scene


@pytest.mark.parametrize("wrong", [0, 3])
def test_a_sensor_whose_attitude_is_wrong_is_found(wrong):
    scene = turned(Scene(1, 4).objects(8, spread_km=100.0).strays(1), wrong, np.radians(0.1))
    samples = scene.samples()
    assert agreement(samples, solve(samples)).disagreeing().tolist() == [wrong]


def test_sound_sensors_are_left_alone():
    samples = Scene(2, 4).objects(8, spread_km=100.0).strays(10).samples()
    found = agreement(samples, solve(samples))
    assert found.disagreeing().tolist() == []
    assert (found.joined >= 0.9 * found.looked).all()


def test_a_sensor_without_detections_is_not_at_fault():
    scene = Scene(3, 4).objects(8, spread_km=100.0, seen_by=[0, 1, 2])
    samples = scene.samples()
    found = agreement(samples, solve(samples))
    assert found.looked[3] >= 5
    assert found.joined[3] == 0
    assert found.disagreeing().tolist() == []


def test_without_groups_no_sensor_is_judged():
    samples = Scene(4, 3).strays(3).samples()
    found = agreement(samples, solve(samples))
    assert found.disagreeing().tolist() == []
