"""Grouping: the tracklets of an object become one, and those of others do not join it."""

import numpy as np
import pytest
from scenes.orbit_tracklets import orbit_tracklets

from epipole.tasks.algorithms.orbit_linking import grouping
from epipole.tasks.algorithms.orbit_linking.arc_fit import Tracklets
from epipole.tasks.algorithms.orbit_linking.grouping import link_tracklets
from epipole.tasks.algorithms.orbit_linking.population import log_attributable_density
from epipole.tasks.algorithms.orbits.orbit_fit import propagate

NONE = -1


def linked(scene, known=None, log_odds=7.0):
    known = np.full(len(scene.object), NONE) if known is None else known
    return link_tracklets(scene.tracklets, known, max_gap_s=900.0, log_odds=log_odds).label


def linked_over_hours(tracklets, known):
    return link_tracklets(
        tracklets, known, max_gap_s=900.0, log_odds=7.0, max_orbit_gap_s=10_800.0
    ).label


def wrong(label, number):
    """Return how many tracklets are in a group that mostly belongs to another object."""
    return sum(
        (number[label == each] != np.bincount(number[label == each]).argmax()).sum()
        for each in np.unique(label)
    )


def test_objects_of_three_tracklets_are_joined_and_none_is_wrong():
    scene = orbit_tracklets(1, 200, 3, 100.0)
    label = linked(scene)
    assert wrong(label, scene.object) == 0
    whole = [len(np.unique(label[scene.object == k])) == 1 for k in range(200)]
    assert np.mean(whole) > 0.95


def test_rough_tracklets_stay_alone_rather_than_join_others():
    scene = orbit_tracklets(2, 200, 2, 100.0, direction_arcsec=20.0, rate_arcsec_s=100.0)
    label = linked(scene)
    assert wrong(label, scene.object) == 0
    assert len(np.unique(label)) > 250


def test_tracklets_that_say_little_in_pairs_are_joined_by_four(monkeypatch):
    scene = orbit_tracklets(9, 60, 4, 60.0, rate_arcsec_s=12.0)
    label = linked(scene)
    assert wrong(label, scene.object) == 0
    assert len(np.unique(label)) == 60
    monkeypatch.setattr(grouping, "LOOSE_LOG_ODDS", 99.0)
    assert len(np.unique(linked(scene))) >= 65


def test_two_tracklets_that_are_near_in_time_need_more_evidence():
    scene = orbit_tracklets(14, 150, 2, 60.0, direction_arcsec=8.0, rate_arcsec_s=12.0)
    label = linked(scene)
    assert wrong(label, scene.object) == 0
    seen, known = scene.tracklets, np.full(300, NONE)
    alone = log_attributable_density(seen.r_km, seen.v_km_s, seen.u, seen.w)
    edges = grouping._edges(seen, known, alone, 900.0)
    joined = label[edges.pair[:, 0]] == label[edges.pair[:, 1]]
    assert joined.sum() > 20
    assert edges.odds[joined].min() > 9.0 - 0.1
    assert (edges.odds[~joined] > 7.0).sum() > 5


def test_loosely_joined_pairs_are_released():
    scene = orbit_tracklets(2, 60, 2, 100.0, direction_arcsec=20.0, rate_arcsec_s=100.0)
    for known in (None, np.arange(120)):  # an object of one tracklet is released as well
        label = linked(scene, known, log_odds=1e6)
        np.testing.assert_array_equal(label, np.arange(120))


def test_a_known_object_takes_its_tracklets():
    scene = orbit_tracklets(3, 30, 4, 60.0)
    first = np.unique(scene.object, return_index=True)[1]
    second = [np.flatnonzero(scene.object == k)[1] for k in range(30)]
    known = np.full(len(scene.object), NONE)
    known[first] = known[second] = np.arange(30)
    label = linked(scene, known)
    assert wrong(label, scene.object) == 0
    assert all(label[a] == label[b] for a, b in zip(first, second, strict=True))
    assert len(np.unique(label)) <= 32


def test_known_objects_that_are_two_take_no_tracklets():
    scene = orbit_tracklets(4, 2, 4, 60.0)
    known = np.where(np.arange(8) < 4, 0, NONE)  # of both
    assert len(np.unique(scene.object[:4])) == 2
    label = linked(scene, known)
    assert (label[:4] == 0).all()
    assert (label[4:] != 0).all()


def test_no_object_has_two_tracklets_of_one_sensor_at_a_time():
    scene = orbit_tracklets(5, 40, 3, 60.0)
    seen = scene.tracklets
    one = seen._replace(sensor=np.zeros_like(seen.sensor), last_s=seen.last_s + 1e3)
    assert len(np.unique(linked(scene._replace(tracklets=one)))) == len(scene.object)


def test_groups_do_not_depend_on_tracklets_elsewhere():
    scene = orbit_tracklets(6, 60, 3, 60.0)
    label = linked(scene)
    kept = np.flatnonzero(scene.object < 30)
    part = scene._replace(
        tracklets=Tracklets(*(column[kept] for column in scene.tracklets)),
        object=scene.object[kept],
    )
    np.testing.assert_array_equal(kept[linked(part)], label[kept])


def test_an_object_is_found_again_after_hours():
    scene = orbit_tracklets(11, 40, 6, 100.0, pause_s=5400.0)
    known = np.full(len(scene.object), NONE)
    given = {"max_gap_s": 900.0, "log_odds": 9.0}
    apart = link_tracklets(scene.tracklets, known, **given).label
    joined = link_tracklets(scene.tracklets, known, **given, max_orbit_gap_s=7200.0).label
    assert len(np.unique(apart)) >= 80
    assert wrong(joined, scene.object) == 0
    assert len(np.unique(joined)) <= 42
    shorter = link_tracklets(scene.tracklets, known, **given, max_orbit_gap_s=3600.0).label
    np.testing.assert_array_equal(shorter, apart)


def test_pairs_half_an_hour_apart_are_joined():
    scene = orbit_tracklets(12, 60, 2, 2000.0, rate_arcsec_s=0.3)
    known = np.full(len(scene.object), NONE)
    near, far = (
        link_tracklets(scene.tracklets, known, max_gap_s=gap_s, log_odds=7.0).label
        for gap_s in (300.0, 2400.0)
    )
    assert wrong(far, scene.object) == 0
    assert len(np.unique(far)) < 85 < 110 < len(np.unique(near))


@pytest.mark.parametrize("first", [True, False])
def test_a_single_tracklet_joins_an_orbit_hours_away(first):
    scene = orbit_tracklets(13, 40, 4, 200.0, rate_arcsec_s=0.3, pause_s=6000.0)
    order = np.argsort(scene.object, kind="stable").reshape(40, 4)
    kept = np.sort(order[:, [0, 2, 3] if first else [0, 1, 2]].ravel())
    seen = Tracklets(*(column[kept] for column in scene.tracklets))
    number, known = scene.object[kept], np.full(len(kept), NONE)
    apart = link_tracklets(seen, known, max_gap_s=900.0, log_odds=7.0).label
    joined = linked_over_hours(seen, known)
    assert wrong(joined, number) == 0
    whole = [len(np.unique(joined[number == k])) == 1 for k in range(40)]
    assert sum(whole) >= 30
    assert not any(len(np.unique(apart[number == k])) == 1 for k in range(40))


def test_a_single_tracklet_joins_a_known_object_hours_before():
    scene = orbit_tracklets(13, 20, 4, 200.0, rate_arcsec_s=0.3, pause_s=6000.0)
    order = np.argsort(scene.object, kind="stable").reshape(20, 4)
    kept = np.sort(order[:, :3].ravel())
    seen = Tracklets(*(column[kept] for column in scene.tracklets))
    number = scene.object[kept]
    known = np.full(len(kept), NONE)
    known[np.isin(kept, order[:, :2])] = number[np.isin(kept, order[:, :2])]
    for objects in (known, np.full(len(kept), NONE)):
        label = linked_over_hours(seen, objects)
        assert wrong(label, number) == 0
        assert sum(len(np.unique(label[number == k])) == 1 for k in range(20)) >= 15


def test_no_tracklets_no_groups():
    scene = orbit_tracklets(7, 1, 1, 1.0)
    empty = Tracklets(*(column[:0] for column in scene.tracklets))
    found = link_tracklets(empty, np.zeros(0, np.int64), max_gap_s=10.0, log_odds=5.0)
    assert len(found.label) == len(found.epoch_s) == 0


def test_the_orbit_of_an_object_is_near_the_true_one():
    scene = orbit_tracklets(8, 20, 4, 60.0)
    found = link_tracklets(scene.tracklets, np.full(80, NONE), max_gap_s=900.0, log_odds=7.0)
    for number in range(20):
        rows = np.flatnonzero(scene.object == number)
        root = found.label[rows[0]]
        dt_s = scene.tracklets.time_s[rows[0]] - found.epoch_s[root]
        state = propagate(found.state[root], dt_s)
        assert np.linalg.norm(state[:3] - scene.state[rows[0], :3]) < 5.0


def of_two_times(seed, n_objects, kept):
    """Return tracklets of the objects, some of six each: three after a pause of 90 minutes; their
    objects; and the known object of each, that of the first two."""
    scene = orbit_tracklets(
        seed, n_objects, 6, 100.0, direction_arcsec=8.0, rate_arcsec_s=6.0, pause_s=5400.0
    )
    of_object = np.argsort(scene.object, kind="stable").reshape(n_objects, 6)
    rows = np.sort(of_object[:, kept].ravel())
    known = np.where(np.isin(rows, of_object[:, :2]), scene.object[rows], NONE)
    tracklets = Tracklets(*(np.ascontiguousarray(column[rows]) for column in scene.tracklets))
    return tracklets, scene.object[rows], known


@pytest.mark.parametrize("kept", [[0, 3, 4, 5], [0, 1, 3, 4, 5]])
def test_an_object_of_one_or_two_tracklets_is_found_again_hours_later(kept):
    found = 0
    for seed in (60, 61):
        tracklets, number, known = of_two_times(seed, 25, kept)
        label = linked_over_hours(tracklets, known)
        assert wrong(label, number) == 0
        of_object = np.argsort(number, kind="stable").reshape(25, -1)
        found += sum(label[rows[0]] == label[rows[-1]] for rows in of_object)
    assert found > (25 if len(kept) == 4 else 40)


@pytest.mark.parametrize("seed", [60, 61, 62])
def test_known_objects_stay_whole_where_a_rough_tracklet_joins_and_leaves(seed):
    """The third tracklet of each says little of its rates."""
    tracklets, number, known = of_two_times(seed, 25, [0, 1, 2, 3, 4, 5])
    rough = np.argsort(number, kind="stable").reshape(25, 6)[:, 2]
    rad_s = 200 * np.pi / 648_000
    error = np.random.default_rng(seed).normal(0, rad_s, (25, 2, 1))
    tracklets.w[rough] += error[:, 0] * tracklets.east[rough] + error[:, 1] * tracklets.north[rough]
    tracklets.cov[rough, [[2], [3]], [[2], [3]]] += rad_s**2
    label = linked_over_hours(tracklets, known)
    assert wrong(label, number) == 0
    for k in range(25):
        assert len(np.unique(label[known == k])) == 1
