"""Walker patterns, random low satellites, and mean elements for SGP4."""

import numpy as np
import pytest

from epipole.tasks.algorithms.simulation.element_sets import propagate
from epipole.tasks.algorithms.simulation.paths import state_at
from epipole.tasks.algorithms.simulation.shells import (
    POPULATION,
    mean_elements,
    nearest_of,
    random_population,
    scattered,
    walker_elements,
)

T0_NS = 1_780_142_400 * 10**9  # 2026-05-30T12:00:00Z


def angles(a, b):
    return np.degrees(np.arccos(np.clip(np.einsum("...i,...i", a, b), -1, 1)))


@pytest.mark.parametrize(("pattern", "arc_deg"), [((24, 6, 1), 360.0), ((66, 6, 2), 180.0)])
def test_a_pattern_has_even_planes_even_slots_and_the_phasing_of_its_notation(pattern, arc_deg):
    t, p, f = pattern
    i = np.radians(86.4)
    r, v = state_at(walker_elements(7000.0, i, pattern, np.radians(arc_deg)), np.zeros(t))
    np.testing.assert_allclose(np.linalg.norm(r, axis=1), 7000.0)
    u = (r / 7000.0).reshape(p, t // p, 3)
    normal = np.cross(r, v).reshape(p, t // p, 3)
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    # All of a plane share its normal, and their neighbours are 360 p / t degrees away.
    np.testing.assert_allclose(normal, np.broadcast_to(normal[:, :1], normal.shape), atol=1e-12)
    np.testing.assert_allclose(angles(u, np.roll(u, -1, axis=1)), 360.0 * p / t, atol=1e-6)
    node = np.stack([-normal[:, 0, 1], normal[:, 0, 0]], axis=1) / np.sin(i)
    np.testing.assert_allclose(angles(node[:-1], node[1:]), arc_deg / p, atol=1e-6)
    # From its node the first of a plane is f units ahead of the first of the plane before.
    ahead = np.degrees(np.unwrap(np.arctan2(u[:, 0, 2] / np.sin(i), (u[:, 0, :2] * node).sum(1))))
    np.testing.assert_allclose(np.diff(ahead), f * 360.0 / t, atol=1e-6)


def test_scattered_satellites_are_off_by_as_much_as_is_said():
    still = walker_elements(7000.0, np.pi / 2, (2000, 20, 1), 2 * np.pi)
    moved = scattered(still, 10.0, np.random.default_rng(1))
    (r, v), (r2, _) = state_at(still, np.zeros(2000)), state_at(moved, np.zeros(2000))
    up, along = r / 7000.0, v / np.linalg.norm(v, axis=1, keepdims=True)
    for axis in (up, along):
        assert np.std(np.einsum("ij,ij->i", r2 - r, axis)) == pytest.approx(10.0, rel=0.1)
    across = np.einsum("ij,ij->i", r2 - r, np.cross(up, along))
    low = np.abs(up[:, 2]) < 0.1  # near the nodes, polar orbits are moved across by all of it
    assert np.std(across[low]) == pytest.approx(10.0, rel=0.15)
    np.testing.assert_array_equal(
        still, walker_elements(7000.0, np.pi / 2, (2000, 20, 1), 2 * np.pi)
    )


def test_a_random_population_is_in_its_shells_above_the_ground():
    elements = random_population(20_000, np.random.default_rng(2))
    a, e, i = elements[:, 0], elements[:, 1], np.degrees(elements[:, 2])
    assert (a * (1 - e) > 6378.137 + 300).all()
    starlink = (np.abs(i - 53.1) < 0.1) & (np.abs(a - 6378.137 - 545.0) < 10.0)
    share = POPULATION[0, 0] / POPULATION[:, 0].sum()
    assert starlink.mean() == pytest.approx(share, abs=4 * np.sqrt(share / 20_000))
    nodes = np.histogram(np.remainder(elements[:, 3], 2 * np.pi), 8)[0]
    assert np.ptp(nodes) < 300  # 6 sigma of 2,500 each
    assert random_population(0, np.random.default_rng(2)).shape == (0, 6)


def test_sgp4_starts_near_the_two_body_state_and_turns_the_planes_westward():
    elements = walker_elements(6928.0, np.radians(53.0), (40, 8, 1), 2 * np.pi)
    times = T0_NS + np.arange(0, 86_401, 60) * 10**9
    r_km, failures = propagate(mean_elements(elements, T0_NS), times)
    assert not failures
    two_body, _ = state_at(elements, np.zeros(40))
    # TEME of 2026 is 0.36 degrees from GCRF: 44 km; short-period terms are some 10 km.
    assert np.linalg.norm(r_km[:, 0] - two_body, axis=1).max() < 65.0
    assert np.abs(np.linalg.norm(r_km, axis=2) - 6928.0).max() < 30.0
    normal = np.cross(r_km[:, :-1], r_km[:, 1:])
    node = np.unwrap(np.arctan2(normal[..., 0], -normal[..., 1]), axis=1)
    drift = np.degrees(node[:, -1] - node[:, 0])
    # Vallado (2013), equation 9-37: -2.06474e14 a^-3.5 cos i / (1 - e^2)^2 degrees a day.
    expected = -2.06474e14 * 6928.0**-3.5 * np.cos(np.radians(53.0))
    assert drift.mean() == pytest.approx(expected, rel=0.03)


def test_the_nearest_are_taken_in_their_order():
    r_km = np.array([[0.0, 0, 0], [9, 0, 0], [1, 0, 0], [5, 0, 0], [-2, 0, 0]])
    assert nearest_of(r_km, 0, 3).tolist() == [0, 2, 4]
    assert nearest_of(r_km, 3, 1).tolist() == [3]
