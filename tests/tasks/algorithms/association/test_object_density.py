"""Object density: volumes against points at random, revised odds against plain counting."""

import numpy as np
import pytest
from scenes.ten_tracklets import ten_tracklets, unit

from epipole.tasks.algorithms.association import chance as chance_module
from epipole.tasks.algorithms.association.chance import (
    Chance,
    SensorSets,
    VisibleVolumes,
    revised_odds,
    sets_of_sensors,
    visible_volumes,
)
from epipole.tasks.algorithms.association.hypothesis_queue import Hypothesis
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM

SHELLS = np.array([(0.0, 10000.0, 1.0), (9000.0, 16000.0, 2.5), (16000.0, np.inf, 0.7)])


@pytest.mark.parametrize(
    ("seed", "n_sensors", "of_set"), [(0, 2, 2), (5, 3, 2), (7, 4, 3), (7, 6, 6), (12, 7, 6)]
)
def test_volumes_are_those_of_random_points_that_the_sensors_see(seed, n_sensors, of_set):
    scene = ten_tracklets(seed, n_sensors=n_sensors, n_objects=1, n_strays=0)
    rng, samples, farthest = np.random.default_rng(seed), scene.samples, 2e4
    points, expected = 800_000 // of_set, np.zeros((2, len(SHELLS)))
    for s in range(of_set):
        wide = samples.half_field[s]
        toward = np.column_stack([rng.uniform(-1, 1, (points, 2)) * wide, np.ones(points)])
        # Uniform on the plane: a point stands for 1 / stretch^3 of the solid angle.
        stretch = np.linalg.norm(toward, axis=1)
        rho = farthest * rng.random(points) ** (1 / 3)
        turned = unit(toward) @ samples.R_sensor_from_icrs[s, 0]
        x = samples.sensor_km[s, 0] + rho[:, None] * turned
        seen = np.array([sees(samples, k, x) for k in range(n_sensors)])
        inside, outside = seen[:of_set].sum(axis=0), seen[of_set:].sum(axis=0)
        part = 4 * wide.prod() / stretch**3 * farthest**3 / 3 / points
        part = np.where(inside > 1, part / np.maximum(inside, 1), 0)  # met from all that see it
        exactly = inside >= 0.8 * (of_set + outside)
        radius = np.linalg.norm(x, axis=1)
        for j, (low, high, weight) in enumerate(SHELLS):
            here = weight * part * (radius >= low) * (radius < high)
            expected[:, j] += here.sum(), here[exactly].sum()
    volumes = visible_volumes(scene.space.views, [np.arange(of_set)], SHELLS, farthest)
    for found, true in zip(volumes, expected, strict=True):
        np.testing.assert_allclose(found[0], true, rtol=0.1, atol=0.01 * np.sum(true))
    assert volumes.exclusive.sum() > 0


def test_the_volume_that_many_sensors_share_is_known_from_a_few_of_them():
    scene = ten_tracklets(12, n_sensors=30, n_objects=1, n_strays=0)
    views, of_all = scene.space.views, [np.arange(30)]
    few = visible_volumes(views, of_all, SHELLS, 2e4).shared.sum()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chance_module, "SAMPLED", 30)
        patch.setattr(chance_module, "SIGHTS", 3000)
        assert few == pytest.approx(
            visible_volumes(views, of_all, SHELLS, 2e4).shared.sum(), rel=0.3
        )


def test_no_sensor_that_may_see_a_point_is_passed_over():
    rng, passed = np.random.default_rng(3), 0
    for seed in range(20):
        scene = ten_tracklets(seed, n_sensors=12, n_objects=1, n_strays=0)
        samples, sensors = scene.samples, np.arange(12)
        toward = unit(rng.normal(size=3))
        middle = samples.sensor_km[0, 0] + rng.uniform(0, 3e4) * toward
        x = middle + rng.normal(size=(200, 3)) * 10 ** rng.uniform(0, 3)
        may_see = chance_module._may_see(scene.space.views, sensors, 0, x[:, None])
        assert may_see[[sees(samples, s, x).any() for s in sensors]].all()
        passed += (~may_see).sum()
    assert passed > 60  # of 240
    assert not chance_module._may_see(scene.space.views, sensors, 0, x[:0, None]).any()


def sees(samples, s, x):
    """Return which of the points a sensor sees, as `ten_tracklets.in_field` for many points."""
    r, R = samples.sensor_km[s, 0], samples.R_sensor_from_icrs[s, 0]
    d = x - r
    here = d @ R.T
    inside = (np.abs(here[:, :2]) <= 0.98 * samples.half_field[s] * here[:, 2:]).all(axis=1)
    part = np.clip(-(d @ r) / np.sum(d * d, axis=1), 0, 1)
    return inside & (np.linalg.norm(r + part[:, None] * d, axis=1) >= EARTH_RADIUS_KM)


def test_the_volume_is_unknown_if_one_attitude_alone_is_known():
    scene = ten_tracklets(0, n_sensors=3)
    camera = scene.space.views.camera.copy()
    camera[:2, :, 12:21] = np.nan
    views = scene.space.views._replace(camera=camera)
    volumes = visible_volumes(views, [np.arange(3)], SHELLS, 2e4)
    assert np.isnan(volumes.shared).all()
    assert np.isnan(volumes.exclusive).all()


def test_sets_of_almost_the_same_sensors_are_one():
    views = ten_tracklets(1, n_sensors=5, n_objects=1, n_strays=0, seen=1.0).space.views
    members = [(0, 1, 2, 3, 4), (0, 1), (0, 1, 2, 3, 4), (0, 1, 2, 3)]
    nothing, x = np.zeros(0, np.int64), np.zeros(3)
    groups = [Hypothesis(9.0, (0, 1), m, x, nothing) for m in members]
    groups.append(Hypothesis(9.0, (0, 1), (0, 1), x, np.array([2, 3, 4])))
    sets = sets_of_sensors(views, groups)
    assert [s.tolist() for s in sets.sensors] == [[0, 1, 2, 3, 4], [0, 1]]
    np.testing.assert_array_equal(sets.set_of, [0, 1, 0, 0, 0])


def test_a_set_counts_the_groups_that_two_of_its_sensors_have_in_their_fields():
    views = ten_tracklets(1, n_sensors=5, n_objects=1, n_strays=0, seen=1.0).space.views
    members = [(0, 1, 2), (2, 3, 4), (0, 1), (3, 4)]
    x, nothing = np.zeros(3), np.zeros(0, np.int64)
    sets = sets_of_sensors(views, [Hypothesis(9.0, m[:2], m, x, nothing) for m in members])
    counted = {
        tuple(s.tolist()): sets.group[sets.row == k].tolist() for k, s in enumerate(sets.sensors)
    }
    assert counted == {(0, 1, 2): [0, 2], (2, 3, 4): [1, 3], (0, 1): [0, 2], (3, 4): [1, 3]}


@pytest.mark.parametrize(("n_sensors", "largest"), [(5, 5), (40, 4), (12, 12)])
def test_sets_are_those_of_a_comparison_of_all_with_all(n_sensors, largest):
    rng = np.random.default_rng(n_sensors)
    views = ten_tracklets(1, n_sensors=2, n_objects=1, n_strays=0, seen=1.0).space.views
    views = views._replace(
        sensor=np.arange(n_sensors), camera=np.zeros((n_sensors, 1, views.camera.shape[2]))
    )
    groups, x = [], np.zeros(3)
    for _ in range(80):
        seeing = np.sort(rng.choice(n_sensors, rng.integers(2, largest + 1), replace=False))
        members, missed = tuple(seeing[:2].tolist()), seeing[2:]
        groups.append(Hypothesis(9.0, members, members, x, missed))
    inside = [{*g.members, *g.missed.tolist()} for g in groups]
    sets = sets_of_sensors(views, groups)
    kept = [set(s.tolist()) for s in sets.sensors]
    for g, sensors in enumerate(inside):
        like = [len(sensors & of) / len(sensors | of) for of in kept]
        assert like[sets.set_of[g]] >= 0.8
    pairs = [(k, g) for k, of in enumerate(kept) for g, s in enumerate(inside) if len(of & s) > 1]
    assert list(zip(sets.row.tolist(), sets.group.tolist(), strict=True)) == pairs
    alike = [len(a & b) / len(a | b) for k, a in enumerate(kept) for b in kept[:k]]
    assert max(alike, default=0.0) < 0.8


@pytest.mark.parametrize(
    ("own", "rate"), [(0.0, 21 / 1001), (50.0, 21 / 1001 / (50 * 21 / 1001 + 1))]
)
def test_a_group_of_a_set_of_its_own_is_judged_by_all_that_its_sensors_see(own, rate):
    """Of 20 objects where 1,000 were assumed, and of none where `own` were."""
    scores, radius = np.array([30.0] * 20 + [4.0]), np.full(21, 42000.0)
    sets = SensorSets(
        [np.arange(20), np.arange(3)],
        np.array([0] * 20 + [1]),
        np.repeat([0, 1], 21),
        np.tile(np.arange(21), 2),
    )
    shared = np.array([[0.0, 0.0, 1e12], [0.0, 0.0, 1e12]])
    volumes = VisibleVolumes(shared, np.array([[0.0, 0.0, 1e12], [0.0, 0.0, own * 1e9]]))
    revised = revised_odds(scores, radius, SHELLS, sets, volumes, chance(1000, 1e12))
    of_shell = 1 / (rate * own + 1)  # the shell has no other group, either
    assert revised[20] == pytest.approx(4.0 + np.log(rate * of_shell), abs=0.01)


def chance(objects, volume):
    nothing = np.zeros(0)
    return Chance(nothing, nothing, nothing, objects, objects / volume, nothing)


def counted(scores, radius, near, same, shared, own, assumed_km3):
    """Return the revised odds: shell by shell, group by group, to the same fixed point.

    `near` and `same` are the groups that count for each, `shared` and `own` the volumes.
    """
    n, n_shells = len(scores), len(SHELLS)
    shared, own = assumed_km3 * shared, assumed_km3 * own
    prior = [
        [1e-9 + (w if lo <= radius[g] < hi else 0.0) for lo, hi, w in SHELLS] for g in range(n)
    ]
    sure, revised = [float(s > 8.0) for s in scores], list(scores)
    for _ in range(100):
        common = [(sum(sure[h] for h in near[g]) + 1.0) / (sum(shared[g]) + 1.0) for g in range(n)]
        common = [
            c * (sum(sure[h] for h in same[g]) + 1.0) / (c * sum(own[g]) + 1.0)
            for g, c in enumerate(common)
        ]
        factor = [[c] * n_shells for c in common]
        for _ in range(10):
            share = [[sure[g] * p for p in shares(prior[g], factor[g])] for g in range(n)]
            factor = [
                [
                    common[g] * min(
                        (sum(share[h][j] for h in same[g]) + 1.0) / (common[g] * own[g][j] + 1.0),
                        10.0,
                    )
                    for j in range(n_shells)
                ]
                for g in range(n)
            ]  # fmt: skip
        before = sure
        revised = [
            scores[g] + np.log(np.dot(prior[g], factor[g]) / sum(prior[g])) for g in range(n)
        ]
        sure = [1 / (1 + np.exp(-min(max(r, -50), 50))) for r in revised]
        if max(abs(a - b) for a, b in zip(sure, before, strict=True)) < 1e-6:
            break
    return revised


def shares(prior, factor):
    """Return the probabilities of the shells."""
    both = [p * f for p, f in zip(prior, factor, strict=True)]
    return [b / sum(both) for b in both]


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_revised_odds_are_those_of_counting_shell_by_shell(seed, known):
    rng = np.random.default_rng(seed)
    scores = rng.normal(6.0, 5.0, 12)
    radius = rng.choice([7000.0, 9500.0, 12000.0, 42000.0], 12)
    shared = rng.uniform(1e11, 1e12, (3, 3)) if known else np.full((3, 3), np.nan)
    own = shared * rng.uniform(0.1, 1.0, (3, 3))
    of, set_of = chance(rng.uniform(1, 50), 1e12), rng.integers(0, 3, 12)
    set_of[0] = 2
    counts = rng.random((3, 12)) < 0.5
    counts[set_of, np.arange(12)] = True
    sets = SensorSets([np.arange(2)] * 3, set_of, *np.nonzero(counts))
    revised = revised_odds(scores, radius, SHELLS, sets, VisibleVolumes(shared, own), of)
    if not known:
        shared = own = np.full((3, 3), 1e12 / 3)
    near = [[h for h in range(12) if h != g and counts[set_of[g], h]] for g in range(12)]
    same = [[h for h in range(12) if h != g and set_of[h] == set_of[g]] for g in range(12)]
    expected = counted(scores, radius, near, same, shared[set_of], own[set_of], of.objects_km3)
    np.testing.assert_allclose(revised, expected, rtol=1e-9, atol=1e-9)
