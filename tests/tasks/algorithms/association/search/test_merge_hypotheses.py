"""Mergers: the likeliest of all mergers of two hypotheses, tried one by one."""

import numpy as np
import pytest
from scenes.ten_tracklets import points_of, score, ten_tracklets

from epipole.tasks.algorithms.association.hypothesis_queue import Hypothesis
from epipole.tasks.algorithms.association.search.merge_hypotheses import best_merger

TIMES = (0.0, 10.0, 20.0, 30.0)


def hypothesis(scene, members, value=None):
    members = tuple(sorted(int(i) for i in members))
    value = score(scene, members)[0] if value is None else value
    return Hypothesis(value, members[:2], members, np.zeros(3), np.zeros(0, np.int64))


def by_trying_all(scene, h, others):
    """Return members, score and misses of the best merger, None where none is likelier."""
    seen, best = scene.samples.seen, None
    solved = [m for m in range(len(TIMES)) if sum(seen[i, m] for i in h.members) >= 2]
    for other in others:
        more = set(other.members) - set(h.members)
        if not more or any(scene.space.taken[i] for i in more):
            continue
        if len(solved) == len(TIMES) or any(seen[i, m] for i in more for m in solved):
            continue
        members = tuple(sorted(set(h.members) | more))
        value, missed = score(scene, members)
        if value > max(h.score, other.score) and (best is None or value > best[1]):
            best = members, value, missed
    return best


def scene_in_turn(seed, n_sensors=4):
    """Sensors that see two objects in turn: the first throughout, others early or late only."""
    scene = ten_tracklets(seed, n_sensors=n_sensors, n_strays=1, times=TIMES, spread_km=30.0)
    seen, early = scene.samples.seen, np.array([True, True, False, False])
    for i, s in enumerate(scene.samples.sensor):
        if s > 0:
            seen[i] = early if s % 2 else ~early
    scene.space.views.seen[:] = seen
    return scene


@pytest.mark.parametrize("seed", range(6))
def test_the_best_merger_is_the_best_of_all(seed):
    scene, rng = scene_in_turn(seed), np.random.default_rng(seed)
    merged = 0
    for k in range(2):
        mine = np.flatnonzero(scene.who == k)
        early, late = mine[scene.samples.sensor[mine] % 2 == 1], mine[[0, 2]]
        h = hypothesis(scene, [mine[0], *early])
        others = [hypothesis(scene, late)]
        for _ in range(6):  # wrong ones, repeated ones, ones that are seen at the same instants
            chosen = rng.choice(len(scene.who), rng.integers(1, 3), replace=False)
            others.append(hypothesis(scene, {mine[0], *chosen}, value=rng.normal()))
        others += [hypothesis(scene, h.members, value=-50.0), others[0]]
        for taken in (-1, late[1]):
            scene.space.taken[:] = False
            scene.space.taken[taken] = taken >= 0
            order = [others[q] for q in rng.permutation(len(others))]
            merger = best_merger(scene.space, scene.work, h, order)
            expected = by_trying_all(scene, h, order)
            assert (merger is None) == (expected is None)
            if merger is None:
                continue
            assert merger.members == expected[0]
            assert merger.score == pytest.approx(expected[1], abs=1e-2)
            assert merger.missed.tolist() == expected[2]
            assert merger.seed == h.seed
            points = points_of(scene.samples, merger.members)[0]
            x, P = points[min(points)]
            assert (merger.x_km - x) @ np.linalg.solve(P, merger.x_km - x) < 1e-4
            merged += taken < 0
        scene.space.taken[:] = False
    assert merged == 2


def test_a_hypothesis_that_is_solved_at_all_instants_has_no_merger():
    scene = scene_in_turn(1)
    mine = np.flatnonzero(scene.who == 0)
    h = hypothesis(scene, mine)
    lone = hypothesis(scene, [mine[0], *np.flatnonzero(scene.who == 1)[:1]], value=-99.0)
    assert best_merger(scene.space, scene.work, h, [lone]) is None


def test_a_merger_that_is_no_likelier_than_its_parts_is_none():
    scene = scene_in_turn(2)
    mine = np.flatnonzero(scene.who == 0)
    h, late = hypothesis(scene, mine[[0, 1]]), hypothesis(scene, mine[[0, 2]])
    value = best_merger(scene.space, scene.work, h, [late]).score
    for better in (h, late):
        surer = Hypothesis(value + 0.1, better.seed, better.members, better.x_km, better.missed)
        pair = (surer, late) if better is h else (h, surer)
        assert best_merger(scene.space, scene.work, pair[0], [pair[1]]) is None
