"""Detection: the probability of detection is estimated from the groups themselves."""

import numpy as np
import pytest
from scenes.tracklet_scenes import Scene, judge, solve


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
