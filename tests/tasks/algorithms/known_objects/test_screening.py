"""Screening: no satellite within reach is lost, and few others pass."""

import numpy as np
from scenes.walker import NIGHT_NS, satellites

from epipole.tasks.algorithms.known_objects.prediction import predict, satellites_of
from epipole.tasks.algorithms.known_objects.screening import Screen, two_body


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
