"""Groups of windows: what half a minute leaves open is judged over ten."""

import numpy as np
import pytest
from scenes.associations import associated, wrong_views
from scenes.tracklet_scenes import Scene

from epipole.tasks.algorithms.association.samples import Groups
from epipole.tasks.algorithms.association.window_groups import Items, WindowGroups

EVERY_S = 6.0
BRIEFLY_S = 7.5


def ten_minutes(seed: int) -> Scene:
    scene = Scene(seed, 2, times=np.arange(3.0, 600.0, EVERY_S))
    return scene.objects(10).strays(100)


def entered(score: float, tracklets=(0, 1)) -> WindowGroups:
    """Two tracklets of two sensors, five windows of 30 s: one group in the first window.

    Their views are 10 s apart.
    """
    window, tracklet = np.repeat(np.arange(5), 2), np.tile([0, 1], 5)
    first_ns = window * 30_000_000_000
    items = Items(window, tracklet, tracklet, first_ns, first_ns + 20_000_000_000, np.full(10, 3))
    verdicts = WindowGroups(items)
    verdicts.enter(np.flatnonzero(items.window == 0), np.array(tracklets), group_of(2, score))
    return verdicts


def group_of(n: int, *score: float) -> Groups:
    member = np.zeros(n, np.int64) if score else np.full(n, -1)
    none = np.zeros(n, bool)
    return Groups(member, np.array(score), none, none, np.full(2, np.nan))


@pytest.mark.parametrize("seed", [1, 2])
def test_two_sensors_find_over_ten_minutes_what_they_cannot_in_half_a_minute(seed):
    scene = ten_minutes(seed)
    short, long = associated(scene, max_window_s=0.0), associated(scene)
    assert wrong_views(scene, long) == 0
    everything = 10 * 2 * len(scene.times)
    assert long.views.num_rows > short.views.num_rows
    assert long.views.num_rows >= 0.97 * everything


def test_a_span_of_ten_minutes_by_settings_is_judged_once():
    scene = ten_minutes(3)
    once = associated(scene, window_s=600.0)
    again = associated(scene, window_s=600.0, max_window_s=0.0)
    assert once.views.equals(again.views)


def test_a_sure_group_is_not_judged_again_where_it_is_sure():
    verdicts = entered(score=9.0)
    rows = verdicts.to_decide_again(np.arange(10), 30.0)
    assert verdicts.items.window[rows].tolist() == [1, 1, 2, 2, 3, 3, 4, 4]
    unsure = entered(score=3.0).to_decide_again(np.arange(10), 30.0)
    assert len(unsure) == 10


def test_a_sure_group_that_is_doubted_is_judged_again():
    verdicts = entered(score=9.0)
    verdicts.doubt(np.arange(10))
    assert len(verdicts.to_decide_again(np.arange(10), 30.0)) == 10


def test_tracklets_that_do_not_continue_keep_their_verdict():
    assert not len(entered(score=3.0).to_decide_again(np.arange(4), 30.0))  # 50 s < 2 x 30 s


def test_longer_evidence_against_a_group_dissolves_it():
    verdicts = entered(score=3.0)
    rows = np.arange(10)
    assert (verdicts.group[:2] == 0).all()
    verdicts.reconsider(rows, verdicts.to_decide_again(rows, 30.0), np.array([0, 1]), group_of(2))
    assert (verdicts.group == -1).all()


def test_what_longer_evidence_adds_to_a_sure_group_joins_it():
    verdicts = entered(score=9.0, tracklets=(0, 2))
    # In the first window tracklet 0 is in a sure group and 1 in none; over 150 s they are one.
    rows = np.arange(10)
    again = verdicts.to_decide_again(rows, 30.0)
    first = again[verdicts.items.window[again] == 0]
    assert verdicts.items.tracklet[first].tolist() == [1]
    verdicts.reconsider(rows, again, np.array([0, 1]), group_of(2, 12.0))
    assert (verdicts.group[verdicts.items.window == 0] == verdicts.group[0]).all()
    assert len(np.unique(verdicts.group[verdicts.items.window > 0])) == 1


def test_groups_of_no_tracklets_change_nothing():
    verdicts = entered(score=9.0)
    before = verdicts.group.copy()
    verdicts.enter(np.arange(10), np.zeros(0, np.int64), group_of(0))
    assert (verdicts.group == before).all()


@pytest.mark.parametrize(
    ("score", "undecided", "allowed", "continues"),
    [
        (9.0, [0, 1], [0, 1], True),
        (3.0, [0, 1], [0, 1], False),  # the group was not certain
        (9.0, [0], [0, 1], False),  # tracklet 1 is decided: it belongs to no object there
        (9.0, [0, 1], [0], False),
    ],
)
def test_a_sure_group_goes_on_where_its_tracklets_end(score, undecided, allowed, continues):
    verdicts = entered(score)
    verdicts.undecided[2:] = np.isin(verdicts.items.tracklet[2:], undecided)
    verdicts.continue_groups(np.isin(verdicts.items.tracklet, allowed), BRIEFLY_S)
    assert (verdicts.group[2] == verdicts.group[3] != -1) == continues
    assert (verdicts.group[4:] == -1).all()
    assert verdicts.undecided[2:4].any() != continues or not undecided


@pytest.mark.parametrize(("brief", "continues"), [([0], True), ([0, 1], True), ([], False)])
def test_an_unsure_group_goes_on_where_its_tracklets_are_seen_briefly(brief, continues):
    verdicts = entered(score=3.0)
    items = verdicts.items
    items.last_ns[2:4] -= np.where(np.isin([0, 1], brief), 15_000_000_000, 0)
    verdicts.ambiguous[2] = True
    verdicts.continue_groups(np.ones(10, bool), BRIEFLY_S)
    assert (verdicts.group[2] == verdicts.group[3] != -1) == continues
    assert verdicts.ambiguous[2] != continues
    assert (verdicts.group[4:] == -1).all()


@pytest.mark.parametrize("sensors", [(0, 1, 2), (0, 1, 0)])
def test_a_tracklet_seen_briefly_joins_what_the_others_of_its_group_are_in(sensors):
    # Tracklets 0 and 1 are one object in the first window, 1 and 2 in the second.
    window, tracklet = np.repeat([0, 1], 3), np.tile([0, 1, 2], 2)
    first_ns = window * 30_000_000_000
    last_ns = first_ns + np.where((tracklet == 0) & (window == 1), 4, 20) * 1_000_000_000
    items = Items(window, tracklet, np.tile(sensors, 2), first_ns, last_ns, np.full(6, 3))
    verdicts = WindowGroups(items)
    verdicts.enter(np.array([0, 1]), np.array([0, 1]), group_of(2, 3.0))
    verdicts.enter(np.array([4, 5]), np.array([1, 2]), group_of(2, 3.0))
    verdicts.continue_groups(np.ones(6, bool), BRIEFLY_S)
    # Its sensor has one tracklet of an object.
    joins = sensors[2] != sensors[0]
    assert (verdicts.group[3:] == verdicts.group[4]).tolist() == [joins, True, True]
    assert verdicts.group[2] == -1


def test_a_sure_group_does_not_change_another_one_in_the_next_window():
    verdicts = entered(score=9.0)
    verdicts.enter(np.array([3]), np.array([1]), group_of(1, 5.0))
    verdicts.undecided[2] = True
    before = verdicts.group.copy()
    verdicts.continue_groups(np.ones(10, bool), BRIEFLY_S)
    assert (verdicts.group == before).all()


def test_without_items_nothing_goes_on():
    verdicts = WindowGroups(Items(*np.zeros((6, 0), np.int64)))
    verdicts.continue_groups(np.zeros(0, bool), BRIEFLY_S)
    assert not len(verdicts.group)


@pytest.mark.parametrize(
    ("brief", "state", "doubted"),
    [
        ([], None, True),
        ([1], None, False),  # seen for 4 s there: too short to fit
        ([], "undecided", False),  # they fit there, with too little evidence
        ([], "ambiguous", False),
    ],
)
def test_a_group_of_two_that_fits_no_object_in_another_window_is_contradicted(
    brief, state, doubted
):
    verdicts = entered(score=20.0)
    items = verdicts.items
    items.last_ns[2:] -= np.where(np.isin(items.tracklet[2:], brief), 16_000_000_000, 0)
    if state:
        getattr(verdicts, state)[2:] = True
    every = np.ones(10, bool)
    assert verdicts.contradicted(every, BRIEFLY_S).tolist() == ([0, 1] if doubted else [])


def test_windows_in_which_a_sensor_is_left_out_contradict_none_of_its_groups():
    verdicts = entered(score=20.0)
    left_out = (verdicts.items.sensor == 1) & (verdicts.items.window > 0)
    assert not len(verdicts.contradicted(~left_out, BRIEFLY_S))
    left_out &= verdicts.items.window > 1
    assert verdicts.contradicted(~left_out, BRIEFLY_S).tolist() == [0, 1]


def test_groups_of_three_are_not_contradicted():
    window, tracklet = np.repeat([0, 1], 3), np.tile([0, 1, 2], 2)
    first_ns = window * 30_000_000_000
    items = Items(window, tracklet, tracklet, first_ns, first_ns + 20_000_000_000, np.full(6, 3))
    verdicts = WindowGroups(items)
    verdicts.enter(np.arange(3), np.arange(3), group_of(3, 20.0))
    assert not len(verdicts.contradicted(np.ones(6, bool), BRIEFLY_S))


def test_what_is_withdrawn_is_undecided():
    verdicts = entered(score=20.0)
    verdicts.withdraw(np.arange(2))
    assert (verdicts.group == -1).all()
    assert verdicts.undecided.tolist() == [True, True] + [False] * 8
