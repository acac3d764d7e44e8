"""Suspects: of many sensors the wrong ones are found, as if all were judged together."""

import numpy as np
import pytest
from scenes.many_sensors import POSITION_KM, lines_of_many
from scenes.tracklet_scenes import GEO, Scene, solve

from epipole.tasks.algorithms.association.samples import FREE, Groups
from epipole.tasks.algorithms.sensor_faults.fault_judgement import (
    CLOCK,
    DISAGREES,
    EPHEMERIS,
    SOUND,
    judge_sensors,
)
from epipole.tasks.algorithms.sensor_faults.suspects import (
    MAX_TOGETHER,
    agreement,
    judge_many_sensors,
)


def judged(lines, n_sensors, judge=judge_many_sensors, guess_s=None):
    guess = np.zeros(n_sensors) if guess_s is None else guess_s
    return judge(lines, np.full(n_sensors, POSITION_KM), np.zeros(n_sensors), guess)


def faults(found):
    return {s: cause for s, cause in enumerate(found.cause) if cause != SOUND}


def test_few_sensors_are_judged_together():
    lines = lines_of_many(1, 6, 60, late_s={2: 0.4})
    for one, other in zip(judged(lines, 6), judged(lines, 6, judge_sensors), strict=True):
        np.testing.assert_array_equal(one, other)


def test_the_faults_of_many_are_those_that_all_together_have():
    n = MAX_TOGETHER + 6
    lines = lines_of_many(2, n, 300, late_s={3: 0.3}, off_km={7: 1.5})
    many, together = judged(lines, n), judged(lines, n, judge_sensors)
    assert faults(many) == faults(together) == {3: CLOCK, 7: EPHEMERIS}
    apart = np.abs(many.offset_s - together.offset_s)
    assert (apart < 0.5 * together.sigma_s).all()
    assert abs(many.offset_s[3] - 0.3) < 4 * many.sigma_s[3]


@pytest.mark.parametrize("more", [1, 2, 3])
def test_faults_that_were_found_stay_where_few_other_sensors_are_left(more):
    n = MAX_TOGETHER + more
    found = judged(lines_of_many(2, n, 150, late_s={3: 0.8, 7: 0.8, 11: 0.8}), n)
    assert faults(found) == {3: CLOCK, 7: CLOCK, 11: CLOCK}
    assert np.isfinite(found.offset_s).all()


def test_two_of_many_of_which_one_is_wrong_disagree_both():
    lines = lines_of_many(4, 8, 400, off_km={1: 8.0})
    # These two see objects with each other alone.
    pair = np.isin(lines.sensor, [0, 1])
    kept = np.where(lines.group % 2 == 0, pair, ~pair)
    found = judged(lines._replace(**{n: getattr(lines, n)[kept] for n in lines._fields}), 8)
    assert faults(found) == {0: DISAGREES, 1: DISAGREES}
    assert not found.doubt.undecided


def with_pairs(n_sound, n_pairs, n_groups):
    """Return lines of sensors that agree, and of pairs that see objects with each other alone, of
    each of which one is wrong."""
    n = n_sound + 2 * n_pairs
    off_km = {n_sound + 2 * k: 8.0 for k in range(n_pairs)}
    lines = lines_of_many(3, n, n_groups, off_km=off_km, seen_share=0.7)
    of_pair = np.where(lines.sensor < n_sound, -1, (lines.sensor - n_sound) // 2)
    turn = np.where(lines.group % 2 == 0, -1, lines.group // 2 % n_pairs)
    kept = of_pair == turn  # those that agree have the even groups
    return lines._replace(**{name: getattr(lines, name)[kept] for name in lines._fields})


@pytest.mark.parametrize("n_pairs", [5, 8])
def test_pairs_of_which_one_is_wrong_disagree_where_many_others_agree(n_pairs):
    """Nearly all that are judged together are of such pairs."""
    n = MAX_TOGETHER + 2 * n_pairs
    found = judged(with_pairs(MAX_TOGETHER, n_pairs, 600), n)
    assert faults(found) == dict.fromkeys(range(MAX_TOGETHER, n), DISAGREES)
    assert not found.doubt.undecided


def test_it_is_undecided_who_is_wrong_where_fewer_agree_than_not():
    """Of the sensors with the most lines more agree than not: the pairs have few."""
    n_sound, n_pairs = 13, 9
    found = judged(with_pairs(n_sound, n_pairs, 700), n_sound + 2 * n_pairs)
    assert faults(found) == {}
    assert found.doubt.undecided


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_of_four_that_see_no_others_two_are_wrong_alike_and_all_four_disagree(seed):
    """The errors of either two explain the lines as well; no single step leads from one set of
    faults to the other."""
    n = 10
    lines = lines_of_many(seed, n, 600, off_km={0: 8.0, 1: 8.0}, seen_share=0.7)
    of_four = lines.sensor < 4
    kept = np.where(lines.group % 2 == 0, of_four, ~of_four)
    lines = lines._replace(**{name: getattr(lines, name)[kept] for name in lines._fields})
    found = judged(lines, n)
    assert faults(found) == dict.fromkeys(range(4), DISAGREES)
    assert not found.doubt.undecided


def test_of_eight_four_are_wrong_alike_and_it_is_undecided_which():
    found = judged(lines_of_many(1, 8, 200, off_km=dict.fromkeys(range(4), 8.0)), 8)
    assert faults(found) == {}
    assert found.doubt.undecided


@pytest.mark.long
def test_of_a_hundred_sensors_no_sound_one_is_at_fault_and_offsets_are_honest():
    scores = []
    for seed in range(8):
        lines = lines_of_many(10 + seed, 100, 250, late_s={50: 0.5})
        found = judged(lines, 100)
        assert faults(found) == {50: CLOCK}
        scores.append(np.delete(found.offset_s / found.sigma_s, 50))
    assert 0.8 < np.sqrt(np.mean(np.square(scores))) < 1.2


@pytest.mark.long
def test_more_wrong_sensors_than_are_judged_together_are_all_found():
    late = dict.fromkeys(range(MAX_TOGETHER + 3), 0.6)
    found = judged(lines_of_many(20, 120, 400, late_s=late), 120)
    assert faults(found) == dict.fromkeys(late, CLOCK)


def test_a_sensor_without_lines_has_no_offset():
    lines = lines_of_many(30, 40, 50)
    few = lines._replace(
        **{name: getattr(lines, name)[lines.sensor != 5] for name in lines._fields}
    )
    found = judged(few, 40)
    assert np.isnan(found.offset_s[5])
    assert found.cause[5] == SOUND


def turned(scene, sensor, angle_rad):
    """Return the scene with all directions of one sensor rotated a little."""
    axis = np.cross(GEO, [0.0, 0.0, 1.0])
    axis /= np.linalg.norm(axis)
    for i, s in enumerate(scene.sensor):
        if s == sensor:
            u = scene.u[i] + np.cross(axis, scene.u[i]) * angle_rad
            scene.u[i] = u / np.linalg.norm(u, axis=1, keepdims=True)
    return scene


@pytest.mark.parametrize("wrong", [0, 3])
def test_a_sensor_whose_attitude_is_wrong_is_found(wrong):
    scene = turned(Scene(1, 4).objects(8, spread_km=100.0).strays(1), wrong, np.radians(0.1))
    samples = scene.samples()
    assert agreement(samples, solve(samples)).disagreeing().tolist() == [wrong]


def test_two_sensors_that_agree_with_each_other_only_are_found():
    """What both see is 60 km off for both, so that their lines of sight meet, at nothing."""
    scene = Scene(1, 5).objects(8, spread_km=50.0)
    for i, sensor in enumerate(scene.sensor):
        if sensor in (2, 4):
            range_km = np.linalg.norm(scene.r[sensor] - GEO, axis=1)[:, None]
            u = scene.u[i] * range_km + np.array([40.0, 30.0, 35.0])
            scene.u[i] = u / np.linalg.norm(u, axis=1, keepdims=True)
    samples = scene.samples()
    of_both = np.isin(samples.sensor, [2, 4])
    group = np.array(scene.who) + 8 * of_both
    nothing = np.full(len(group), False)
    groups = Groups(group, np.full(16, 9.0), nothing, nothing, np.full(5, 0.9))
    assert agreement(samples, groups).disagreeing().tolist() == [2, 4]
    alone = groups._replace(group=np.where(of_both, FREE, group), score=groups.score[:8])
    assert agreement(samples, alone).disagreeing().tolist() == [2, 4]


def test_sound_sensors_are_left_alone():
    samples = Scene(2, 4).objects(8, spread_km=100.0).strays(10).samples()
    found = agreement(samples, solve(samples))
    assert found.disagreeing().tolist() == []
    assert (found.n_joined >= 0.9 * found.n_in_field).all()


def test_a_sensor_without_detections_is_not_at_fault():
    scene = Scene(3, 4).objects(8, spread_km=100.0, seen_by=[0, 1, 2])
    samples = scene.samples()
    found = agreement(samples, solve(samples))
    assert found.n_in_field[3] >= 5
    assert found.n_joined[3] == 0
    assert found.disagreeing().tolist() == []


def test_without_groups_no_sensor_is_judged():
    samples = Scene(4, 3).strays(3).samples()
    found = agreement(samples, solve(samples))
    assert found.disagreeing().tolist() == []


def test_a_sensor_whose_tracklets_may_be_of_the_objects_does_not_disagree():
    """In a short window they are often undecided."""
    samples = Scene(6, 4).objects(8, spread_km=100.0).samples()
    groups = solve(samples)
    groups = groups._replace(group=np.where(samples.sensor == 3, FREE, groups.group))
    assert agreement(samples, groups).disagreeing().tolist() == [3]
    found = agreement(samples, groups._replace(undecided=samples.sensor == 3))
    assert found.n_unassigned[3] == 8
    assert found.n_joined[3] == found.n_in_field[3] == 8
    assert found.disagreeing().tolist() == []


@pytest.mark.parametrize(("faintest", "disagreeing"), [(12.5, []), (14.0, [3])])
def test_an_object_too_faint_for_a_sensor_is_not_missed(faintest, disagreeing):
    scene = Scene(7, 4).objects(8, spread_km=100.0, seen_by=[0, 1, 2]).strays(9, sensors=[3])
    samples = scene.samples()
    magnitude = np.where(samples.sensor == 3, faintest - np.arange(len(samples.sensor)) % 3, 12.0)
    found = agreement(samples._replace(magnitude=magnitude), solve(samples))
    assert found.disagreeing().tolist() == disagreeing


def test_without_magnitudes_a_much_nearer_sensor_sees_more():
    scene = Scene(8, 4).objects(8, spread_km=100.0, seen_by=[0, 1, 2]).strays(9, sensors=[3])
    samples = scene.samples()
    groups = solve(samples)
    assert agreement(samples, groups).disagreeing().tolist() == [3]
    away = GEO - scene.r[3]
    r = samples.sensor_km.copy()
    r[3] -= away  # twice as far
    far = samples._replace(sensor_km=r, magnitude=np.full(len(samples.sensor), np.nan))
    assert agreement(far, groups).disagreeing().tolist() == []
