"""Velocities from positions at neighbouring epochs, and the motion that fits neglect."""

import numpy as np
import pytest

from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.covariances import centroid_covariance
from epipole.tasks.algorithms.orbits.object_motion import (
    ObjectRegistry,
    neglected_motion,
    velocities,
)
from epipole.tasks.algorithms.orbits.orbit_fit import trajectory
from epipole.tasks.algorithms.tracking.local_motion import directions_at

METRE_S = 1e-3
LOW = np.array([7000.0, 0.0, 0.0, 0.0, 5.3, 5.3])
GEO = np.array([12000.0, 40400.0, 0.0, -2.95, 0.88, 0.0])
CROSSING = np.array([7300.0, -200.0, 300.0, 0.5, -6.0, 4.2])  # passes the low one at 470 km


def test_falling_motion_gives_its_velocity_whatever_is_missing():
    t = np.arange(100.0)
    states, _ = trajectory(LOW, t)
    x = states[:, :3].copy()
    x[::7] = np.nan
    got, spread_s = velocities(np.array([0, 100]), t, x, 5.0)
    # At the ends the window is on one side, and gravity bends the path there by 20 m/s.
    np.testing.assert_allclose(got, states[:, 3:], atol=METRE_S)
    np.testing.assert_allclose(spread_s[20:80], np.sqrt(10.0), atol=0.5)  # of -5 to 5 s


def test_positions_weigh_by_their_errors():
    rng, t = np.random.default_rng(1), np.arange(100.0)
    states, _ = trajectory(LOW, t)
    sigma_km = np.where(t < 50.0, 0.01, 100.0)
    x = states[:, :3] + sigma_km[:, None] * rng.normal(size=(100, 3))
    got, spread_s = velocities(np.array([0, 100]), t, x, 30.0, sigma_km)
    off = np.abs(got - states[:, 3:]).max(axis=1)
    assert off[:60].max() < 0.01
    assert np.abs(velocities(np.array([0, 100]), t, x, 30.0)[0] - got)[40:60].max() > 0.5
    assert spread_s[70] < 10.0 < spread_s[85]
    alike, _ = velocities(np.array([0, 100]), t, x, 30.0, np.full(100, 7.0))
    np.testing.assert_array_equal(alike, velocities(np.array([0, 100]), t, x, 30.0)[0])


def test_objects_do_not_mix_and_a_single_position_has_velocity_zero():
    t = np.array([0.0, 1.0, 0.0])
    x = np.array([[1.0, 0, 0], [2.0, 0, 0], [9.0, 9, 9]])
    got, spread_s = velocities(np.array([0, 2, 3]), t, x, 5.0)
    np.testing.assert_allclose(got, [[1, 0, 0], [1, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(spread_s, [0.5, 0.5, 0.0])


def test_a_single_poor_position_after_many_good_ones_has_no_velocity():
    """The sums over its window are differences of sums over all positions: they are rounding."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        t = np.append(np.arange(1200.0) + rng.uniform(0, 0.1, 1200), 1300.0 + rng.uniform())
        x = trajectory(LOW, t)[0][:, :3]
        sigma_km = np.append(np.full(1200, 0.1), 50.0)
        got, spread_s = velocities(np.array([0, 1201]), t, x, 30.0, sigma_km)
        assert spread_s[-1] == 0.0
        assert not got[-1].any()


def test_nothing_in_gives_nothing_out():
    got, spread_s = velocities(np.array([0]), np.zeros(0), np.zeros((0, 3)), 5.0)
    assert got.shape == (0, 3)
    assert spread_s.shape == (0,)


@pytest.mark.parametrize(
    ("target", "noise_arcsec", "at"),
    [(GEO, 4.0, 0.0), (GEO, 4.0, -8.0), (CROSSING, 10.0, 0.0), (CROSSING, 10.0, 1.3)],
)
def test_a_corrected_direction_is_the_true_one(target, noise_arcsec, at):
    t = np.arange(-6.0, 6.1, 1.0)
    sensor, seen = trajectory(LOW, t)[0], trajectory(target, t)[0]
    u = seen[:, :3] - sensor[:, :3]
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    noise = centroid_covariance(u, np.full(len(u), noise_arcsec * ARCSEC))
    fit = directions_at(
        np.zeros(1, int), np.full(1, len(t)), np.array([at]), 0.01, t, u, noise, 0 * noise, 6.0
    )
    here, there = trajectory(LOW, np.array([at]))[0], trajectory(target, np.array([at]))[0]
    true = there[:, :3] - here[:, :3]
    true /= np.linalg.norm(true)
    off = neglected_motion(there, here, fit.moments)
    left = np.linalg.norm(fit.u - off - true)
    missed = np.linalg.norm(fit.u - true)
    assert missed > 0.2 * ARCSEC  # what is neglected
    assert left < 0.02 * missed
    assert missed < 4 * np.sqrt(fit.unmodelled[0])


def test_nothing_is_neglected_at_the_instant_itself():
    off = neglected_motion(GEO[None], LOW[None], np.zeros((1, 3)))
    np.testing.assert_array_equal(off, np.zeros((1, 3)))


def name(registry, *groups):
    return registry.name_groups([np.array(g) for g in groups])


def test_a_number_holds_while_one_tracklet_continues():
    registry = ObjectRegistry()
    assert name(registry, [1, 2], [3, 4]) == [0, 1]
    assert name(registry, [4, 5], [2, 6]) == [1, 0]
    assert name(registry, [6, 7]) == [0]


def test_a_new_object_gets_a_new_number():
    registry = ObjectRegistry()
    name(registry, [1, 2])
    assert name(registry, [3, 4]) == [1]
    assert name(registry, [1, 5], [6, 7]) == [0, 2]


def test_two_groups_never_share_a_number_and_the_larger_claim_wins():
    registry = ObjectRegistry()
    name(registry, [1, 2, 3])
    assert name(registry, [1, 8], [2, 3]) == [1, 0]


def test_no_group_is_no_trouble():
    assert name(ObjectRegistry()) == []


def test_long_tracklets_count_more_than_short_ones():
    registry = ObjectRegistry(np.array([60.0, 57.0, 2.0, 3.0, 2.0]))
    name(registry, [0, 1, 2, 3, 4])
    assert name(registry, [2, 3, 4], [0, 1]) == [1, 0]
