"""Seeds: which pairs of sensors search for objects."""

import itertools

import numpy as np
import pytest
from scenes.tracklet_scenes import FIELD, GEO, V_GEO, Scene

from epipole.tasks.algorithms.association.hypotheses.seeds import SensorPairs
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
