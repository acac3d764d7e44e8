"""Pair search: Lagrange's coefficients as SciPy has the motion, and true pairs found."""

import numpy as np
import pytest
from scenes.orbit_tracklets import GM, low_orbit, orbit_tracklets
from scipy.integrate import solve_ivp

from epipole.tasks.algorithms.orbit_linking.pair_search import (
    join_pair,
    lagrange,
    packed_tracklets,
    search,
)


def found(scene, known=None, gap_s=1e3):
    n = len(scene.object)
    known = np.full(n, -1) if known is None else known
    pairs, states = np.empty((50 * n, 2), np.int64), np.empty((50 * n, 6))
    seen = scene.tracklets
    count = search(seen, packed_tracklets(seen), known, gap_s, 0, n, pairs, states, np.empty(6),
                   np.empty((8, 3)))  # fmt: skip
    return pairs[:count], states[:count]


@pytest.mark.parametrize("eccentricity", [0.0, 0.1])
@pytest.mark.parametrize("dt_s", [1.0, 400.0, 1500.0])
def test_lagrange_coefficients_are_those_of_two_bodies(eccentricity, dt_s):
    state = low_orbit(np.random.default_rng(1), eccentricity)
    motion = solve_ivp(
        lambda _, y: np.concatenate([y[3:], -GM * y[:3] / np.linalg.norm(y[:3]) ** 3]), (0, dt_s),
        state, "DOP853", rtol=1e-12, atol=1e-10,
    )  # fmt: skip
    f, g, gdot = lagrange(state[:3], state[3:], dt_s)
    end = motion.y[:, -1]
    np.testing.assert_allclose(f * state[:3] + g * state[3:], end[:3], atol=1e-4)
    fdot = (f * gdot - 1) / g
    np.testing.assert_allclose(fdot * state[:3] + gdot * state[3:], end[3:], atol=1e-6)


@pytest.mark.parametrize("gap_s", [1.0, 60.0, 600.0])
def test_true_pairs_are_found_with_their_orbit(gap_s):
    scene = orbit_tracklets(4, 100, 2, gap_s, direction_arcsec=1.0, rate_arcsec_s=0.2)
    state, work, near = np.empty(6), np.empty((8, 3)), 0
    for number in range(100):
        i, j = np.flatnonzero(scene.object == number)
        first_km = np.linalg.norm(scene.tracklets.r_km[i])
        if join_pair(scene.tracklets, i, j, first_km, state, work) < 30.0:
            near += np.linalg.norm(state[:3] - scene.state[i, :3]) < 20.0
    assert near >= 95


def test_few_others_are_found():
    scene = orbit_tracklets(5, 150, 2, 60.0)
    pairs, _ = found(scene)
    true = scene.object[pairs[:, 0]] == scene.object[pairs[:, 1]]
    assert true.sum() >= 0.97 * 150
    assert (~true).sum() <= 0.01 * (300 * 299 / 2)


def test_known_pairs_and_tracklets_of_one_sensor_at_a_time_are_no_pairs():
    scene = orbit_tracklets(6, 1, 3, 1.0)
    assert len(found(scene)[0]) == 3
    assert len(found(scene, np.zeros(3, np.int64))[0]) == 0
    one = scene._replace(tracklets=scene.tracklets._replace(sensor=np.zeros(3, np.int64)))
    assert len(found(one)[0]) == 0


def test_a_gap_that_is_longer_is_not_searched():
    scene = orbit_tracklets(7, 20, 2, 100.0)
    seen = scene.tracklets
    pairs, _ = found(scene, gap_s=30.0)
    assert len(pairs)
    assert (seen.time_s[pairs[:, 1]] - seen.time_s[pairs[:, 0]]).max() <= 30.0
