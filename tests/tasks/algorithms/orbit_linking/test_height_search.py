"""Height search: true pairs are found with their orbit, few others are, and where each may move."""

import numpy as np
import pytest
from scenes.orbit_tracklets import orbit_tracklets

from epipole.tasks.algorithms.orbit_linking.height_search import (
    MIN_GAP_S,
    at_heights,
    height_edges,
    search_heights,
)
from epipole.tasks.algorithms.orbit_linking.pair_search import packed_tracklets


def possible_heights(seen):
    edges = height_edges()
    out = np.zeros((len(edges) - 1, len(seen.time_s)), bool)
    at_heights(seen, edges, out)
    return edges, out


def found(seen, known=None, gap_s=2400.0):
    n = len(seen.time_s)
    known = np.full(n, -1) if known is None else known
    edges, possible = possible_heights(seen)
    pairs, states = np.empty((50 * n, 2), np.int64), np.empty((50 * n, 6))
    count = search_heights(seen, packed_tracklets(seen), known, possible, edges, gap_s, pairs,
                           states)  # fmt: skip
    return pairs[:count], states[:count]


def test_heights_are_without_gaps():
    edges = height_edges()
    assert edges[0] < 6378 + 200
    assert edges[-1] > 42_164 + 3_000
    assert (np.diff(edges) > 0).all()
    assert (np.diff(edges) / edges[:-1]).max() < 0.07


def test_an_object_may_move_at_its_height_and_at_few_others():
    scene = orbit_tracklets(1, 200, 1, 1.0)
    edges, possible = possible_heights(scene.tracklets)
    radius = np.linalg.norm(scene.state[:, :3], axis=1)
    at = np.searchsorted(edges, radius) - 1
    assert possible[at, np.arange(200)].mean() > 0.98
    assert possible.sum(axis=0).mean() < 0.25 * len(possible)


@pytest.mark.parametrize("gap_s", [800.0, 1500.0, 2200.0])
def test_true_pairs_are_found_with_their_orbit(gap_s):
    scene = orbit_tracklets(2, 80, 2, gap_s)
    seen = scene.tracklets
    pairs, states = found(seen, gap_s=3000.0)
    near, wanted = 0, 0
    for number in range(80):
        i, j = np.flatnonzero(scene.object == number)
        if not MIN_GAP_S < seen.time_s[j] - seen.time_s[i] < 2400.0:
            continue
        wanted += 1
        of_pair = states[(pairs == [i, j]).all(axis=1)]
        off_km = np.linalg.norm(of_pair[:, :3] - scene.state[i, :3], axis=1)
        near += len(off_km) > 0 and off_km.min() < 50.0
    assert wanted > 30
    assert near >= 0.95 * wanted


def test_few_others_are_found():
    scene = orbit_tracklets(3, 300, 1, 2400.0)
    pairs, _ = found(scene.tracklets)
    assert len(np.unique(pairs, axis=0)) <= 1e-3 * (300 * 299 / 2)


def test_pairs_of_one_object_or_of_one_sensor_at_a_time_or_farther_apart_are_not_searched():
    scene = orbit_tracklets(4, 30, 2, 1500.0)
    seen = scene.tracklets
    pairs, _ = found(seen)
    assert len(pairs)
    gaps = seen.time_s[pairs[:, 1]] - seen.time_s[pairs[:, 0]]
    assert gaps.min() >= MIN_GAP_S
    assert len(found(seen, np.zeros(60, np.int64))[0]) == 0
    one = seen._replace(sensor=np.zeros_like(seen.sensor), last_s=seen.last_s + 3e3)
    assert len(found(one)[0]) == 0
    shorter, _ = found(seen, gap_s=600.0)
    assert (seen.time_s[shorter[:, 1]] - seen.time_s[shorter[:, 0]]).max() <= 600.0


@pytest.mark.parametrize("n", [0, 1])
def test_no_tracklets_no_pairs(n):
    seen = orbit_tracklets(5, 1, 1, 1.0).tracklets
    assert len(found(type(seen)(*(column[:n] for column in seen)))[0]) == 0
