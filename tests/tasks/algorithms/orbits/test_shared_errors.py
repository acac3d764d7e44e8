"""Shared errors: stated ones stay as they are, larger ones are found by all objects together."""

import numpy as np
from scenes.arcs import GEO, trial

from epipole.tasks.algorithms.orbits import shared_errors
from epipole.tasks.algorithms.orbits.orbit_fit import Arcs, fit_orbits, prior_information
from epipole.tasks.algorithms.orbits.shared_errors import no_equations, scale_shared_errors

PLACE_KM = 0.02
N_SENSORS = 5
N_OBJECTS = 8


def objects(seed, worse=1.0):
    """Arcs of several objects with the same sensors, and the objects' true states."""
    rng = np.random.default_rng(1000 + seed)
    truth = GEO + np.hstack([rng.normal(size=(N_OBJECTS, 3)) * 600, np.zeros((N_OBJECTS, 3))])
    times = np.arange(-143.0, 144.0, 26.0)
    arcs = [
        trial(seed, n_sensors=N_SENSORS, times=times, noise=1.5, bias=0.0, place_km=PLACE_KM,
              truth=state, number=k, worse=worse)
        for k, state in enumerate(truth)
    ]  # fmt: skip
    n = len(arcs[0].time_s)
    columns = (np.concatenate(column) for column in zip(*(a[1:] for a in arcs), strict=True))
    return Arcs(n * np.arange(N_OBJECTS + 1), *columns), truth


def factors(arcs, fitted):
    prior = prior_information(arcs, slice(None), arcs.sensor, N_SENSORS)
    free = np.tile([False, True], (N_SENSORS, 1))
    return scale_shared_errors(fitted.equations, prior, free)


def squares(fitted, truth):
    off = fitted.state - truth
    return np.einsum("ni,nij,nj->n", off, np.linalg.inv(fitted.cov), off) / 6


def trials(worse):
    """The factors, and the squares of the states' errors as stated and with the factors."""
    found, stated, scaled = [], [], []
    for seed in range(20):
        arcs, truth = objects(seed, worse)
        fitted = fit_orbits(arcs, truth)
        factor = factors(arcs, fitted)
        wider = arcs._replace(sigma_km=arcs.sigma_km * np.sqrt(factor[arcs.sensor, 1]))
        found.append(factor)
        stated.append(squares(fitted, truth))
        scaled.append(squares(fit_orbits(wider, truth), truth))
    return np.array(found), np.array(stated), np.array(scaled)


def test_errors_as_stated_stay_as_stated():
    factor, stated, scaled = trials(1.0)
    np.testing.assert_array_equal(factor[:, :, 0], 1.0)  # directions share nothing here
    assert factor.mean() < 1.1
    assert abs(stated.mean() - 1) < 0.2  # three sigma of 20 scenes
    assert abs(scaled.mean() - 1) < 0.2


def test_a_worse_ephemeris_widens_the_covariances_of_all_states_and_no_other_sensor():
    factor, stated, scaled = trials(15.0)
    assert np.median(factor[:, 0, 1]) > 15.0
    assert np.median(factor[:, 1:, 1]) < 1.2
    assert stated.mean() > 2.0
    assert abs(scaled.mean() - 1) < 0.35


def test_sensors_without_lines_of_sight_keep_their_factors():
    prior = np.tile(np.diag([1e12] * 3 + [2500.0] * 3), (2, 1, 1))
    nothing = [(np.arange(2), no_equations(2))]
    factor = scale_shared_errors(nothing, prior, np.ones((2, 2), bool))
    np.testing.assert_allclose(factor, 1.0)


def test_sensors_scaled_in_groups_get_about_the_factors_of_all_together(monkeypatch):
    arcs, truth = objects(3, worse=15.0)
    fitted = fit_orbits(arcs, truth)
    together = factors(arcs, fitted)
    monkeypatch.setattr(shared_errors, "MAX_TOGETHER", 2)
    apart = factors(arcs, fitted)
    assert together[0, 1] > 15.0
    np.testing.assert_allclose(apart, together, rtol=0.3)
