"""Platforms: sensors that have the states of one satellite are found, others are not."""

import numpy as np
import pytest
from scenes.night_orbits import LOW, positions

from epipole.tasks.algorithms.orbits.platforms import platform_sizes, views_from_one_position

TURN_S = np.arange(0.0, 20.0)
BEHIND_KM = 30.0  # a neighbour of the same plane


def rows(paths, starts_s, error_km=0.0, seed=0):
    """Return times, sensors and positions: sensor k is on `paths[k]` for 20 s from its start on."""
    rng = np.random.default_rng(seed)
    time_s = np.concatenate([start + TURN_S for start in starts_s])
    sensor = np.repeat(np.arange(len(paths)), len(TURN_S))
    r_km = np.concatenate([positions(p, s + TURN_S) for p, s in zip(paths, starts_s, strict=True)])
    r_km = r_km + rng.normal(size=r_km.shape) * error_km
    order = np.argsort(time_s, kind="stable")
    return time_s[order], sensor[order], r_km[order]


def behind(km):
    """Return the orbit of a satellite on the same path, this far behind."""
    speed = np.linalg.norm(LOW[3:6])
    later = LOW.copy()
    later[:3] -= LOW[3:6] * km / speed
    return later


OTHER = np.concatenate([-LOW[:3], LOW[3:]])


SIGMA_KM = 0.1


def sizes(time_s, sensor, r_km):
    """Return the sizes for sensors that all have the same sigma."""
    return platform_sizes(time_s, sensor, r_km, np.full(int(sensor.max(initial=-1)) + 1, SIGMA_KM))


@pytest.mark.parametrize(
    ("starts_s", "noise_km"),
    [((0, 0, 0, 0), 0.015), ((0, 0, 0, 0), 0.0), ((0, 40, 80, 20), 0.0), ((0, 400, 800, -500), 0)],
)
def test_sensors_with_the_same_states_are_found_whenever_they_see(starts_s, noise_km):
    for seed in range(4):
        given = rows([LOW, LOW, LOW, OTHER], starts_s, noise_km, seed)
        np.testing.assert_array_equal(sizes(*given), [3, 3, 3, 1])


@pytest.mark.parametrize("starts_s", [(0, 0), (0, 40), (0, 400)])
def test_sensors_of_one_satellite_whose_errors_differ_are_alone(starts_s):
    n, together = 60, 0
    for seed in range(n):
        time_s, sensor, r_km = rows([LOW, LOW], starts_s)
        error_km = np.random.default_rng(seed).normal(size=(2, 3)) * SIGMA_KM
        together += sizes(time_s, sensor, r_km + error_km[sensor])[0] > 1
    assert together < 8  # 2 on average


def test_a_neighbour_in_the_same_plane_is_another_satellite():
    given = rows([LOW, behind(BEHIND_KM)], (0, 100))
    np.testing.assert_array_equal(sizes(*given), [1, 1])


def test_positions_that_are_an_hour_apart_are_not_compared():
    np.testing.assert_array_equal(sizes(*rows([LOW, LOW], (0, 3600))), [1, 1])


def test_single_positions_one_sensor_and_none():
    time_s, sensor, r_km = rows([LOW, LOW], (0, 40))
    one_each = [0, len(TURN_S)]
    np.testing.assert_array_equal(sizes(time_s[one_each], sensor[one_each], r_km[one_each]), [1, 1])
    first = np.flatnonzero((sensor == 0) | (time_s == 40.0))
    np.testing.assert_array_equal(sizes(time_s[first], sensor[first], r_km[first]), [2, 2])
    at_once = np.zeros(2), np.array([0, 1]), r_km[:2]
    np.testing.assert_array_equal(sizes(*at_once), [1, 1])
    np.testing.assert_array_equal(sizes(*rows([LOW], (0,))), [1])
    assert sizes(np.zeros(0), np.zeros(0, np.int64), np.zeros((0, 3))).shape == (0,)


def test_views_from_one_position_are_counted_in_their_group_alone():
    at, other = np.array([7000.0, 0.0, 0.0]), np.array([0.0, 7000.0, 0.0])
    r_km = np.array([at, other, at + 0.01, at, other, at + 1.0])
    count = views_from_one_position(np.array([0, 3, 6]), r_km, np.full(6, SIGMA_KM))
    np.testing.assert_array_equal(count, [2, 1, 2, 1, 1, 1])
    assert not len(views_from_one_position(np.zeros(1, int), np.zeros((0, 3)), np.zeros(0)))
