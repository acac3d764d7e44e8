"""Gravity as the gradient of its potential, and motion under it as SciPy has it."""

import numpy as np
import pytest
from scenes.orbit_tracklets import low_orbit, moved

from epipole.tasks.algorithms.earth_gravity import advance, gravity, propagate_states

STEP_S = 60.0
FIVE_METRES = 5e-3  # of the fixed steps, in half an hour: the model lacks more


def test_gravity_is_the_gradient_of_the_potential():
    def potential(r):
        radius = np.linalg.norm(r)
        legendre = (3 * (r[2] / radius) ** 2 - 1) / 2
        return 398600.4418 / radius * (1 - 1.08262668e-3 * (6378.137 / radius) ** 2 * legendre)

    r, h = np.array([4000.0, -3000.0, 5000.0]), 0.1
    steps = h * np.eye(3)
    gradient = [(potential(r + d) - potential(r - d)) / (2 * h) for d in steps]
    np.testing.assert_allclose(gravity(r), gradient, rtol=1e-7)


@pytest.mark.parametrize("dt_s", [37.0, 600.0, 1800.0])
def test_motion_is_that_of_scipy(dt_s):
    state = low_orbit(np.random.default_rng(3), 0.01)
    y = np.concatenate([state, np.eye(6).ravel()])
    advance(y, dt_s, STEP_S, np.empty((5, 42)))
    np.testing.assert_allclose(y[:3], moved(state, [dt_s])[0, :3], atol=FIVE_METRES)
    alone = state.copy()
    advance(alone, dt_s, STEP_S, np.empty((5, 42)))
    np.testing.assert_array_equal(alone, y[:6])
    steps = int(np.ceil(dt_s / STEP_S))
    r, v = propagate_states(state[None, :3], state[None, 3:], np.array([dt_s]), steps)
    np.testing.assert_allclose(np.hstack([r, v])[0], alone, rtol=1e-11)
    advance(y, -dt_s, STEP_S, np.empty((5, 42)))
    np.testing.assert_allclose(y[:3], state[:3], atol=FIVE_METRES)


def test_the_transition_matrix_is_the_derivative_of_the_motion():
    state, dt_s = low_orbit(np.random.default_rng(4)), 500.0
    y = np.concatenate([state, np.eye(6).ravel()])
    advance(y, dt_s, STEP_S, np.empty((5, 42)))
    for axis, step in enumerate([1.0] * 3 + [1e-3] * 3):
        shifted = state + step * (np.arange(6) == axis)
        slope = (moved(shifted, [dt_s]) - moved(state, [dt_s]))[0] / step
        # Without the oblateness: a thousandth, and the curvature over the step.
        np.testing.assert_allclose(
            y[6:].reshape(6, 6)[:, axis], slope, atol=6e-3 * abs(slope).max()
        )
