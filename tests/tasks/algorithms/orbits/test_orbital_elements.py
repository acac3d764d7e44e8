"""Orbital elements: against the simulator's, with errors over many trials; and longitudes."""

import numpy as np
import pytest
from scenes.night_orbits import AROUND, GEO, LOW
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from epipole.tasks.algorithms.orbits.orbital_elements import (
    GEOSTATIONARY_KM,
    element_errors,
    elements_of,
    geostationary,
)
from epipole.tasks.algorithms.simulation.paths import state_at

COV = np.diag([0.3, 0.3, 0.3, 3e-4, 3e-4, 3e-4]) ** 2
ELEMENTS = [
    [7000.0, 0.001, 1.7, 0.3, 5.1, 2.2],
    [26500.0, 0.72, 1.1, 4.0, 4.7, 0.4],
    [42164.0, 0.0003, 0.002, 2.5, 1.0, 6.1],
]


@pytest.mark.parametrize("elements", ELEMENTS)
def test_elements_are_those_that_made_the_state(elements):
    state = np.concatenate(state_at(np.array(elements), np.array(0.0)))
    np.testing.assert_allclose(elements_of(state), elements, rtol=1e-8)


def test_a_hyperbola_has_a_negative_axis_and_a_mean_anomaly_that_grows_with_time():
    state = np.array([7000.0, 0, 0, 1.0, 12.0, 0.0])
    a, e = elements_of(state)[:2]
    assert a < 0 < e - 1
    later = state + 1.0 * np.array([*state[3:], -398600.4418 / 7000.0**2, 0, 0])
    growth = elements_of(later)[5] - elements_of(state)[5]
    assert growth == pytest.approx(np.sqrt(398600.4418 / -(a**3)), rel=1e-3)


def test_the_mean_anomaly_of_a_hyperbola_counts_from_its_perigee_on_both_sides():
    # A perigee at 7,000 km with 12 km/s: e is 1.53, and the path is symmetric about it.
    at_perigee = np.array([7000.0, 0, 0, 0, 12.0, 0])
    t_s = np.array([-3600.0, -600.0, 0.0, 600.0, 3600.0, 90_000.0])
    path = solve_ivp(
        lambda _, y: [*y[3:], *(-398600.4418 * y[:3] / np.linalg.norm(y[:3]) ** 3)],
        (0.0, t_s[-1]), at_perigee, t_eval=t_s[2:], rtol=1e-11, atol=1e-9,
    ).y.T  # fmt: skip
    mirrored = path[[2, 1]] * [1, -1, 1, -1, 1, 1]
    elements = elements_of(np.concatenate([mirrored, path]))
    rate = np.sqrt(398600.4418 / -(elements[:, 0] ** 3))
    np.testing.assert_allclose(elements[:, 5], rate * t_s, rtol=1e-6, atol=1e-9)


def test_errors_of_elements_are_those_of_many_states():
    state = np.concatenate(state_at(np.array([26500.0, 0.3, 1.1, 4.0, 4.7, 0.4]), np.array(0.0)))
    cov = COV * 1e-2
    rng = np.random.default_rng(1)
    scattered = elements_of(rng.multivariate_normal(state, cov, size=4000))
    np.testing.assert_allclose(
        element_errors(state[None], cov[None])[0], scattered.std(axis=0), rtol=0.05
    )


def cov_of(cov):
    out = np.zeros((8, 8))
    out[:6, :6] = cov
    return out


def fixed_on_the_earth(longitude, offset_km=0.0):
    """Return the state at noon of a circular orbit in the equator, at a longitude [rad]."""
    angle, r_km = AROUND.era_rad + longitude, GEOSTATIONARY_KM + 0.52 + offset_km
    speed = np.sqrt(398600.4418 / r_km * (1 + 1.5 * 1.08262668e-3 * (6378.137 / r_km) ** 2))
    turn = Rotation.from_euler("z", angle)
    return np.array([*turn.apply([r_km, 0, 0]), *turn.apply([0, speed, 0]), 0.0, 0.0])


def test_a_geostationary_object_has_a_longitude_and_drifts_as_its_axis_says():
    found = geostationary(fixed_on_the_earth(1.2), cov_of(COV), 0.0, AROUND)
    assert found.longitude_rad == pytest.approx(1.2, abs=1e-9)
    assert found.sigma_longitude_rad == pytest.approx(0.3 / 42164.7, rel=1e-3)
    # The Moon moves it by some thousandths of a degree.
    assert abs(np.degrees(found.drift_rad_s) * 86400) < 0.02
    lower = geostationary(fixed_on_the_earth(1.2, -10.0), cov_of(COV), 0.0, AROUND)
    change = np.degrees(lower.drift_rad_s - found.drift_rad_s) * 86400
    # Textbook: 0.0128 degrees a day for a kilometre, eastward when lower.
    assert change == pytest.approx(0.128, rel=0.02)


def test_the_error_of_the_drift_is_that_of_many_orbits():
    state, cov = fixed_on_the_earth(-2.0), cov_of(COV)
    rng = np.random.default_rng(2)
    found = geostationary(state, cov, 0.0, AROUND)
    drifts = [
        geostationary(rng.multivariate_normal(state, cov), cov, 0.0, AROUND).drift_rad_s
        for _ in range(400)
    ]
    # A scatter of 400 has an error of 3.5 %.
    assert np.std(drifts) == pytest.approx(found.sigma_drift_rad_s, rel=0.12)


def test_an_object_that_moves_west_drifts_by_two_turns_a_day():
    state = fixed_on_the_earth(1.2)
    state[3:6] *= -1
    found = geostationary(state, cov_of(COV), 0.0, AROUND)
    per_sidereal_day = np.degrees(found.drift_rad_s) * 86164.1
    assert per_sidereal_day == pytest.approx(-720.0, abs=0.1)


def test_the_drift_of_a_vague_orbit_counts_whole_turns():
    # At apogee, with a revolution in 0.53 days: the object gains 0.89 turns in a day.
    state = fixed_on_the_earth(1.2)
    state[3:6] *= 0.69
    wide = cov_of(np.diag([100.0, 100, 100, 1, 1, 1]) ** 2)
    found = geostationary(state, wide, 0.0, AROUND)
    a_km = elements_of(state[:6])[0]
    turns = 86164.1 / (2 * np.pi * np.sqrt(a_km**3 / 398600.4418)) - 1
    assert turns > 0.8
    assert np.degrees(found.drift_rad_s) * 86164.1 / 360 == pytest.approx(turns, abs=0.1)


def test_other_orbits_have_no_longitude():
    assert geostationary(LOW, cov_of(COV), 0.0, AROUND) is None
    assert geostationary(GEO * [1, 1, 1, 1.2, 1.2, 1.2, 1, 1], cov_of(COV), 0.0, AROUND) is None
    assert geostationary(fixed_on_the_earth(0.0, 300.0), cov_of(COV), 0.0, AROUND) is None
