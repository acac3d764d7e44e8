"""Orbit determination: exact without errors, honest with them, and what an arc does not fit."""

import numpy as np
import pytest
from scenes.night_orbits import AROUND, GEO, LOW, trial
from scipy.special import chdtrc

from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.algorithms.orbits import orbit_determination as determination
from epipole.tasks.algorithms.orbits.orbit_determination import (
    AreaPrior,
    determine_orbit,
    log_evidence,
    neglected,
    part_of,
)
from epipole.tasks.algorithms.orbits.orbital_elements import elements_of
from epipole.tasks.algorithms.orbits.trajectories import propagate_unknowns

METRE, MM_S = 1e-3, 1e-6
FIXED = AreaPrior(np.zeros(2), np.zeros(2))
SUNLIT = AreaPrior(np.array([0.03, 0.0]), np.array([0.02, 0.0]))
AIR = AreaPrior(np.array([0.0, 0.03]), np.array([0.0, 0.06]))
REVOLUTIONS = np.concatenate([c + np.linspace(-60, 60, 7) for c in (-21_000, -9_000, 200, 16_000)])


def seeing(directions, u):
    """Return the directions with other unit vectors."""
    u = u / np.linalg.norm(u, axis=1, keepdims=True)
    return directions._replace(u=u, basis=tangent_basis(u))


def fit(directions, truth, areas, seed=0, km=3.0):
    off = np.random.default_rng(seed).normal(size=6) * km * np.repeat([1.0, 1e-2], 3)
    return determine_orbit(directions, truth[:6] + off, 0.0, 0.0, areas, AROUND)


@pytest.mark.parametrize(("truth", "areas"), [(GEO, SUNLIT), (LOW, FIXED)])
def test_without_errors_the_orbit_is_the_truth(truth, areas):
    orbit = fit(trial(1, truth, noise=1e-3, bias=0.0, place_km=0.0), truth, areas)
    assert np.linalg.norm(orbit.unknowns[:3] - truth[:3]) < 10 * METRE
    assert np.linalg.norm(orbit.unknowns[3:6] - truth[3:6]) < 100 * MM_S
    assert orbit.used.all()


@pytest.mark.parametrize(
    ("truth", "areas", "times_s", "n"),
    [
        (LOW, FIXED, np.linspace(-60.0, 60.0, 25), 150),
        (GEO, SUNLIT, np.linspace(-2700.0, 2700.0, 19), 150),
        (LOW + 0.02 * np.eye(8)[7], AIR, REVOLUTIONS, 60),
    ],
    ids=["two minutes of a low orbit", "90 minutes of a geostationary one", "revolutions in air"],
)
@pytest.mark.long
def test_errors_over_many_trials_are_as_stated(truth, areas, times_s, n):
    square, chi2, dof, improbable = [], 0.0, 0, 0
    for seed in range(n):
        directions = trial(seed, truth, times_s=times_s)
        orbit = fit(directions, truth, areas, seed)
        off = orbit.unknowns - truth
        square.append(off[:6] @ np.linalg.solve(orbit.cov[:6, :6], off[:6]))
        chi2, dof = chi2 + orbit.chi2, dof + 2 * int(orbit.used.sum()) - 6
        improbable += chdtrc(2 * len(directions.time_s) - 6, orbit.chi2) < 1e-3
    # The mean of n chi-squares of 6 degrees over 6 has a sigma of sqrt(1 / 3 n): 0.05 of 150.
    assert abs(np.mean(square) / 6 - 1) < 3.5 * np.sqrt(1 / (3 * n))
    assert abs(chi2 / dof - 1) < 0.03
    assert improbable <= 2


def test_a_night_of_few_passages_converges_from_a_state_of_minutes():
    directions = trial(5, LOW, times_s=REVOLUTIONS)
    near = trial(5, LOW, times_s=REVOLUTIONS[14:21])
    orbit = determine_orbit(near, LOW[:6], 0.0, 0.0, FIXED, AROUND)
    whole = determine_orbit(directions, orbit.unknowns[:6], 0.0, 0.0, FIXED, AROUND)
    assert np.isfinite(whole.chi2)
    # Hours of arc instead of minutes: what is predicted for six hours later is far better known.
    sigma_km = []
    for each in (orbit, whole):
        _, transition = propagate_unknowns(each.unknowns, 0.0, 21_600.0, AROUND)
        cov = transition @ each.cov @ transition.T
        sigma_km.append(np.sqrt(np.trace(cov[:3, :3])))
    assert sigma_km[1] < sigma_km[0] / 20


def test_an_initial_state_at_rest_is_valid():
    directions = trial(1, LOW, times_s=np.linspace(-20.0, 20.0, 21))
    at_rest = np.append(LOW[:3], np.zeros(3))
    orbit = determine_orbit(directions, at_rest, 0.0, 0.0, FIXED, AROUND)
    off = orbit.unknowns[:6] - LOW[:6]
    assert off @ np.linalg.solve(orbit.cov[:6, :6], off) < 22.5  # 1 in 1,000 is above


PASSAGES = np.concatenate([c + np.linspace(-15.0, 15.0, 40) for c in (-75.0, 75.0)])


@pytest.mark.parametrize("seed", range(6))
def test_two_passages_before_one_sensor_converge_though_their_distance_is_hardly_seen(seed):
    directions = trial(seed, LOW, n_sensors=1, times_s=PASSAGES, noise=10.0, bias=0.0)
    orbit = fit(directions, LOW, FIXED, seed)
    off = orbit.unknowns[:6] - LOW[:6]
    assert off @ np.linalg.solve(orbit.cov[:6, :6], off) < 22.5  # 1 in 1,000 is above


FEW = np.concatenate([c + np.linspace(-8.0, 8.0, 8) for c in (-22.0, 22.0)])


@pytest.mark.parametrize("seed", range(10))
def test_two_tracklets_far_from_an_initial_state_between_them_converge(seed):
    # Without a fit that begins with all of them, four of these ten fail.
    times_s = np.concatenate([c + np.linspace(-8.0, 8.0, 49) for c in (-1000.0, 1000.0)])
    of_both = trial(seed, LOW, n_sensors=2, times_s=times_s, noise=12.0)
    directions = part_of(of_both, (of_both.sensor == 0) == (of_both.time_s < 0.0))
    orbit = fit(directions, LOW, FIXED, seed, km=0.5)
    off = orbit.unknowns[:6] - LOW[:6]
    assert off @ np.linalg.solve(orbit.cov[:6, :6], off) < 22.5  # 1 in 1,000 is above


def few(seed):
    """Return the orbit of two short passages before one sensor, and how far it is off."""
    directions = trial(seed, LOW, n_sensors=1, times_s=FEW, noise=30.0, bias=0.0)
    orbit = fit(directions, LOW, FIXED, seed)
    off = orbit.unknowns[:6] - LOW[:6]
    return elements_of(orbit.unknowns[:6]), off @ np.linalg.solve(orbit.cov[:6, :6], off)


def test_an_orbit_that_the_directions_leave_open_is_closed(monkeypatch):
    elements, square = zip(*map(few, range(20)), strict=True)
    assert (np.array(elements)[:, 0] > 0.0).all()
    assert (np.array(elements)[:, 1] < 1.0).all()
    assert np.mean(square) < 6 * 1.3
    assert max(square) < 30.0
    monkeypatch.setattr(determination, "VELOCITY_SIGMA", 1e6)
    without = np.array([few(seed)[0] for seed in range(20)])
    assert (~(without[:, 1] < 1.0)).sum() > 5


def test_the_derivatives_of_the_prior_are_right():
    state, size = LOW[:6] * [1.0, 1.1, 0.9, 1.2, 0.8, 1.0], np.array([0.1] * 3 + [1e-4] * 3)
    _, slopes = determination.velocity_prior(state)
    for k, h in enumerate(np.diag(size)):
        after, before = (determination.velocity_prior(state + sign * h)[0] for sign in (1, -1))
        np.testing.assert_allclose(slopes[:, k], (after - before) / (2 * size[k]), rtol=1e-6)


def test_the_derivatives_are_those_of_the_residuals():
    directions, epoch_s = trial(3, LOW, times_s=np.linspace(-90.0, 90.0, 5), noise=600.0), 0.0
    shared, areas = np.zeros((3, 6)), AIR
    used = np.ones(len(directions.u), bool)

    def at(step):
        unknowns = LOW + step
        given = epoch_s, directions, used, areas, AROUND
        return determination._at(unknowns, shared, *given)

    middle = at(np.zeros(8))
    size = np.array([0.1] * 3 + [1e-4] * 3)
    for k, h in enumerate(np.diag(np.append(size, [0.0, 0.0]))[:6]):
        # Half of the slope of chi-square is the right side of the equations, with the other sign.
        slope = (at(h).of_directions.sum() - at(-h).of_directions.sum()) / (2 * size[k])
        assert -2 * middle.sums.of_orbit[k] == pytest.approx(slope, rel=1e-4, abs=1e-6 / size[k])


def test_directions_of_something_else_are_left_out():
    directions = trial(7, GEO)
    u = directions.u.copy()
    u[[4, 40]] += 1e-3 * directions.basis[[4, 40], 0]
    orbit = fit(seeing(directions, u), GEO, SUNLIT)
    assert np.flatnonzero(~orbit.used).tolist() == [4, 40]
    off = orbit.unknowns[:6] - GEO[:6]
    assert off @ np.linalg.solve(orbit.cov[:6, :6], off) < 22.5  # 1 in 1,000 is above


def test_directions_of_two_objects_do_not_fit_one_orbit():
    directions = trial(8, GEO)
    other = GEO + 40.0 * np.eye(8)[2]
    u = np.where((directions.sensor == 0)[:, None], trial(8, other, toward=GEO).u, directions.u)
    orbit = fit(seeing(directions, u), GEO, SUNLIT)
    assert orbit.used.all()
    assert chdtrc(2 * len(u) - 6, orbit.chi2) < 1e-6


def test_drag_is_fitted_where_the_arc_shows_it():
    for area, shown in ((0.0, False), (0.05, True)):
        truth = LOW + area * np.eye(8)[7]
        directions = trial(9, truth, times_s=REVOLUTIONS)
        still, slowed = (fit(directions, truth, areas) for areas in (FIXED, AIR))
        gain = log_evidence(slowed, AIR) - log_evidence(still, FIXED)
        assert (gain > 0) == shown
    assert abs(slowed.unknowns[7] - 0.05) < 3 * np.sqrt(slowed.cov[7, 7])
    assert np.sqrt(slowed.cov[7, 7]) < 0.01


def test_a_fit_that_fails_is_nan():
    directions = trial(10, GEO)
    few = type(directions)(*(a[:3] for a in directions[:-1]), directions.prior)
    for orbit in (
        determine_orbit(few, GEO[:6], 0.0, 0.0, SUNLIT, AROUND),
        determine_orbit(directions, -GEO[:6], 0.0, 0.0, SUNLIT, AROUND),
    ):
        assert np.isnan(orbit.unknowns).all()
        assert np.isnan(orbit.chi2)
        assert not orbit.used.any()


def test_the_order_of_sensors_changes_nothing():
    directions = trial(11, GEO)
    turned = directions._replace(
        sensor=2 - directions.sensor, prior=np.ascontiguousarray(directions.prior[::-1])
    )
    one, other = (fit(each, GEO, SUNLIT) for each in (directions, turned))
    np.testing.assert_allclose(one.unknowns, other.unknowns, rtol=1e-9)


def test_what_the_forces_neglect_grows_with_the_arc():
    # The measured moves of fits by the field of degrees 3 to 6, at 450 to 1300 km [m].
    low = np.array([7200.0, 0.0, 0.0])
    for minutes, metres in ((10, 0.95), (45, 5.0), (90, 12.0), (180, 32.0)):
        sigma = np.sqrt(np.diag(neglected(low, 60.0 * minutes)))
        assert 2.0 < sigma[0] / METRE / metres < 5.0
    assert neglected(np.array([42_164.0, 0.0, 0.0]), 86_400.0)[0, 0] < (5 * METRE) ** 2
