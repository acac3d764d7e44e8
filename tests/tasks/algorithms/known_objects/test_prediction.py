"""Predictions: the places of SGP4, and what errors of elements do to them."""

import numpy as np
import pytest
from scenes.satellites import ISS
from scenes.walker import NIGHT_NS, satellites

from epipole.tasks.algorithms.known_objects.prediction import (
    ERROR_COMPONENTS,
    HIGH_ORBIT,
    LOW_ORBIT,
    Screen,
    along_up_across,
    is_deep_space,
    predict,
    satellites_of,
    sensitivities,
    sigmas,
    track_residuals,
    two_body,
)
from epipole.tasks.algorithms.simulation.element_sets import propagate

HOURS_NS = (np.arange(0.0, 24.0, 3.7) * 3600e9).astype(np.int64)


@pytest.fixture(scope="module")
def elements():
    return np.array([each.elements for each in satellites(40, np.random.default_rng(1))])


def test_places_are_those_of_the_simulator_which_goes_by_the_equinox(elements):
    states = predict(satellites_of(elements), NIGHT_NS + HOURS_NS)
    r_km, failures = propagate(elements, NIGHT_NS + HOURS_NS)
    assert not failures
    assert np.abs(states[:, :, :3] - r_km).max() < 3e-4


def test_velocities_are_the_derivatives_of_the_places(elements):
    made = satellites_of(elements)
    half_ns = 250_000_000
    step = predict(made, NIGHT_NS + HOURS_NS + half_ns) - predict(
        made, NIGHT_NS + HOURS_NS - half_ns
    )
    states = predict(made, NIGHT_NS + HOURS_NS)
    assert np.abs(step[:, :, :3] / 0.5 - states[:, :, 3:]).max() < 2e-3  # SGP4's own neglect


def test_a_satellite_that_has_come_down_has_no_place():
    down = list(ISS.elements)
    down[1] = 0.5  # drag
    states = predict(
        satellites_of(np.array([down, ISS.elements])), np.array([ISS.epoch_ns + 10**16])
    )
    assert np.isnan(states[0]).all()
    assert np.isfinite(states[1]).all()


def test_nothing_is_predicted_of_nothing():
    assert predict([], np.array([NIGHT_NS])).shape == (0, 1, 6)
    assert predict(satellites_of(np.array([ISS.elements])), np.zeros(0, np.int64)).shape == (
        1,
        0,
        6,
    )
    assert satellites_of(np.empty((0, 10))) == []


def test_errors_of_elements_move_a_satellite_as_their_names_say(elements):
    times = NIGHT_NS + (np.arange(0, 86400, 300) * 10**9)
    for satellite in satellites_of(elements[:8]):
        states = predict([satellite], times)[0]
        axes = np.array([along_up_across(state) for state in states])
        H = axes @ sensitivities(satellite, times, len(times) // 2)
        sizes = {name: np.abs(H[:, :, k]).max(axis=0) for k, name in enumerate(ERROR_COMPONENTS)}
        assert sizes["along"] == pytest.approx([1.0, 0.0, 0.0], abs=0.05)
        assert sizes["radial"] == pytest.approx([2.0, 1.0, 0.0], abs=0.1)
        assert sizes["across"][2] == pytest.approx(1.0, abs=0.05)
        # Half a day from the middle, and none in it but for the radius that belongs to it.
        assert sizes["drift"] == pytest.approx([0.5, 0.0, 0.0], abs=0.12)
        assert np.abs(H[len(times) // 2, :, -1]).max() < 0.12


def test_errors_grow_with_age_and_drag_makes_them_grow_faster():
    (station,) = satellites_of(np.array([ISS.elements]))
    calm = list(ISS.elements)
    calm[1] = 0.0
    (steady,) = satellites_of(np.array([calm]))
    ages = (0.0, 3.0, 10.0, 30.0)
    along = np.array([[sigmas(s, t, LOW_ORBIT)[0] for t in ages] for s in (station, steady)])
    assert along[1] == pytest.approx(np.hypot(LOW_ORBIT.along_km, np.array(ages)))
    assert (along[0, 1:] > 1.5 * along[1, 1:]).all()
    assert (np.diff(along, axis=1) > 0).all()
    assert sigmas(station, -3.0, LOW_ORBIT)[0] == pytest.approx(along[0, 1])


def test_a_geostationary_orbit_is_deep_space(elements):
    made = satellites_of(elements)
    is_high = elements[:, 8] < 0.01
    assert [is_deep_space(s) for s in made] == is_high.tolist()
    assert sigmas(made[int(np.argmax(is_high))], 0.0, HIGH_ORBIT)[0] == HIGH_ORBIT.along_km


LIGHT_KM_S = 299792.458


def seen(state, sensor_km, moved_km):
    """The direction to an object that is not where its state says, when its light left."""
    from scipy.optimize import brentq

    r, v = state[:3] + moved_km, state[3:]
    delay = brentq(lambda t: np.linalg.norm(r - t * v - sensor_km) - LIGHT_KM_S * t, 0, 1)
    u = (r - delay * v - sensor_km) / np.linalg.norm(r - delay * v - sensor_km)
    return np.array([[np.arctan2(u[1], u[0]), np.arcsin(u[2])]])


@pytest.mark.parametrize("seed", range(5))
def test_a_displaced_object_is_off_by_its_displacement(seed):
    rng = np.random.default_rng(seed)
    sensor, still = rng.normal(0, 7000, 3), np.zeros(3)
    state = np.concatenate([sensor + rng.normal(0, 1000, 3), rng.normal(0, 5, 3)])
    line = state[:3] - sensor
    line /= np.linalg.norm(line)
    along = state[3:] - state[3:] @ line * line
    along /= np.linalg.norm(along)
    for moved, wanted in ((along, (1, 0)), (np.cross(along, line), (0, 1)), (line, (0, 0))):
        direction = seen(state, sensor, moved)
        found = track_residuals(direction, sensor[None], still[None], state[None])[0]
        assert found == pytest.approx(wanted, abs=5e-3)


def test_the_track_is_that_which_the_moving_sensor_sees():
    state, sensor = np.array([0.0, 0, 1000, 1, 0, 0]), np.zeros((1, 3))
    moving = np.array([[1.0, -1.0, 0]])  # the object seems to move along y
    direction = seen(state, sensor[0], np.array([0, 2.0, 0]))
    found = track_residuals(direction, sensor, moving, state[None])[0]
    assert found == pytest.approx([2.0, 0.0], abs=1e-2)


def test_all_within_reach_are_found_at_any_time():
    rng = np.random.default_rng(2)
    made = satellites_of(np.array([each.elements for each in satellites(800, rng)]))
    screen = Screen(made)
    passed = 0
    for _ in range(60):
        time_ns = NIGHT_NS + int(rng.uniform(0, 86400e9))
        places = predict(made, np.array([time_ns]))[:, 0, :3]
        there = places[rng.integers(len(places))] + rng.normal(0, 60, 3)
        reach = rng.uniform(50, 300, len(made))
        found = screen.near(there, time_ns, reach)
        within = np.flatnonzero(np.linalg.norm(places - there, axis=1) < reach)
        assert set(within) <= set(found.tolist())
        passed += len(found) - len(within)
    assert passed < 60 * 8  # of 800 each


def test_two_bodies_return_after_a_period():
    state = np.array([[7000.0, 0, 0, 0, 7.8, 1.0], [26000.0, 0, 0, 1.0, 4.5, 0.3]])
    speed2 = np.sum(state[:, 3:] ** 2, axis=1)
    a = 1 / (2 / np.linalg.norm(state[:, :3], axis=1) - speed2 / 398600.4418)
    for row, period in zip(state, 2 * np.pi * np.sqrt(a**3 / 398600.4418), strict=True):
        again = two_body(row[None], float(period))[0]
        assert np.linalg.norm(again - row[:3]) < 1e-3


def test_a_catalogue_without_satellites_has_none_near():
    assert len(Screen([]).near(np.array([7000.0, 0, 0]), NIGHT_NS, np.zeros(0))) == 0
