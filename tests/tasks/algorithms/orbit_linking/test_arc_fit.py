"""Arc fit: motion as SciPy has it, exact orbits from exact tracklets, honest chi-squares."""

import numpy as np
import pytest
from scenes.orbit_tracklets import low_orbit, moved, orbit_tracklets

from epipole.tasks.algorithms.orbit_linking.arc_fit import advance, fit_arc, fit_work

FIVE_METRES = 5e-3  # of the fixed steps, in half an hour: the model lacks more


def fitted(scene, rows, off=0.0):
    """Return log evidence, chi-square, and the error of the orbit at the first row's epoch."""
    t = scene.tracklets.time_s[rows]
    state = scene.state[rows[0]] + off * np.array([1, 1, 1, 1e-3, 1e-3, 1e-3])
    evidence, chi2 = fit_arc(scene.tracklets, rows, t[0], state, fit_work())
    return evidence, chi2, state - scene.state[rows[0]]


@pytest.mark.parametrize("dt_s", [37.0, 600.0, 1800.0])
def test_motion_is_that_of_scipy(dt_s):
    state = low_orbit(np.random.default_rng(3), 0.01)
    y = np.concatenate([state, np.eye(6).ravel()])
    advance(y, dt_s, np.empty((5, 42)))
    np.testing.assert_allclose(y[:3], moved(state, [dt_s])[0, :3], atol=FIVE_METRES)
    advance(y, -dt_s, np.empty((5, 42)))
    np.testing.assert_allclose(y[:3], state[:3], atol=FIVE_METRES)


def test_the_transition_matrix_is_the_derivative_of_the_motion():
    state, dt_s = low_orbit(np.random.default_rng(4)), 500.0
    y = np.concatenate([state, np.eye(6).ravel()])
    advance(y, dt_s, np.empty((5, 42)))
    for axis, step in enumerate([1.0] * 3 + [1e-3] * 3):
        shifted = state + step * (np.arange(6) == axis)
        slope = (moved(shifted, [dt_s]) - moved(state, [dt_s]))[0] / step
        # Without the oblateness: a thousandth, and the curvature over the step.
        np.testing.assert_allclose(
            y[6:].reshape(6, 6)[:, axis], slope, atol=6e-3 * abs(slope).max()
        )


@pytest.mark.parametrize(("per_object", "error_km"), [(2, 0.1), (5, 0.03)])
def test_exact_tracklets_give_the_exact_orbit(per_object, error_km):
    # The model lacks what the object's fall changes within the light time: 0.01 arcsec/s.
    scene = orbit_tracklets(
        1, 20, per_object, 200.0, direction_arcsec=0.2, rate_arcsec_s=0.02, noisy=False
    )
    for number in range(20):
        rows = np.flatnonzero(scene.object == number)
        _, chi2, error = fitted(scene, rows, off=2.0)
        assert chi2 < 0.5
        assert np.linalg.norm(error[:3]) < error_km


def test_chi_square_has_the_degrees_of_freedom_of_the_attributables():
    scene = orbit_tracklets(2, 150, 4, 150.0)
    chi2 = [fitted(scene, np.flatnonzero(scene.object == k), off=1.0)[1] for k in range(150)]
    # 16 numbers, 6 unknowns; 1-sigma of the mean 0.37.
    assert abs(np.mean(chi2) - 10.0) < 1.2
    assert np.mean(np.array(chi2) < 23.2) > 0.95  # 99 %


def test_tracklets_of_two_objects_fit_no_orbit():
    scene = orbit_tracklets(5, 2, 3, 100.0)
    rows = np.arange(6)
    evidence, chi2, _ = fitted(scene, rows)
    assert not chi2 < 1e3
    assert not evidence > 0
