"""Orbit fit: against SciPy's integrator, and honest over many trials with shared errors."""

import numpy as np
import pytest
from scenes.arcs import GEO, trial
from scipy.integrate import solve_ivp

from epipole.tasks.algorithms.orbits.orbit_fit import Arcs, fit_orbits, propagate

METRE, MM_S = 1e-3, 1e-6
LOW = np.array([5000.0, 4000.0, 3000.0, -4.5, 5.2, 1.1])


def gravity(_, y):
    """Two bodies and J2, written out axis by axis as in the textbooks."""
    mu, j2, radius = 398600.4418, 1.08262668e-3, 6378.137
    x, y_, z = y[:3]
    r = np.linalg.norm(y[:3])
    k = 1.5 * j2 * (radius / r) ** 2
    s = 5 * (z / r) ** 2
    pull = -mu / r**3
    return [*y[3:], pull * x * (1 - k * (s - 1)), pull * y_ * (1 - k * (s - 1)),
            pull * z * (1 - k * (s - 3))]  # fmt: skip


@pytest.mark.parametrize("state", [GEO, LOW])
@pytest.mark.parametrize("dt_s", [-300.0, 47.3, 600.0])
def test_propagation_agrees_with_scipy(state, dt_s):
    reference = solve_ivp(gravity, (0, dt_s), state, method="DOP853", rtol=1e-12, atol=1e-9)
    off = propagate(state, dt_s) - reference.y[:, -1]
    assert np.linalg.norm(off[:3]) < METRE
    assert np.linalg.norm(off[3:]) < MM_S


def start(rng):
    return (GEO + rng.normal(size=6) * np.array([20, 20, 20, 0.2, 0.2, 0.2]))[None]


def test_without_errors_the_fit_is_the_truth():
    arcs = trial(1, noise=1e-3, bias=1e-3, place_km=1e-6)
    state, _, chi2, _ = fit_orbits(arcs, start(np.random.default_rng(0)))
    assert np.linalg.norm(state[0, :3] - GEO[:3]) < METRE
    assert np.linalg.norm(state[0, 3:] - GEO[3:]) < 10 * MM_S
    assert np.isfinite(chi2[0])


@pytest.mark.long
def test_errors_over_many_trials_are_as_claimed_though_biases_are_shared():
    n, square, total, dof = 300, 0.0, 0.0, 0
    for seed in range(n):
        arcs = trial(seed)
        state, cov, chi2, _ = fit_orbits(arcs, start(np.random.default_rng(seed)))
        off = state[0] - GEO
        square += off @ np.linalg.solve(cov[0], off)
        total, dof = total + chi2[0], dof + 2 * len(arcs.time_s) - 6
    # Mean of 300 chi-squares of 6 degrees over 6: 1 with a sigma of 0.033.
    assert abs(square / n / 6 - 1) < 0.1
    assert abs(total / dof - 1) < 0.03


def test_a_shared_error_does_not_average_out():
    few, many = (
        fit_orbits(trial(2, times=np.linspace(-30, 30, n)), GEO[None])[1][0] for n in (5, 500)
    )
    ratio = np.sqrt(np.trace(many[:3, :3]) / np.trace(few[:3, :3]))
    assert 0.3 < ratio < 0.9  # without it: 0.1


def test_arcs_are_fitted_separately_and_bad_ones_are_nan():
    one = trial(3)
    n = len(one.time_s)
    both = Arcs(np.array([0, n, n + 2]), *(np.concatenate([a, a[:2]]) for a in one[1:]))
    state, cov, chi2, _ = fit_orbits(both, np.array([GEO, GEO]))
    np.testing.assert_allclose(state[0], fit_orbits(one, GEO[None])[0][0])
    assert np.isnan(state[1]).all()
    assert np.isnan(cov[1]).all()
    assert np.isnan(chi2[1])
    behind = fit_orbits(one, -GEO[None])
    assert np.isnan(behind[0]).all()


def test_no_arc_gives_no_state():
    empty = Arcs(np.array([0]), *(a[:0] for a in trial(4, times=np.zeros(1))[1:]))
    state, cov, chi2, _ = fit_orbits(empty, np.zeros((0, 6)))
    assert state.shape == (0, 6)
    assert cov.shape == (0, 6, 6)
    assert chi2.shape == (0,)
