"""Arc fit: exact orbits from exact tracklets, honest chi-squares."""

import numpy as np
import pytest
from scenes.orbit_tracklets import orbit_tracklets

from epipole.tasks.algorithms.orbit_linking.arc_fit import fit_arc, fit_work


def fitted(scene, rows, off=0.0):
    """Return log evidence, chi-square, and the error of the orbit at the first row's epoch."""
    t = scene.tracklets.time_s[rows]
    state = scene.state[rows[0]] + off * np.array([1, 1, 1, 1e-3, 1e-3, 1e-3])
    evidence, chi2 = fit_arc(scene.tracklets, rows, t[0], state, fit_work())
    return evidence, chi2, state - scene.state[rows[0]]


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
