"""Leftover seeds: tracklets meet where no pair of sensors has looked, and only there."""

import numpy as np
import pytest
from scenes.ten_tracklets import GATE_SIGMA, in_field, point, ten_tracklets
from scenes.tracklet_scenes import GEO

from epipole.tasks.algorithms.association.odds import MAX_RANGE_RATIO
from epipole.tasks.algorithms.association.search.leftover_seeds import MAX_LEFT, leftover_seeds
from epipole.tasks.algorithms.association.search.seeds import seeds_between
from epipole.tasks.algorithms.association.search.sensor_pairs import RankedPairs
from epipole.tasks.algorithms.association.views import PLANE, R_KM


def pairs_of(n_sensors, n_seeded):
    """All pairs of sensors, of which the last ones have seeded."""
    a, b = np.triu_indices(n_sensors, 1)
    waiting = np.arange(len(a)) < len(a) - n_seeded
    points = np.full((len(a), 1, 3), np.nan)
    return RankedPairs(
        a=a, b=b, always=np.zeros(len(a), bool), points=points, share=np.ones(len(a)),
        waiting=waiting, covered=np.zeros((len(a), 1), np.int64),
    )  # fmt: skip


def seeds(scene, pairs, enough):
    found = leftover_seeds(scene.space, pairs, enough, GATE_SIGMA)
    assert len(np.unique(found, axis=0)) == len(found)
    return set(map(tuple, found.tolist()))


def of_pairs(scene, pairs):
    return {
        tuple(seed)
        for a, b in zip(pairs.a[pairs.waiting], pairs.b[pairs.waiting], strict=True)
        for seed in seeds_between(scene.space, a, b, GATE_SIGMA).tolist()
    }


@pytest.mark.parametrize("seed", range(3))
def test_free_tracklets_of_skipped_pairs_are_seeds_where_they_meet(seed):
    scene = ten_tracklets(seed, n_sensors=4, n_objects=8, spread_km=40.0)
    scene.space.taken[:] = np.random.default_rng(seed).random(len(scene.who)) < 0.3
    none, three = pairs_of(4, 0), pairs_of(4, 3)
    assert seeds(scene, none, 1.0) == of_pairs(scene, none) != set()
    assert seeds(scene, three, 4.0) == of_pairs(scene, three) != set()


@pytest.mark.parametrize("enough", [1.0, 2.0, 3.0])
@pytest.mark.parametrize("seed", range(3))
def test_what_enough_pairs_should_have_seen_is_no_seed(seed, enough):
    scene = ten_tracklets(seed, n_sensors=4, n_objects=8, spread_km=40.0)
    pairs = pairs_of(4, 3)
    seeded = list(zip(pairs.a[~pairs.waiting], pairs.b[~pairs.waiting], strict=True))
    expected, of_skipped = set(), of_pairs(scene, pairs)
    for i, j in of_skipped:
        x = point(scene.samples, (i, j), 0)[0]
        range_km = np.linalg.norm(x - scene.samples.sensor_km[:, 0], axis=1)
        farthest_km = MAX_RANGE_RATIO * range_km[scene.space.views.sensor[[i, j]]].min()
        looking = [
            a for a in range(4)
            if in_field(scene.samples, a, 0, x) and range_km[a] <= farthest_km
        ]  # fmt: skip
        if sum(a in looking and b in looking for a, b in seeded) < enough:
            expected.add((i, j))
    assert seeds(scene, pairs, enough) == expected
    assert expected != of_skipped


def test_sensors_that_are_much_farther_away_do_not_cover_what_is_too_faint_for_them():
    scene = ten_tracklets(1, n_sensors=4, n_objects=8, n_strays=0, spread_km=1.0)
    pairs = pairs_of(4, 1)
    assert seeds(scene, pairs, 1.0) == set()  # sensors 2 and 3 have seeded, and have all objects
    place_km = scene.space.views.camera[2:, :, R_KM:PLANE]
    place_km[:] = GEO + 1.6 * (place_km - GEO)
    found = seeds(scene, pairs, 1.0)
    sensor = scene.space.views.sensor
    assert {(int(sensor[i]), int(sensor[j])) for i, j in found} >= {(0, 1)}


def test_sensors_with_many_tracklets_left_take_no_part():
    scene = ten_tracklets(1, n_sensors=3, n_objects=MAX_LEFT + 1, n_strays=0, spread_km=400.0)
    assert seeds(scene, pairs_of(3, 0), 1.0) == set()
    scene.space.taken[scene.space.views.first[:-1]] = True  # one of each sensor
    assert seeds(scene, pairs_of(3, 0), 1.0) != set()
