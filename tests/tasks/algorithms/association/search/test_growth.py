"""Growth: what a seed grows into is the best of all sets of tracklets that contain it."""

import numpy as np
import pytest
from scenes.ten_tracklets import (
    GATE_SIGMA,
    TenTracklets,
    points_of,
    score,
    subsets,
    ten_tracklets,
)

from epipole.tasks.algorithms.association.search.growth import MIN_LEAD, grow_all
from epipole.tasks.algorithms.association.search.seeds import seeds_between

LOW, NEVER = -6.0, np.inf
CLEAR_SCENES = [
    {"n_objects": 2, "n_strays": 1},
    {"n_objects": 2, "n_strays": 1, "moving": True},
    {"n_objects": 2, "n_strays": 0, "n_sensors": 5},
    {"n_objects": 2, "n_strays": 1, "times": (0.0, 12.0, 24.0), "seen": 0.8, "n_sensors": 3},
]
CROWDED_SCENES = [
    {"n_objects": 3, "n_strays": 0, "spread_km": 0.15},
    {"n_objects": 3, "n_strays": 0, "spread_km": 0.3, "moving": True},
    {"spread_km": 0.2, "n_strays": 1, "times": (0.0, 12.0), "seen": 0.8, "n_sensors": 3},
]


def grown(scene, seeds, clear=NEVER, min_score=LOW):
    """Return the hypotheses of seeds: seed, members, score, point, sensors that miss, taken."""
    of = grow_all(
        scene.space, scene.work, np.array(seeds, np.int64).reshape(-1, 2), clear, min_score
    )
    return [
        (
            int(of.seed[q]),
            tuple(of.member[of.first_member[q] : of.first_member[q + 1]].tolist()),
            of.score[q],
            of.x_km[q],
            of.missed[of.first_missed[q] : of.first_missed[q + 1]].tolist(),
            bool(of.taken[q]),
        )
        for q in range(len(of.seed))
    ]


def all_seeds(scene: TenTracklets):
    n = len(scene.samples.half_field)
    pairs = [(a, b) for a in range(n) for b in range(a + 1, n)]
    return np.concatenate([seeds_between(scene.space, a, b, GATE_SIGMA) for a, b in pairs])


def best_of(scene, among):
    """Return the score of each set of the tracklets that fits, by its members."""
    scores = {members: score(scene, members)[0] for members in subsets(scene.samples, among)}
    return {members: value for members, value in scores.items() if np.isfinite(value)}


@pytest.mark.parametrize("options", CLEAR_SCENES)
@pytest.mark.parametrize("seed", range(2))
def test_in_clear_scenes_a_seed_grows_into_the_best_set_that_holds_it(seed, options):
    scene = ten_tracklets(seed, **options)
    scores, seeds = best_of(scene, range(len(scene.who))), all_seeds(scene)
    found = grown(scene, seeds)
    judged = 0
    for q, members, value, x_km, missed, taken in found:
        i, j = seeds[q]
        if scene.who[i] != scene.who[j] or scene.who[i] < 0:
            continue
        holding = {m: s for m, s in scores.items() if i in m and j in m}
        best = max(holding, key=holding.get)
        assert members == best
        check(scene, members, value, x_km, missed)
        assert not taken
        judged += 1
    # Every pair of one object's views that can begin it does so.
    right = [(i, j) for i, j in seeds if scene.who[i] == scene.who[j] >= 0]
    worth = [
        (i, j) for i, j in right
        if max((s for m, s in scores.items() if i in m and j in m), default=LOW) > LOW
    ]  # fmt: skip
    assert judged == len(worth) > 0


def check(scene, members, value, x_km, missed):
    """Check the odds, the point and the misses of a hypothesis against the formulas."""
    expected, misses = score(scene, members)
    assert value == pytest.approx(expected, abs=5e-3)
    assert missed == misses
    points = points_of(scene.samples, members)[0]
    x, P = points[min(points)]
    away = x_km - x
    assert away @ np.linalg.solve(P, away) < 1e-4


@pytest.mark.parametrize("options", CROWDED_SCENES)
@pytest.mark.parametrize("seed", range(2))
def test_in_crowded_scenes_hypotheses_are_valid_and_near_the_best_one(seed, options):
    scene = ten_tracklets(seed, **options)
    scores, seeds = best_of(scene, range(len(scene.who))), all_seeds(scene)
    found = grown(scene, seeds)
    for _, members, value, x_km, missed, _ in found:
        assert members in scores
        check(scene, members, value, x_km, missed)
    # A view that two objects could have may be left open: then the best set is a view larger.
    assert max(value for _, _, value, *_ in found) >= max(scores.values()) - MIN_LEAD


def test_hypotheses_below_the_minimum_odds_and_seeds_that_are_taken_are_left_out():
    scene = ten_tracklets(0, n_objects=2)
    seeds = all_seeds(scene)
    everything = grown(scene, seeds)
    values = sorted(value for _, _, value, *_ in everything)
    for min_score in (values[1], values[-2]):
        left = grown(scene, seeds, min_score=min_score)
        assert [q for q, *_ in left] == [q for q, _, value, *_ in everything if value > min_score]
    for side in (0, 1):
        taken = int(seeds[0, side])
        scene.space.taken[taken] = True
        left = grown(scene, seeds)
        assert all(taken not in members for _, members, *_ in left)
        assert {q for q, *_ in left} <= {q for q, s in enumerate(seeds) if taken not in s}
        scene.space.taken[taken] = False


@pytest.mark.parametrize("seed", range(6))
def test_a_clear_group_of_many_views_is_taken_and_what_follows_may_not_use_it(seed):
    scene = ten_tracklets(seed, n_sensors=10, n_objects=1, n_strays=0)
    scene.space.chance.detected[:] = 0.9
    seeds = all_seeds(scene)
    first = grown(scene, seeds, clear=15.0)
    has, missed = len(first[0][1]), len(first[0][4])
    if has >= 8 and first[0][2] > 15.0 and has >= 0.85 * 0.9 * (has + missed):
        assert first[0][5]
        assert len(first) == 1  # all other seeds have a tracklet that is taken
        assert np.flatnonzero(scene.space.taken).tolist() == list(first[0][1])
    else:
        assert not first[0][5]
    scene.space.taken[:] = False
    value = first[0][2]
    assert not grown(scene, seeds[:1], clear=value)[0][5]
    assert not scene.space.taken.any()


def test_a_group_that_many_sensors_miss_is_not_clear():
    """Of twelve sensors that see the object, the last ones have only another tracklet free."""
    n_clear = []
    for n_lost in (0, 3, 6):
        n_clear.append(0)
        for seed in range(6):
            scene = ten_tracklets(seed, n_sensors=12, n_objects=1, n_strays=1)
            scene.space.chance.detected[:] = 0.9
            mine = np.flatnonzero(scene.who == 0)
            lost = mine[len(mine) - n_lost :]
            scene.space.taken[lost] = True
            _, members, value, _, missed, taken = grown(scene, [mine[:2]], clear=15.0)[0]
            usual = 0.9 * (len(members) + len(missed))
            assert taken == (value > 15.0 and len(members) >= 8 and len(members) >= 0.85 * usual)
            n_clear[-1] += taken
            assert set(scene.samples.sensor[lost]) >= set(missed)
    assert n_clear[0] > n_clear[1] > 0
    assert n_clear[2] == 0  # fewer than eight views


def test_many_seeds_have_room():
    scene = ten_tracklets(2, n_sensors=3, n_objects=10, n_strays=0)
    seeds = np.repeat(all_seeds(scene), 8, axis=0)
    found = grown(scene, seeds)
    assert len(found) > 100
    one = {q // 8: rest for q, *rest in found}
    for q, *rest in found:
        assert rest[0] == one[q // 8][0]
        assert rest[1] == one[q // 8][1]
        assert rest[3] == one[q // 8][3]
