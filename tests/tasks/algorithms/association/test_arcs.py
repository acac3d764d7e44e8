"""Arcs: several instants of one object are one orbit; chance agreement is not counted twice."""

import numpy as np
import pytest
from scenes.tracklet_scenes import GEO, V_GEO, Scene, judge, solve
from scipy.stats import multivariate_normal

from epipole.tasks.algorithms.association.arcs import _circular_odds, factor
from epipole.tasks.algorithms.constants import GM_KM3_S2
from epipole.tasks.algorithms.orbit_linking.population import SHARE, SIGMA
from epipole.tasks.algorithms.orbits.orbit_fit import propagate


def falling(scene, k, start, v):
    """Add object k to all sensors, on its orbit."""
    x = np.array([propagate(np.concatenate([start, v]), t)[:3] for t in scene.times])
    for s in range(len(scene.r)):
        scene.add(s, k, (x - scene.r[s]) / np.linalg.norm(x - scene.r[s], axis=1)[:, None])
    return scene


def test_the_factored_solution_and_determinant_are_those_of_linalg():
    rng = np.random.default_rng(1)
    A = rng.normal(size=(6, 8))
    N, b = A @ A.T, rng.normal(size=6)
    x = b.copy()
    log_det = factor(N.copy(), x)
    np.testing.assert_allclose(x, np.linalg.solve(N, b), rtol=1e-9)
    assert log_det == pytest.approx(np.linalg.slogdet(N)[1], abs=1e-9)
    assert np.isnan(factor(-N, b.copy()))


def test_chance_pairs_among_a_thousand_lone_tracklets_are_no_objects():
    # Of three hundred in each of three sensors, dozens of pairs meet at all instants.
    for seed in range(3):
        scene = Scene(40 + seed, 3).strays(300)
        assert (solve(scene.samples()).group >= 0).sum() <= 2


def test_two_sensors_find_objects_among_a_hundred_lone_tracklets_over_ten_minutes():
    times = np.linspace(0.0, 540.0, 10)
    right = found = true = 0
    for seed in range(3):
        scene = Scene(60 + seed, 2, times=times)
        for k in range(10):
            rng = np.random.default_rng([seed, k])
            start = GEO + rng.normal(size=3) * 100.0
            falling(scene, k, start, V_GEO + rng.normal(size=3) * 0.02)
        scene.strays(100)
        precision, recall = judge(scene, groups := solve(scene.samples()))
        n = 2 * len(groups.score)
        right, found, true = right + precision * n, found + n, true + recall * 10
    assert right == found
    assert true >= 28


def test_hyperbolic_orbits_are_no_objects():
    speed = 2.0 * np.linalg.norm(V_GEO)  # 1.4 times the escape velocity
    scene = falling(Scene(80, 4), 0, GEO, speed * GEO / np.linalg.norm(GEO))
    assert (solve(scene.samples()).group == -1).all()
    scene = falling(Scene(80, 4), 0, GEO, V_GEO)
    assert (solve(scene.samples()).group == 0).all()


def test_a_low_orbit_is_found_over_its_curve():
    state = np.array([7100.0, 0.0, 0.0, 0.0, 5.3, 5.3])
    scene = Scene(90, 3, times=np.linspace(0.0, 60.0, 6))
    for s in range(3):
        angle = scene.times * 7.5 / 7000.0 + 0.06 * (s - 1)
        place = np.stack([np.cos(angle), np.sin(angle), np.zeros(6)], axis=1)
        scene.r[s] = (6700.0 + 40.0 * s) * place
    scene = falling(scene, 0, state[:3], state[3:])
    samples = scene.samples()
    look = samples.u[:3]
    turned = np.stack([np.roll(look, 1, axis=2), np.roll(look, 2, axis=2), look], axis=2)
    groups = solve(samples._replace(R_sensor_from_icrs=turned))
    assert (groups.group == 0).all()


@pytest.mark.parametrize("pieces", [2, 3])
def test_a_broken_track_is_no_more_evidence_than_a_whole_one(pieces):
    times = np.linspace(0.0, 25.0, 6)
    scene = falling(Scene(70, 2, times=times), 0, GEO, V_GEO)
    whole = solve(scene.samples(), min_log_odds=-3.0)
    piece = np.arange(6) * pieces // 6
    u = scene.u.pop()
    scene.sensor.pop(), scene.who.pop(), scene.seen.pop()
    for k in range(pieces):
        scene.u.append(u)
        scene.sensor.append(1)
        scene.who.append(0)
        scene.seen.append(piece == k)
    broken = solve(scene.samples(), min_log_odds=-3.0)
    assert (whole.group == 0).all()
    assert (broken.group == 0).all()
    assert broken.score[0] == pytest.approx(whole.score[0], abs=1.0)


def circular_odds(state, covariance):
    factored = np.linalg.cholesky(np.linalg.inv(covariance))
    return _circular_odds(np.array(state), factored)


LOW = np.array([5200.0, 4100.0, 2700.0])
SPEED = np.sqrt(GM_KM3_S2 / np.linalg.norm(LOW))
UP = LOW / np.linalg.norm(LOW)
ALONG = np.cross(UP, [0.0, 0.6, 0.8]) / np.linalg.norm(np.cross(UP, [0.0, 0.6, 0.8]))


@pytest.mark.parametrize("seed", range(4))
def test_the_odds_of_a_circular_orbit_are_those_of_two_normal_distributions(seed):
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(6, 6)) * np.repeat([2.0, 0.5], 3)[:, None]
    covariance = half @ half.T * rng.choice([0.01, 0.1])
    velocity = SPEED * ALONG + rng.normal(size=3) * 0.5
    level = velocity - UP * (UP @ velocity)
    axes = np.stack([UP, level / np.linalg.norm(level)])
    of_axes = axes @ covariance[3:, 3:] @ axes.T
    found = [UP @ velocity, np.linalg.norm(level) - SPEED]
    nearly, any_ = (
        multivariate_normal(cov=of_axes + np.eye(2) * (sigma * SPEED) ** 2).pdf(found)
        for sigma in SIGMA
    )
    odds = circular_odds([*LOW, *velocity], covariance)
    assert odds == pytest.approx(np.log(SHARE[0] * nearly / any_ + SHARE[1]), abs=1e-9)


def test_a_circular_orbit_is_likelier_an_eccentric_one_less_likely_and_an_unknown_one_neither():
    precise, wide = np.diag([1e-2] * 3 + [1e-6] * 3), np.diag([1e4] * 3 + [1e4] * 3)
    circular, eccentric = ([*LOW, *(speed * SPEED * ALONG)] for speed in (1.0, 1.2))
    assert circular_odds(circular, precise) > 5.0
    assert circular_odds(eccentric, precise) == pytest.approx(np.log(SHARE[1]), abs=1e-3)
    assert circular_odds(eccentric, wide) == pytest.approx(0.0, abs=1e-2)
