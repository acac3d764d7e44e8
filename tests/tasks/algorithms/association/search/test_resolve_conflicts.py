"""Conflicts: tracklets change groups as weighing each by all objects says."""

import numpy as np
import pytest
from scenes.ten_tracklets import gain_of, points_of, ten_tracklets

from epipole.tasks.algorithms.association.search.resolve_conflicts import resolve_conflicts

MIN_GAIN, MIN_LEAD, MIN_TRACKLETS = 2.0, 5.0, 3
SCENES = [
    {"n_objects": 3, "spread_km": 0.4},
    {"n_objects": 3, "spread_km": 0.4, "moving": True},
    {"n_objects": 2, "spread_km": 20.0},
    {"n_objects": 3, "spread_km": 0.3, "times": (0.0, 15.0), "seen": 0.8},
]


def resolved(scene, group):
    """Return the groups after each object was searched for its best tracklet in each sensor."""
    samples, group = scene.samples, group.copy()
    points, size = {}, {}
    for g in range(group.max() + 1):
        members = np.flatnonzero(group == g)
        solved = points_of(samples, members) if len(members) >= MIN_TRACKLETS else None
        points[g], size[g] = (None, 0) if solved is None else (solved[0], len(members))
    for s in range(len(samples.half_field)):
        mine = np.flatnonzero(samples.sensor == s)
        for g in points:
            if size[g] < MIN_TRACKLETS or not len(mine):
                continue
            gain, c = max((gain_of(scene, c, points[g]), c) for c in mine)
            o = group[c]
            if gain <= MIN_GAIN or o in (-1, g) or size[o] <= MIN_TRACKLETS:
                continue
            theirs = gain_of(scene, c, points[o], np.inf)
            if theirs - gain >= MIN_LEAD:
                continue
            size[o] -= 1
            group[c] = -1
            if gain - theirs >= MIN_LEAD and not (group[mine] == g).any():
                group[c] = g
                size[g] += 1
    return group


def mixed(scene, rng):
    """Return the true groups, with some tracklets in another object's group or in none."""
    group = scene.who.copy()
    for i in rng.permutation(np.flatnonzero(group >= 0))[: rng.integers(1, 4)]:
        group[i] = rng.integers(-1, group.max() + 1)
    return group


@pytest.mark.parametrize("options", SCENES)
@pytest.mark.parametrize("seed", range(4))
def test_groups_change_as_weighing_every_tracklet_says(seed, options):
    rng = np.random.default_rng(seed)
    scene = ten_tracklets(seed, n_sensors=6, n_strays=1, **options)
    changed = 0
    for _ in range(3):
        group = mixed(scene, rng)
        x_km = np.array([start(scene, group, g) for g in range(group.max() + 1)])
        found = group.copy()
        resolve_conflicts(scene.space, scene.work, found, x_km)
        assert found.tolist() == resolved(scene, group).tolist()
        changed += (found != group).sum()
    assert changed or options["spread_km"] > 1 or seed


def start(scene, group, g):
    solved = points_of(scene.samples, np.flatnonzero(group == g))
    return np.zeros(3) if solved is None or not solved[0] else solved[0][min(solved[0])][0]


def test_a_tracklet_goes_to_the_object_that_clearly_explains_it_and_to_none_of_three_views():
    scene = ten_tracklets(4, n_sensors=6, n_objects=2, n_strays=0, spread_km=50.0)
    first = np.flatnonzero(scene.who == 0)
    wrong = first[-1]
    x_km = np.array([start(scene, scene.who, g) for g in (0, 1)])
    for kept, expected in [(6, 0), (2, 1)]:
        group = scene.who.copy()
        group[wrong] = 1  # a view of object 0 in the group of object 1
        other = np.flatnonzero(group == 1)
        last = np.flatnonzero(
            (scene.who == 1) & (scene.samples.sensor == scene.samples.sensor[wrong])
        )
        group[last] = -1
        spare = [i for i in other if i not in (wrong, *last)]
        group[spare[kept:]] = -1
        resolve_conflicts(scene.space, scene.work, group, x_km)
        assert group[wrong] == expected
