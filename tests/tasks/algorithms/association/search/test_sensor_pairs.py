"""Seeds: which pairs of sensors search for objects."""

import itertools

import numpy as np
import pytest
from scenes.tracklet_scenes import FIELD, GEO, V_GEO, Scene

from epipole.tasks.algorithms.association.search.field_index import cones_of, field_index
from epipole.tasks.algorithms.association.search.sensor_pairs import SensorPairs, fields_meet
from epipole.tasks.algorithms.association.views import views_of
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM


@pytest.mark.parametrize("seed", range(3))
def test_pairs_that_alone_share_the_edge_of_their_fields_take_part(seed):
    """Pairs that cover most objects do not make up for the few sensors that see another one."""
    scene = Scene(seed, 12).objects(20, spread_km=100.0)
    off = scene.rng.normal(size=3)
    off *= 0.4 * FIELD * 36000.0 / np.linalg.norm(off)
    few = sorted(scene.rng.permutation(12)[:3].tolist())
    for s in few:
        path = GEO + off + scene.times[:, None] * V_GEO - scene.r[s]
        scene.add(s, 99, path / np.linalg.norm(path, axis=1, keepdims=True))
    views, _ = views_of(scene.samples())
    cones = cones_of(views)
    sensor_pairs = SensorPairs(views, 1e5, field_index(cones, 1e5), cones)
    taking_part = set()
    while (pair := sensor_pairs.next(3.0)) is not None:
        taking_part.add(tuple(sorted(pair)))
    assert set(itertools.combinations(few, 2)) <= taking_part
    assert len(taking_part) < 66  # all pairs would be 66


def behind_earth(r, x):
    """Return whether the Earth is between r and x, (n, 3) both."""
    d = x - r
    part = np.clip(-np.sum(r * d, axis=1) / np.sum(d * d, axis=1), 0, 1)
    return np.linalg.norm(r + part[:, None] * d, axis=1) < EARTH_RADIUS_KM


@pytest.mark.parametrize("seed", range(4))
def test_fields_that_share_a_place_meet(seed):
    """Also where their axes pass far from each other, or part."""
    rng, n = np.random.default_rng(seed), 90
    place = rng.normal(size=(n, 3))
    place *= rng.choice([6900.0, 42000.0], n)[:, None] / np.linalg.norm(place, axis=1)[:, None]
    look = rng.normal(size=(n, 3))
    look /= np.linalg.norm(look, axis=1, keepdims=True)
    half = np.radians(rng.choice([1.0, 4.0, 10.0], n))
    cones = np.column_stack([place, look, np.tan(half)])[:, None]
    a, b = np.triu_indices(n, 1)
    meet = fields_meet(cones, a, b, 1e5)
    share = np.zeros(len(a), bool)
    for _ in range(400):  # points in the cones of the first sensors
        off = rng.normal(size=(n, 3))
        off *= (np.tan(half) * rng.uniform(size=n) / np.linalg.norm(off, axis=1))[:, None]
        ways = look + off - np.sum(off * look, axis=1, keepdims=True) * look
        point = place + ways * np.exp(rng.uniform(np.log(50), np.log(9e4), n))[:, None]
        toward = point[a] - place[b]
        along = np.sum(toward * look[b], axis=1)
        inside = along > np.cos(half[b]) * np.linalg.norm(toward, axis=1)
        share |= inside & ~behind_earth(place[a], point[a]) & ~behind_earth(place[b], point[a])
    assert share.sum() > 20
    assert meet[share].all()
    assert meet.mean() < 0.5


@pytest.mark.parametrize("common", [[4, 5], [7], [0, 1, 2, 25]])
def test_fields_meet_where_both_sensors_have_tracklets(common):
    """A passage lasts for few of a window's instants, and a field without tracklets is no cone."""
    cones = np.zeros((3, 30, 7))
    place, toward = np.array([7000.0, 0.0, 0.0]), np.array([7600.0, 0.0, 0.0])
    for s, aside in enumerate((-100.0, 100.0)):
        r = place + np.array([0.0, aside, 0.0])
        look = (toward - r) / np.linalg.norm(toward - r)
        cones[s, common] = [*r, *look, np.tan(np.radians(5.0))]
    cones[0, 9:14], cones[1, 15:20] = cones[0, common[0]], cones[1, common[0]]  # one alone
    cones[2] = [*place, 0.0, 0.0, 1.0, np.tan(np.radians(5.0))]
    meet = fields_meet(cones, np.array([0, 0, 1]), np.array([1, 2, 2]), 1e5)
    assert meet.tolist() == [True, False, False]


def test_fields_that_meet_at_the_end_only_are_a_pair():
    cones = np.zeros((2, 30, 7))
    for m in range(30):
        for s, side in enumerate((-1.0, 1.0)):
            off = np.radians(90.0 - 3.0 * m) * side  # the fields turn towards each other
            look = [np.cos(off), np.sin(off), 0.0]
            cones[s, m] = [7000.0, 300.0 * side, 0.0, *look, np.tan(np.radians(5.0))]
    pair = np.array([0]), np.array([1])
    assert not fields_meet(cones[:, :20], *pair, 1e5)[0]
    assert fields_meet(cones, *pair, 1e5)[0]
