"""Association: tracklets of one object are grouped, others are free or ambiguous."""

import numpy as np
import pytest
from scenes.light_time import light_time_samples
from scenes.passages import passages
from scenes.tracklet_scenes import GEO, V_GEO, Scene, judge, pairs, solve

from epipole.tasks.algorithms.association.samples import Samples
from epipole.tasks.algorithms.constants import ARCSEC


@pytest.mark.parametrize("n_sensors", [3, 4, 8])
def test_objects_are_found_among_strays(n_sensors):
    scene = Scene(n_sensors, n_sensors).objects(20).strays(20)
    precision, recall = judge(scene, solve(scene.samples()))
    assert precision > 0.995
    assert recall > 0.97


@pytest.mark.parametrize("n_sensors", [8, 16])
@pytest.mark.parametrize("seed", range(4))
def test_an_object_in_the_corners_of_two_fields_only_is_found_among_many_sensors(seed, n_sensors):
    """The pairs of sensors that seed what all see may not cover these corners."""
    scene, path, sees = in_two_corners(seed, n_sensors)
    for s in sees:
        scene.add(s, 99, path[s] / np.linalg.norm(path[s], axis=1, keepdims=True))
    group = solve(scene.samples()).group[np.array(scene.who) == 99]
    assert group[0] == group[1] >= 0


def in_two_corners(seed, n_sensors):
    """Return a scene of objects, a path 1.2 degrees from their middle as each sensor sees it, and
    the two sensors that have it in their field."""
    for again in range(200):
        scene = Scene(1000 * seed + again, n_sensors).objects(12, spread_km=400.0)
        off = scene.rng.normal(size=3)
        off -= off @ GEO / (GEO @ GEO) * GEO
        start = GEO + np.radians(1.2) * 35500.0 * off / np.linalg.norm(off)
        path = start + scene.times[:, None] * V_GEO - scene.r
        samples = scene.samples()
        seen = np.einsum("skij,skj->ski", samples.R_sensor_from_icrs, path)
        edge = 0.98 * samples.half_field[:, None] * seen[..., 2:]
        sees = np.flatnonzero((np.abs(seen[..., :2]) < edge).all(axis=(1, 2)))
        if len(sees) == 2:
            return scene, path, sees
    raise AssertionError("no such scene")


def test_two_sensors_suffice_where_strays_are_few():
    scene = Scene(1, 2).objects(5).strays(2)
    precision, recall = judge(scene, solve(scene.samples()))
    assert precision == 1.0
    assert recall >= 0.8


def test_two_sensors_at_one_instant_in_dense_clutter_report_few_wrong_groups():
    scene = Scene(2, 2, times=np.array([0.0])).objects(5).strays(200)
    groups = solve(scene.samples())
    wrong = pairs(groups.group) - pairs(np.array(scene.who))
    assert len(wrong) <= 2


def two_in_one_epipolar_plane():
    """Two objects that both sensors see, each of whose four pairings meets at a point."""
    scene = Scene(3, 2, times=np.array([0.0]))
    baseline = scene.r[1, 0] - scene.r[0, 0]
    towards = (GEO - scene.r[0, 0]) / np.linalg.norm(GEO - scene.r[0, 0])
    across = baseline - (baseline @ towards) * towards
    across /= np.linalg.norm(across)
    for k, off in enumerate((-40.0, 40.0)):
        for s in range(2):
            path = GEO + off * across + scene.times[:, None] * V_GEO - scene.r[s]
            scene.add(s, k, path / np.linalg.norm(path, axis=1, keepdims=True))
    return scene


@pytest.mark.parametrize("magnitude", [None, [9.0, 9.1, 9.1, 9.0], [np.nan] * 4])
def test_two_objects_that_two_sensors_cannot_tell_apart_are_ambiguous(magnitude):
    samples = two_in_one_epipolar_plane().samples()
    magnitude = None if magnitude is None else np.array(magnitude)
    groups = solve(samples._replace(magnitude=magnitude))
    assert groups.ambiguous.all()
    assert (groups.group == -1).all()


def test_tracklets_that_go_to_neither_of_two_near_objects_are_ambiguous():
    """Objects 1 km apart, of which eight sensors with 4 arcsec cannot tell all tracklets."""
    n_ambiguous = n_undecided = 0
    for seed in range(3):
        scene = Scene(seed, 8, sigma_arcsec=4.0, times=np.array([15.0])).objects(8, spread_km=1.0)
        found = solve(scene.samples())
        n_ambiguous += found.ambiguous.sum()
        n_undecided += found.undecided.sum()
    assert n_ambiguous >= 40
    assert n_undecided < n_ambiguous / 4


@pytest.mark.parametrize("seen_as", [[7.0, 7.1, 9.1, 9.0], [9.1, 9.0, 7.0, 7.1]])
def test_magnitudes_tell_two_objects_apart_that_directions_do_not(seen_as):
    """The sensors are 11 degrees apart as seen from there, and agree to 0.1 mag."""
    scene = two_in_one_epipolar_plane()
    groups = solve(scene.samples()._replace(magnitude=np.array(seen_as)))
    assert pairs(groups.group) == pairs(np.array(scene.who))


@pytest.mark.parametrize("scatter", [1.5, 30.0])
@pytest.mark.parametrize("n_sensors", [3, 8])
def test_magnitudes_that_mean_nothing_lose_no_object(n_sensors, scatter):
    scene = Scene(n_sensors, n_sensors).objects(20).strays(20)
    random = np.random.default_rng(1).normal(8.0, scatter, len(scene.who))
    precision, recall = judge(scene, solve(scene.samples()._replace(magnitude=random)))
    assert precision > 0.995
    assert recall > 0.97


def test_a_magnitude_of_a_sensor_whose_position_is_unknown_at_times_does_no_harm():
    times = np.arange(5.0, 120.0, 12.0)
    scene = Scene(0, 3, times=times).objects(1)
    scene.seen[2] = times > 60
    samples = scene.samples()
    sensor_km = samples.sensor_km.copy()
    sensor_km[2, :3] = np.nan
    known = samples._replace(sensor_km=sensor_km, magnitude=np.array([9.0, 9.1, 9.0]))
    assert solve(known).group.tolist() == [0, 0, 0]


@pytest.mark.parametrize("seed", range(4))
def test_a_sensor_that_blends_two_objects_misses_neither(seed):
    """Two sensors see both apart; four others see one dot at the light of the brighter one."""
    scene = Scene(seed, 6).objects(2, spread_km=3.0)
    for i in reversed(range(len(scene.who))):
        if scene.sensor[i] >= 2 and scene.who[i] == 1:
            for rows in (scene.sensor, scene.who, scene.seen, scene.u):
                del rows[i]
    samples = scene.samples()
    seen_as_one = samples._replace(blend_rad=np.full(6, 60 * ARCSEC))
    second = np.flatnonzero(np.array(scene.who) == 1)
    assert (solve(samples).group[second] == -1).all()
    groups = solve(seen_as_one)
    assert len(set(groups.group[second])) == 1
    assert groups.group[second[0]] >= 0
    assert groups.group[second[0]] not in groups.group[np.array(scene.who) == 0]


def test_tracklets_that_fit_one_object_with_too_little_evidence_are_undecided():
    scene = Scene(2, 2, times=np.array([0.0])).objects(5).strays(200)
    groups, who = solve(scene.samples()), np.array(scene.who)
    assert not (groups.undecided & (groups.ambiguous | (groups.group >= 0))).any()
    true = np.flatnonzero(who >= 0)
    apart = true[(groups.group[true] == -1) & ~groups.ambiguous[true]]
    assert len(apart)
    assert groups.undecided[apart].all()


def test_tracklets_of_sensors_that_look_elsewhere_are_not_undecided():
    groups = solve(passages(0, 8))
    assert groups.group.tolist() == [0, 0, -1, -1, -1, -1, -1, -1]
    assert not groups.undecided.any()


def test_unrelated_tracklets_make_no_object():
    scene = Scene(4, 4).strays(20)
    groups = solve(scene.samples())
    assert (groups.group >= 0).sum() <= 4


def test_a_sensor_never_has_two_tracklets_of_one_object_at_once():
    scene = Scene(5, 4).objects(30, spread_km=5.0)
    samples = scene.samples()
    groups = solve(samples)
    for g in range(len(groups.score)):
        sensors = samples.sensor[groups.group == g]
        assert len(set(sensors.tolist())) == len(sensors)


def test_two_fragments_of_one_sensor_join_one_object():
    scene = Scene(6, 3).objects(1, seen_by=[0, 1])
    for seen in ([True, False, False], [False, False, True]):
        # The same object from the third sensor, in two pieces.
        sight = _where(scene) - scene.r[2]
        scene.add(2, 0, sight / np.linalg.norm(sight, axis=1, keepdims=True), np.array(seen))
    groups = solve(scene.samples())
    assert groups.group.tolist() == [0, 0, 0, 0]


@pytest.mark.parametrize("seed", range(6))
def test_sensors_that_follow_each_other_see_one_object(seed):
    """The first sensor sees it throughout; no instant is common to the two others."""
    times = np.arange(5.0, 120.0, 12.0)
    scene = Scene(seed, 3, times=times).objects(1)
    scene.seen[1], scene.seen[2] = times < 60, times > 60
    assert solve(scene.samples()).group.tolist() == [0, 0, 0]


def test_two_objects_on_one_line_of_sight_in_turn_are_not_one():
    times = np.arange(5.0, 120.0, 12.0)
    scene = Scene(2, 3, times=times).objects(1)
    scene.seen[1], scene.seen[2] = times < 60, times > 60
    # On the same lines of the first sensor, but 300 km nearer to it, is no orbit's way on.
    first = scene.r[0] + scene.u[0] * np.linalg.norm(GEO - scene.r[0], axis=1, keepdims=True)
    nearer = first - 300.0 * scene.u[0] - scene.r[2]
    scene.u[2] = nearer / np.linalg.norm(nearer, axis=1, keepdims=True)
    assert solve(scene.samples()).group.tolist() != [0, 0, 0]


def _where(scene):
    """The point nearest to the first two tracklets' lines, instant by instant."""
    out = []
    for k in range(len(scene.times)):
        N, b = np.zeros((3, 3)), np.zeros(3)
        for i in range(2):
            P = np.eye(3) - np.outer(scene.u[i][k], scene.u[i][k])
            N, b = N + P, b + P @ scene.r[scene.sensor[i], k]
        out.append(np.linalg.solve(N, b))
    return np.array(out)


def test_points_below_the_ground_or_behind_the_earth_are_no_objects():
    scene = Scene(7, 3)
    inside = np.array([6000.0, 0.0, 0.0])
    for s in range(3):
        path = np.tile(inside, (3, 1)) - scene.r[s]
        scene.add(s, 0, path / np.linalg.norm(path, axis=1, keepdims=True))
    assert (solve(scene.samples()).group == -1).all()
    scene = Scene(7, 3)
    scene.r[:] = -scene.r  # the Earth is now in between
    scene.objects(3)
    assert (solve(scene.samples()).group == -1).all()


def test_the_order_of_the_tracklets_does_not_matter():
    scene = Scene(8, 4).objects(10).strays(10)
    order = np.random.default_rng(0).permutation(len(scene.who))
    one, other = solve(scene.samples()), solve(scene.samples(order))
    assert pairs(one.group) == {tuple(sorted((order[i], order[j]))) for i, j in pairs(other.group)}


def test_one_sensor_alone_has_no_object():
    scene = Scene(9, 1).objects(5)
    assert (solve(scene.samples()).group == -1).all()


def test_no_tracklet_gives_no_group():
    scene = Scene(10, 2).objects(1)
    nothing = Samples(*(
        value[:0] if i < 7 else value for i, value in enumerate(scene.samples())
    ))  # fmt: skip
    groups = solve(nothing)
    assert len(groups.group) == len(groups.score) == 0


def test_sensors_at_very_different_ranges_agree_on_a_low_object():
    assert solve(light_time_samples()).group.tolist() == [0, 0, 0]
    without_rates = light_time_samples()._replace(rate=None)
    assert solve(without_rates).group.tolist() != [0, 0, 0]  # light time matters here


@pytest.mark.parametrize("seed", range(3))
def test_an_object_that_sensors_see_one_after_the_other_is_one_group(seed):
    """What two sensors see for a moment grows by those that see it later."""
    times = np.arange(0.0, 24.0, 2.0)
    scene = Scene(seed, 15, times=times).objects(1)
    early, late = times < 8.0, times >= 14.0
    for i, s in enumerate(scene.sensor):
        if s < 5:
            scene.seen[i] = early
        elif s >= 10:
            scene.seen[i] = late
    groups = solve(scene.samples())
    assert (groups.group == 0).all()


@pytest.mark.parametrize("n_sensors", [3, 7])
@pytest.mark.parametrize("seed", range(3))
def test_two_cameras_of_one_satellite_are_in_one_group(seed, n_sensors):
    """At some instants only these two see the object: their lines are parallel."""
    times = np.arange(0.0, 24.0, 2.0)
    scene = Scene(seed, n_sensors, times=times)
    scene.r[1] = scene.r[0] + 0.01
    scene.objects(5, seen_by=(0, 1, 2))
    for i, s in enumerate(scene.sensor):
        scene.seen[i] = times < 12.0 if s == 2 else times >= 0.0
    groups = solve(scene.samples())
    assert judge(scene, groups) == (1.0, 1.0)
    assert not groups.ambiguous.any()


@pytest.mark.parametrize("seed", range(3))
def test_two_cameras_of_one_satellite_find_no_object_alone(seed):
    scene = Scene(seed, 2)
    scene.r[1] = scene.r[0] + 0.01
    assert (solve(scene.objects(5).samples()).group < 0).all()


def test_two_sensors_find_a_passage_of_a_few_seconds():
    times = np.arange(0.0, 30.0)
    scene = Scene(3, 2, times=times).objects(1)
    for i in range(2):
        scene.seen[i] = (times >= 4.0) & (times <= 7.0)
    assert (solve(scene.samples()).group == 0).all()
