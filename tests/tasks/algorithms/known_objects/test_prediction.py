"""Predictions: the places of SGP4, and what errors of elements do to them."""

import numpy as np
import pytest
from scenes.satellites import ISS
from scenes.walker import NIGHT_NS, satellites

from epipole.tasks.algorithms.known_objects.prediction import (
    HIGH_ORBIT,
    LOW_ORBIT,
    SENSITIVE_TO,
    along_up_across,
    is_deep_space,
    predict,
    satellites_of,
    sensitivities,
    sigmas,
)
from epipole.tasks.algorithms.simulation.element_sets.propagation import propagate

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
        sizes = {name: np.abs(H[:, :, k]).max(axis=0) for k, name in enumerate(SENSITIVE_TO)}
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
