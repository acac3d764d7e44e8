"""Biases of sensors: honest over many nights, and the same however the orbits are shared out."""

import numpy as np
import pytest
from scenes.night_orbits import AROUND, GEO, LOW, trial

from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.orbits import sensor_biases
from epipole.tasks.algorithms.orbits.orbit_determination import AreaPrior, determine_orbit
from epipole.tasks.algorithms.orbits.sensor_biases import (
    added,
    sensor_equations,
    solve_biases,
)

FIXED = AreaPrior(np.zeros(2), np.zeros(2))
SUNLIT = AreaPrior(np.array([0.03, 0.0]), np.array([0.02, 0.0]))
BIAS, PLACE_KM, N = 20.0, 0.2, 3  # large beside the noise, so that some of them are seen
PRIOR = np.tile(np.repeat([BIAS * ARCSEC, PLACE_KM], 3), (N, 1))


def night(seed, objects=4):
    """The equations of some orbits, and the true errors of their sensors (3, 6)."""
    rng = np.random.default_rng(1000 + seed)
    truth = rng.normal(size=(N, 6)) * PRIOR
    orbits = []
    for k in range(objects):
        unknowns, areas = ((GEO, SUNLIT), (LOW, FIXED))[k % 2]
        seen = trial(
            100 * seed + k, unknowns, bias=BIAS, place_km=PLACE_KM,
            times_s=np.linspace(-60.0, 60.0, 15), shared=(truth[:, :3], truth[:, 3:]),
        )  # fmt: skip
        orbit = determine_orbit(seen, unknowns[:6] + 0.1, 0.0, 0.0, areas, AROUND)
        assert np.isfinite(orbit.chi2)
        orbits.append((np.arange(N), orbit.equations))
    return orbits, truth


@pytest.mark.parametrize("n", [8, pytest.param(100, marks=pytest.mark.long)])
def test_errors_over_their_covariance_are_standard_normal(n):
    square, seen = [], []
    for seed in range(n):
        orbits, truth = night(seed)
        bias, cov = solve_biases(sensor_equations(orbits, N), PRIOR)
        off = bias - truth
        square.append(np.einsum("si,sij,sj->s", off, np.linalg.inv(cov), off))
        seen.append(np.sqrt(np.diagonal(cov, axis1=1, axis2=2)) / PRIOR)
    # Chi-squares of 6 degrees; those of one night are not independent of each other.
    assert abs(np.mean(square) / 6 - 1) < 3.5 * np.sqrt(1 / (3 * n))
    assert np.max(square) < 27.9  # 1 in 10,000 is above
    # The directions tell something: no sigma is above the stated one, many are far below.
    assert np.max(seen) < 1 + 1e-9
    assert np.median(seen) < 0.9


def test_one_object_gives_the_errors_of_its_fit():
    seen = trial(3, LOW, times_s=np.linspace(-60.0, 60.0, 15), bias=BIAS, place_km=PLACE_KM)
    orbit = determine_orbit(seen, LOW[:6] + 0.1, 0.0, 0.0, FIXED, AROUND)
    bias, _ = solve_biases(sensor_equations([(np.arange(N), orbit.equations)], N), PRIOR)
    np.testing.assert_allclose(bias / PRIOR, orbit.shared / PRIOR, atol=1e-3)


def test_the_order_and_the_shares_of_orbits_change_nothing():
    orbits, _ = night(1)
    whole = solve_biases(sensor_equations(orbits, N), PRIOR)
    parts = [(np.arange(N), sensor_equations([each], N)) for each in reversed(orbits)]
    for one, other in zip(whole, solve_biases(added(parts, N), PRIOR), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-12)


def test_a_sensor_without_observations_keeps_what_is_stated(monkeypatch):
    orbits, _ = night(2, objects=1)
    prior = np.concatenate([PRIOR, PRIOR[:1]])
    bias, cov = solve_biases(sensor_equations(orbits, N + 1), prior)
    np.testing.assert_array_equal(bias[N], 0.0)
    np.testing.assert_allclose(cov[N], np.diag(PRIOR[0] ** 2))
    monkeypatch.setattr(sensor_biases, "MAX_TOGETHER", 2)
    bias, _ = solve_biases(sensor_equations(orbits, N + 1), prior)
    assert np.isnan(bias[:N]).all()
    assert np.isfinite(bias[N]).all()


@pytest.mark.parametrize("n", [0, 2])
def test_without_orbits_nothing_is_found(n):
    bias, cov = solve_biases(added([], n), np.ones((n, 6)))
    assert bias.shape == (n, 6)
    np.testing.assert_array_equal(cov, np.tile(np.eye(6), (n, 1, 1)))
