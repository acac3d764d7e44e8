"""Chance: how unrelated tracklets behave is estimated from the data, and not from too few."""

import numpy as np
import pytest
from scenes.passages import passages
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


def test_a_passage_is_found_among_sensors_that_look_elsewhere():
    """Not so for any number of them: what they do not see in common makes objects seem fewer."""

    def found(n):
        groups = [solve(passages(seed, n)).group for seed in range(10)]
        return {k for k, group in enumerate(groups) if group[0] == group[1] >= 0}

    alone = found(2)
    assert len(alone) >= 8
    assert alone <= found(8)
    assert len(alone & found(32)) >= len(alone) - 1
