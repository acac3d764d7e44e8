"""Satellites of a scene: chosen by name or number, near in time, and still in orbit."""

import numpy as np
import pytest
from scenes.satellites import LINES, two_lines
from scenes.simulated import scene_of

from epipole.schemas.errors import SceneError
from epipole.schemas.scene import Orbit
from epipole.tasks.simulate.draw_objects import draw_satellites, propagate_satellites, scene_nodes
from epipole.tasks.simulate.simulate_scene import expose_blocks, simulate_scene

START = "2026-05-30T12:00:00Z"
T0_NS = 1_780_142_400 * 10**9


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "some.tle"
    old, new = two_lines("11", 14.0, days=-3.0), two_lines("11", 14.0, days=-0.2)
    sets = [("ISS (ZARYA)", *LINES), ("ALPHA", *old), ("ALPHA", *new),
            ("BETA 1", *two_lines("12", 13.0)), ("BETA 2", *two_lines("13", 13.1))]  # fmt: skip
    path.write_text("\n".join("\n".join(s) for s in sets))
    return str(path)


def placed(file, *satellites, **scene):
    scene = scene_of(start=START, **scene)
    return propagate_satellites(scene, Orbit(elements=file, satellites=list(satellites)), T0_NS)


def test_satellites_are_chosen_by_name_or_number_and_else_all(file):
    assert [s.number for s in placed(file).sets] == [25544, 11, 12, 13]
    assert [s.number for s in placed(file, "beta 2", 25544, "12").sets] == [13, 25544, 12]
    with pytest.raises(SceneError, match=r"has no satellite BETA; it has BETA [12], BETA [12]"):
        placed(file, "BETA")


def test_of_two_sets_of_a_satellite_the_nearer_one_is_taken(file):
    (alpha,) = placed(file, "ALPHA").sets
    assert abs(alpha.epoch_ns - T0_NS) / 86400e9 < 0.3


def test_elements_far_from_the_scene_are_refused_and_named(file):
    orbit = Orbit(elements=file, satellites=[12])
    t0_ns = T0_NS - 20 * 86400 * 10**9
    with pytest.raises(SceneError, match=r"BETA 1 \(12\): its elements are of 2026-05-30T12:00"):
        propagate_satellites(scene_of(), orbit, t0_ns)
    assert propagate_satellites(scene_of(element_age_days=21.0), orbit, t0_ns).sets[0].number == 12


def test_a_satellite_that_decays_is_named(tmp_path):
    path = tmp_path / "falling.tle"
    path.write_text("FALLING\n" + "\n".join(two_lines("9", 16.4, bstar=0.05)))
    with pytest.raises(SceneError, match=r"FALLING \(9\): SGP4 fails at 2026-0.*leave this"):
        placed(str(path), duration_s=12 * 86400.0)


def test_drawn_satellites_are_different_ones_in_their_order(file):
    satellites = placed(file)
    drawn = draw_satellites(satellites, 3, np.random.default_rng(2))
    at = [satellites.sets.index(s) for s in drawn.sets]
    assert at == sorted(set(at))
    t_s = np.array([5.0])
    for k, row in enumerate(at):
        np.testing.assert_array_equal(drawn.paths.at(t_s, k)[0], satellites.paths.at(t_s, row)[0])
    with pytest.raises(SceneError, match="5 satellites are wanted of 4"):
        draw_satellites(satellites, 5, np.random.default_rng(2))


def test_nodes_cover_the_states_about_a_scene():
    t_s = scene_nodes(scene_of({"states": {"margin_s": 100.0}}, duration_s=50.0))
    assert t_s[2] <= -100.0
    assert t_s[-3] >= 150.0
    np.testing.assert_array_equal(np.diff(t_s), 10.0)


def test_each_satellite_of_a_group_carries_a_sensor(file):
    sensor = {"orbit": {"elements": file}, "count": None}
    made = simulate_scene(scene_of(sensor, start=START))
    assert [s.sensor_id for s in made.sensors] == ["a1", "a2", "a3", "a4"]
    assert [s.number for s in made.sensor_sets] == [25544, 11, 12, 13]
    two = [simulate_scene(scene_of(sensor | {"count": 2}, start=START, seed=s)) for s in range(9)]
    assert {len(scene.sensors) for scene in two} == {2}
    assert len({scene.sensor_sets[0].number for scene in two}) > 1


def test_only_satellites_that_always_see_what_they_track_are_taken(file):
    place = {"mode": "track", "place_km": [0.0, 0.0, -42164.0]}
    sensor = {"orbit": {"elements": file}, "pointing": place}
    numbers = {}
    for in_view in (False, True):
        made = simulate_scene(scene_of(sensor | {"in_view": in_view}, start=START))
        numbers[in_view] = [s.number for s in made.sensor_sets]
    assert 0 < len(numbers[True]) < len(numbers[False]) == 4
    hidden = next(n for n in numbers[False] if n not in numbers[True])
    sensor["orbit"] = {"elements": file, "satellites": [hidden]}
    with pytest.raises(SceneError, match=r"1 satellites are wanted of 1 .* visible; found 0"):
        simulate_scene(scene_of(sensor | {"in_view": True}, start=START))


@pytest.mark.filterwarnings("error")
def test_a_sensor_does_not_see_the_satellite_that_carries_it(file):
    sensor = {
        "orbit": {"elements": file, "satellites": [12]},
        "pointing": {"mode": "track", "target": "BETA 2"},
    }
    targets = [{"orbit": {"elements": file}, "magnitude": 5.0}]
    simulation = simulate_scene(scene_of(sensor, start=START, targets=targets))
    ((seen,),) = expose_blocks(simulation)
    assert set(seen.source[seen.kind == 1].tolist()) == {3}


def test_a_sensor_does_not_track_the_satellite_that_carries_it(file):
    sensor = {"orbit": {"elements": file}, "pointing": {"mode": "track", "target": "BETA 2"}}
    targets = [{"orbit": {"elements": file}, "magnitude": 5.0}]
    with pytest.raises(SceneError, match="sensor a4 tracks the satellite that carries it"):
        simulate_scene(scene_of(sensor, start=START, targets=targets))
    alone = {"orbit": {"elements": file, "satellites": [13]}, "in_view": True}
    with pytest.raises(SceneError, match=r"1 satellites are wanted of 1 .* visible; found 0"):
        simulate_scene(scene_of(sensor | alone, start=START, targets=targets))


def test_an_object_to_track_is_found_by_name_or_number_or_named(file):
    targets = [{"orbit": {"elements": file}, "magnitude": 5.0}]
    for target in ("alpha", "11", 1):
        scene = scene_of({"pointing": {"target": target}}, start=START, targets=targets)
        followed = simulate_scene(scene).sensors[0].followed
        expected = placed(file, 11).paths.at(np.zeros(1))[0]
        np.testing.assert_array_equal(followed.at(np.zeros(1))[0], expected)
    for target, says in (("GAMMA", "no object is called GAMMA"), (4, "tracks target 4 of 4")):
        with pytest.raises(SceneError, match=says):
            simulate_scene(scene_of({"pointing": {"target": target}}, start=START, targets=targets))
    both = {"orbit": {"elements": file, "satellites": [12, 13]}}
    with pytest.raises(SceneError, match=r"sensor a tracks 2 satellites of .*; name one"):
        simulate_scene(scene_of({"pointing": both}, start=START))
