"""Chance: how unrelated tracklets behave is estimated from the data, and not from too few."""

import numpy as np
import pytest
from scenes.passages import passages
from scenes.ten_tracklets import ten_tracklets
from scenes.tracklet_scenes import Scene, judge, solve

from epipole.tasks.algorithms.association.chance import USUAL_SPREAD, chance_of
from epipole.tasks.algorithms.constants import ARCSEC


def partly_seen(seed, n_sensors, detected, n_objects=30):
    """Return a scene of objects that each sensor detects with its probability, and a few strays."""
    scene = Scene(seed, n_sensors)
    rng = np.random.default_rng([seed, 1])
    for k in range(n_objects):
        seen_by = np.flatnonzero(rng.random(n_sensors) < detected)
        begun = len(scene.who)
        scene.objects(1, seen_by=seen_by)
        for i in range(begun, len(scene.who)):
            scene.who[i] = k
    return scene.strays(10)


@pytest.mark.parametrize("detected", [0.6, 0.75, 0.9, 0.98])
def test_the_probability_of_detection_is_estimated(detected):
    found = [solve(partly_seen(seed, 6, detected).samples()).detected for seed in range(3)]
    # 3 runs of 6 sensors and 30 objects: 540 looks, and a prior of ten per sensor.
    assert np.mean(found) == pytest.approx(detected, abs=0.05)


def test_a_sensor_that_misses_more_than_the_others_is_recognised():
    detected = np.array([0.95, 0.95, 0.95, 0.95, 0.95, 0.4])
    found = np.mean(
        [solve(partly_seen(s, 6, detected).samples()).detected for s in range(3)], axis=0
    )
    assert found[5] < 0.65
    assert (found[:5] > 0.85).all()


@pytest.mark.parametrize("detected", [0.6, 0.98])
def test_objects_are_found_whatever_the_probability_of_detection(detected):
    scene = partly_seen(7, 8, detected)
    precision, recall = judge(scene, solve(scene.samples()))
    assert precision > 0.99
    assert recall > 0.97


def test_without_groups_the_prior_is_unchanged():
    groups = solve(Scene(1, 4).strays(3).samples())
    assert groups.detected == pytest.approx(0.9)


def test_many_sensors_leave_few_strays_and_no_ghosts():
    scene = Scene(5, 12, times=np.array([0.0])).objects(40, spread_km=150.0).strays(300)
    groups = solve(scene.samples())
    who = np.array(scene.who)
    own = [who[groups.group == g] for g in range(len(groups.score))]
    large = [members for members in own if len(members) >= 3]
    assert len({int(np.bincount(members[members >= 0]).argmax()) for members in large}) == 40
    assert len(large) == 40
    assert sum((members != members[0]).any() for members in large) <= 2


def test_a_single_tracklet_tells_nothing_of_the_usual_rates_of_its_sensor():
    chance = chance_of(Scene(1, 3).objects(1).samples(), 1e5, 0.9)
    np.testing.assert_allclose(chance.spread, USUAL_SPREAD)
    np.testing.assert_allclose(chance.drift, 0.0)


def test_many_tracklets_that_move_alike_have_a_narrow_spread():
    chance = chance_of(Scene(1, 3).objects(20).samples(), 1e5, 0.9)
    assert (chance.spread < 20 * ARCSEC).all()
    of_objects = np.linalg.norm(chance.drift, axis=1)
    assert (of_objects > 5 * ARCSEC).all()


@pytest.mark.parametrize("n_sensors", [8, 32, 128])
def test_a_passage_is_found_whatever_sensors_look_elsewhere(n_sensors):
    """With the odds that it has without them, but for what their tracklets tell of usual motion."""
    for seed in range(10):
        alone, among = (solve(passages(seed, n), min_log_odds=0.5) for n in (2, n_sensors))
        assert (alone.group == 0).all()
        assert (among.group[:2] == among.group[0]).all()
        assert among.score[among.group[0]] == pytest.approx(alone.score[0], abs=1.5)


@pytest.mark.parametrize("times", [(0.0,), (0.0, 7.0, 30.0)])
@pytest.mark.parametrize("seed", range(5))
def test_densities_drifts_and_spreads_are_those_of_counting_tracklet_by_tracklet(seed, times):
    scene = ten_tracklets(seed, n_strays=seed, n_objects=1, times=times, seen=0.6)
    samples, n_sensors = scene.samples, 5  # the last one has no tracklet
    field = np.vstack([samples.half_field, [0.02, 0.03]])
    if seed == 4:  # instants without any tracklet do not count
        samples = samples._replace(
            time_s=np.append(samples.time_s, 50.0),
            seen=np.column_stack([samples.seen, np.zeros(len(scene.who), bool)]),
            u=np.concatenate([samples.u, samples.u[:, :1]], axis=1),
        )
    samples = samples._replace(half_field=field)
    chance = chance_of(samples, 2e4, 0.8)
    counts, solid = [], []
    n_instants = sum(samples.seen[:, m].any() for m in range(samples.seen.shape[1]))
    for s in range(n_sensors):
        mine = [i for i in range(len(scene.who)) if samples.sensor[i] == s]
        rates, shown = [], []
        for i in mine:
            there = np.flatnonzero(samples.seen[i])
            if len(there) > 1:
                dt = samples.time_s[there[-1]] - samples.time_s[there[0]]
                rates.append((samples.u[i, there[-1]] - samples.u[i, there[0]]) / dt)
                shown.append(len(there) / n_instants)
        solid.append(solid_angle(field[s]))
        at_once = sum(samples.seen[i].sum() for i in mine) / n_instants
        assert chance.density[s] == pytest.approx(max(at_once, 1.0) / solid[s], rel=1e-6)
        n_others = max(sum(shown) - 1, 0)
        drift = np.median(rates, axis=0) * n_others / sum(shown) if n_others else np.zeros(3)
        np.testing.assert_allclose(chance.drift[s], drift, rtol=1e-9, atol=1e-15)
        squares = sum(
            n * np.sum((rate - drift) ** 2) / 2 for n, rate in zip(shown, rates, strict=True)
        )
        spread = np.sqrt((squares + (10 * ARCSEC) ** 2) / (n_others + 2))
        shrunk = (spread**n_others * USUAL_SPREAD) ** (1 / (n_others + 1))
        assert chance.spread[s] == pytest.approx(shrunk)
        counts.append(len(mine))
    seeing = np.array(counts) > 0  # those that look elsewhere tell nothing of it
    assert chance.objects_in_view == max(np.median(np.array(counts)[seeing]), 1.0)
    volume = np.median(np.array(solid)[seeing]) * 2e4**3 / 3
    assert chance.objects_km3 == pytest.approx(chance.objects_in_view / volume, rel=1e-6)
    assert chance.detected.tolist() == [0.8] * n_sensors


def solid_angle(half):
    """Return the solid angle of a rectangular field, summed over small parts of it."""
    x, y = (np.linspace(-h, h, 401)[:-1] + h / 400 for h in half)
    parts = (1 + x[:, None] ** 2 + y**2) ** -1.5
    return parts.sum() * (2 * half[0] / 400) * (2 * half[1] / 400)
