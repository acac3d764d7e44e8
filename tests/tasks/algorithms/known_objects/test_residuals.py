"""Residuals along and across the track of a predicted object."""

import numpy as np
import pytest

from epipole.tasks.algorithms.known_objects.residuals import track_residuals

LIGHT_KM_S = 299792.458


def seen(state, sensor_km, moved_km):
    """The direction to an object that is not where its state says, when its light left."""
    from scipy.optimize import brentq

    r, v = state[:3] + moved_km, state[3:]
    delay = brentq(lambda t: np.linalg.norm(r - t * v - sensor_km) - LIGHT_KM_S * t, 0, 1)
    u = (r - delay * v - sensor_km) / np.linalg.norm(r - delay * v - sensor_km)
    return np.array([[np.arctan2(u[1], u[0]), np.arcsin(u[2])]])


@pytest.mark.parametrize("seed", range(5))
def test_a_displaced_object_is_off_by_its_displacement(seed):
    rng = np.random.default_rng(seed)
    sensor, still = rng.normal(0, 7000, 3), np.zeros(3)
    state = np.concatenate([sensor + rng.normal(0, 1000, 3), rng.normal(0, 5, 3)])
    line = state[:3] - sensor
    line /= np.linalg.norm(line)
    along = state[3:] - state[3:] @ line * line
    along /= np.linalg.norm(along)
    for moved, wanted in ((along, (1, 0)), (np.cross(along, line), (0, 1)), (line, (0, 0))):
        direction = seen(state, sensor, moved)
        found = track_residuals(direction, sensor[None], still[None], state[None])[0]
        assert found == pytest.approx(wanted, abs=5e-3)


def test_the_track_is_that_which_the_moving_sensor_sees():
    state, sensor = np.array([0.0, 0, 1000, 1, 0, 0]), np.zeros((1, 3))
    moving = np.array([[1.0, -1.0, 0]])  # the object seems to move along y
    direction = seen(state, sensor[0], np.array([0, 2.0, 0]))
    found = track_residuals(direction, sensor, moving, state[None])[0]
    assert found == pytest.approx([2.0, 0.0], abs=1e-2)
