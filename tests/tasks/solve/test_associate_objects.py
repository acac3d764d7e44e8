"""Associate objects: good views become objects, wrong ones rejects."""

import numpy as np
import pytest
from scenes.associations import associated, reasons, wrong_views
from scenes.tracklet_scenes import Scene

from epipole.tasks.solve import associate_objects as associate
from epipole.tasks.solve.associate_objects import main_objects


@pytest.mark.parametrize("method", ["likelihood", "epipolar"])
def test_objects_come_out_with_all_their_views(method):
    # Far apart against 8 px, so that the published method can tell them.
    scene = Scene(11, 4).objects(4, spread_km=300.0)
    found = associated(scene, method=method)
    assert wrong_views(scene, found) == 0
    assert len(np.unique(found.object_number)) == 4
    assert found.views.num_rows >= 0.9 * 4 * 4 * len(scene.times)


def test_a_repetition_gives_the_same_bits():
    one, other = (associated(Scene(12, 5).objects(10).strays(30)) for _ in range(2))
    assert one.views.equals(other.views)
    assert one.rejects.equals(other.rejects)
    assert (one.object_number == other.object_number).all()


def test_one_sensor_alone_gives_no_object():
    found = associated(Scene(13, 1).objects(5))
    assert found.views.num_rows == 0


def test_parallel_lines_of_sight_give_no_object():
    scene = Scene(14, 2)
    scene.r[1] = scene.r[0] + [0.05, 0.0, 0.0]  # side by side
    assert associated(scene.objects(3)).views.num_rows == 0


def test_an_object_behind_a_sensor_gives_no_object():
    scene = Scene(15, 3)
    for s in range(3):
        away = scene.r[s] - np.array([42164.0, 0.0, 0.0])
        scene.add(s, 0, away / np.linalg.norm(away, axis=1, keepdims=True))
    assert associated(scene).views.num_rows == 0


def test_an_object_inside_the_earth_gives_no_object():
    scene = Scene(16, 3)
    for s in range(3):
        inward = np.array([4000.0, 0.0, 0.0]) - scene.r[s]
        scene.add(s, 0, inward / np.linalg.norm(inward, axis=1, keepdims=True))
    assert associated(scene).views.num_rows == 0


@pytest.mark.parametrize("error", ["attitude", "state", "clock"])
def test_a_wrong_sensor_is_named_and_left_out_and_no_view_is_wrong(error, caplog):
    scene = Scene(17, 4).objects(8, spread_km=100.0)
    if error == "attitude":  # by a degree, and it is believed to be turned so
        axis = np.array([0.0, 0.0, 1.0])
        for i, s in enumerate(scene.sensor):
            if s == 3:
                u = scene.u[i] + np.cross(axis, scene.u[i]) * np.radians(1.0)
                scene.u[i] = u / np.linalg.norm(u, axis=1, keepdims=True)
    else:  # a state a minute old, or a clock a second off: it is not where it is said to be
        v = np.gradient(scene.r[3], scene.times, axis=0)
        scene.r[3] += v * (60.0 if error == "state" else 4.0)
    found = associated(scene)
    assert wrong_views(scene, found) == 0
    assert "sat3" not in found.views["sensor_id"].to_pylist()
    assert len(np.unique(found.object_number)) == 8
    if error != "attitude":  # turned so far that nothing of the others' stands in its field
        assert reasons(found).get("sensor_disagrees", 0) >= 8
        assert "sat3" in caplog.text


def test_a_clock_a_second_off_gives_no_wrong_object():
    scene = Scene(18, 4).objects(8, spread_km=100.0)
    scene.r[3] += np.gradient(scene.r[3], scene.times, axis=0) * 1.0
    assert wrong_views(scene, associated(scene)) == 0


@pytest.mark.parametrize(("end_s", "max_window_s"), [(118.0, 0.0), (88.0, 600.0)])
def test_a_sensor_that_disagrees_in_one_window_keeps_its_objects_in_the_others(end_s, max_window_s):
    """Also those that it sees with one other sensor."""
    scene = Scene(1, 3, times=np.arange(30.0, end_s, 4.0)).objects(8, spread_km=100.0)
    scene.objects(4, spread_km=100.0, seen_by=[0, 2])
    turned = scene.times < 60.0
    for i, s in enumerate(scene.sensor):
        if s == 2:  # by 0.3 degree, until 60 s
            scene.u[i][turned] += np.cross([0.0, 0.0, 1.0], scene.u[i][turned]) * np.radians(0.3)
            scene.u[i] /= np.linalg.norm(scene.u[i], axis=1, keepdims=True)
    found = associated(scene, max_window_s=max_window_s)
    assert reasons(found) == {"sensor_disagrees": 12}
    ids = np.array(found.views["tracklet_id"].to_pylist())
    of_pairs = np.isin(ids, [f"t{i:04d}" for i in range(24, 32)])
    assert of_pairs.sum() >= 0.95 * 8 * (~turned).sum()


def test_two_sensors_with_one_id_give_no_wrong_object():
    scene = Scene(19, 4).objects(6, spread_km=100.0)
    found = associated(scene, ["sat0", "sat1", "sat2", "sat2"])
    assert wrong_views(scene, found) == 0


def test_each_undecided_tracklet_has_a_row_with_its_id():
    scene = Scene(2, 2, times=np.array([0.0])).objects(5).strays(200)
    found = associated(scene)
    rows = [r for r in found.rejects.to_pylist() if r["reason"] == "undecided"]
    assert len(rows) > 4
    left_out = {r["tracklet_id"] for r in rows}
    assert len(left_out) == len(rows) == sum(r["count"] for r in rows)
    assert left_out.isdisjoint(found.views["tracklet_id"].to_pylist())
    sensor = {f"t{i:04d}": f"sat{s}" for i, s in enumerate(scene.samples().sensor)}
    assert all(sensor[r["tracklet_id"]] == r["sensor_id"] for r in rows)


def test_tracklets_that_two_objects_explain_are_ambiguous():
    scene = Scene(3, 2, times=np.array([0.0]))
    baseline = scene.r[1, 0] - scene.r[0, 0]
    towards = np.array([-39359.89, 15125.76, 64.30]) - scene.r[0, 0]
    towards /= np.linalg.norm(towards)
    across = baseline - (baseline @ towards) * towards
    across /= np.linalg.norm(across)
    middle = np.array([-39359.89, 15125.76, 64.30])
    for k, off in enumerate((-2.0, 2.0)):
        for s in range(2):
            path = middle + off * across - scene.r[s]
            scene.add(s, k, path / np.linalg.norm(path, axis=1, keepdims=True))
    found = associated(scene)
    assert found.views.num_rows == 0
    assert reasons(found) == {"ambiguous": 4}


def co_located(seed):
    """Return three objects about 4 km apart that four sensors see once in each window."""
    scene = Scene(seed, 4, sigma_arcsec=8.0, times=np.arange(15.0, 600.0, 30.0))
    return scene.objects(3, spread_km=4.0)


def test_tracklets_that_a_window_confuses_are_decided_over_longer_ones(monkeypatch):
    found = [associated(co_located(seed)) for seed in range(4)]
    assert sum(wrong_views(co_located(k), each) for k, each in enumerate(found)) == 0
    assert all(len(np.unique(each.object_number)) == 3 for each in found)
    monkeypatch.setattr(associate, "_changing", lambda *_: np.zeros(0, np.int64))
    found = [associated(co_located(seed)) for seed in range(4)]
    assert sum(wrong_views(co_located(k), each) for k, each in enumerate(found)) > 0


def test_an_object_that_is_the_main_one_of_no_track_is_none():
    track = np.array([0, 1, 0, 1, 2, 3, 0, 2, 4, 5])
    number = np.array([0, 0, 0, 0, 1, 1, 2, 2, 2, -1])
    n_views = np.array([5, 5, 5, 5, 9, 9, 3, 3, 3, 3])
    # Track 4 has no views in another object: object 2 stays.
    assert main_objects(track, number, n_views).tolist() == number.tolist()
    found = main_objects(track[:8], number[:8], n_views[:8])
    assert found.tolist() == [0, 0, 0, 0, 1, 1, -1, -1]
    assert not len(main_objects(track[:0], number[:0], n_views[:0]))


def test_a_track_that_changes_its_object_takes_none_away():
    track, number = np.array([0, 1, 0, 2]), np.array([0, 0, 1, 1])
    assert main_objects(track, number, np.array([9, 9, 2, 2])).tolist() == [0, 0, 1, 1]
