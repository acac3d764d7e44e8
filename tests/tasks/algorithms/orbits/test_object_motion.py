"""Velocities from positions at neighbouring epochs."""

import numpy as np

from epipole.tasks.algorithms.orbits.object_motion import velocities


def test_straight_motion_gives_its_velocity_whatever_is_missing():
    t = np.arange(100.0)
    v = np.array([1.0, -2.0, 3.0])
    x = np.array([4e4, 0.0, 0.0]) + t[:, None] * v
    x[::7] = np.nan
    got = velocities(np.array([0, 100]), t, x, 5.0)
    np.testing.assert_allclose(got, np.tile(v, (100, 1)), atol=1e-9)


def test_objects_do_not_mix_and_a_single_position_has_velocity_zero():
    t = np.array([0.0, 1.0, 0.0])
    x = np.array([[0.0, 0, 0], [1.0, 0, 0], [9.0, 9, 9]])
    got = velocities(np.array([0, 2, 3]), t, x, 5.0)
    np.testing.assert_allclose(got, [[1, 0, 0], [1, 0, 0], [0, 0, 0]])


def test_nothing_in_gives_nothing_out():
    assert velocities(np.array([0]), np.zeros(0), np.zeros((0, 3)), 5.0).shape == (0, 3)
