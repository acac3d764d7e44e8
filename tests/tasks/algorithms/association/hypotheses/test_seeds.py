"""Seeds: which pairs of sensors search for objects."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from scenes.tracklet_scenes import FIELD, GEO, V_GEO, Scene

from epipole.tasks.algorithms.association.hypotheses.seeds import (
    SensorPairs,
    fields_meet,
)
from epipole.tasks.algorithms.association.sampling.views import views_of


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
    sensor_pairs = SensorPairs(views_of(scene.samples())[0], 1e5)
    taking_part = set()
    while (pair := sensor_pairs.next(3.0)) is not None:
        taking_part.add(tuple(sorted(pair)))
    assert set(itertools.combinations(few, 2)) <= taking_part
    assert len(taking_part) < 66  # all pairs would be 66


@pytest.mark.parametrize("seed", range(4))
def test_fields_that_share_a_place_meet(seed):
    """Also where their axes pass far from each other, or part."""
    rng, n = np.random.default_rng(seed), 90
    place = rng.normal(size=(n, 3))
    place *= rng.choice([6900.0, 42000.0], n)[:, None] / np.linalg.norm(place, axis=1)[:, None]
    look = rng.normal(size=(n, 3))
    look /= np.linalg.norm(look, axis=1, keepdims=True)
    half = np.radians(rng.choice([1.0, 4.0, 10.0], n))
    plane = np.zeros((n, 1, 3, 3))
    plane[:, 0, 2] = look
    views = SimpleNamespace(plane=plane, place_km=place[:, None], time_s=np.zeros(1))
    a, b = np.triu_indices(n, 1)
    meet = fields_meet(views, half, a, b, 1e5)
    share = np.zeros(len(a), bool)
    for _ in range(400):  # points in the cones of the first sensors
        off = rng.normal(size=(n, 3))
        off *= (np.tan(half) * rng.uniform(size=n) / np.linalg.norm(off, axis=1))[:, None]
        ways = look + off - np.sum(off * look, axis=1, keepdims=True) * look
        point = place + ways * np.exp(rng.uniform(np.log(50), np.log(9e4), n))[:, None]
        toward = point[a] - place[b]
        along = np.sum(toward * look[b], axis=1)
        share |= along > np.cos(half[b]) * np.linalg.norm(toward, axis=1)
    assert share.sum() > 20
    assert meet[share].all()
    assert meet.mean() < 0.5
