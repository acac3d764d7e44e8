"""The globe: who was where at one time, and what the Earth hides."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest
from scenes.made_nights import START_NS, filled, reader_of

from epipole.io.datasets.dataset import night_reader
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM, GM_KM3_S2, SECOND_NS
from epipole.tasks.report import globe as globe_module
from epipole.tasks.report.epipolar_views import best_epoch
from epipole.tasks.report.globe import SIGHT_KM, Globe, Sight, read_globe

pytest.importorskip("matplotlib")
from epipole.tasks.report.draw_globe import SIZE_PT, draw_globe

NIGHT = "2019-04-01"


def at_seconds(*times_s):
    return START_NS + np.array(times_s) * SECOND_NS


@pytest.fixture(scope="module")
def globe(night_dataset):
    night = night_reader(night_dataset, NIGHT)
    return read_globe(night, best_epoch(night))


def test_the_example_has_all_its_sensors_objects_and_lines_of_sight(globe):
    assert (globe.n_sensors, globe.n_objects, globe.n_sights) == (4, 9, 36)
    heights = {len(found): [np.linalg.norm(r) - EARTH_RADIUS_KM for r in found.values()]
               for found in (globe.sensors, globe.objects)}  # fmt: skip
    assert all(500 < height < 2000 for height in heights[4])
    assert all(abs(height - 35_790) < 300 for height in heights[9])
    for sight in globe.sights:
        assert sight.object_id
        assert np.linalg.norm(sight.from_km - globe.sensors[sight.sensor_id]) < 8.0  # of a second
        np.testing.assert_array_equal(sight.to_km, globe.objects[sight.object_id])


def test_of_a_night_without_positions_the_orbits_are_moved_to_the_time():
    r_km = EARTH_RADIUS_KM + 700.0
    speed = np.sqrt(GM_KM3_S2 / r_km)
    state = {"x_km": r_km, "y_km": 0.0, "z_km": 0.0, "vx_km_s": 0.0, "vy_km_s": speed,
             "vz_km_s": 0.0}  # fmt: skip
    far = {name: [value] * 3 for name, value in state.items()}
    at = {"x_km": [7000.0] * 2, "y_km": [0.0] * 2, "z_km": [0.0] * 2}
    tables = {
        "orbits": filled("orbits", object_id=[*"abc"], epoch=at_seconds(0, 600, 9000), **far),
        "frames": filled("frames", sensor_id=["s", "t"], time=at_seconds(590, 601), **at),
        "observations": filled(
            "observations", sensor_id=["s", "s"], tracklet_id=["s-1", "s-2"],
            object_id=["a", None], time=at_seconds(599, 600), ra_deg=[0.0, 90.0],
            dec_deg=[0.0, 0.0], **at,
        ),
    }  # fmt: skip
    found = read_globe(reader_of(tables), None)
    assert sorted(found.objects) == ["a", "b"]  # the orbit of the third is hours away
    np.testing.assert_allclose(found.objects["b"], [r_km, 0, 0])
    angle = 600.0 * speed / r_km
    moved = r_km * np.array([np.cos(angle), np.sin(angle), 0.0])
    assert np.linalg.norm(found.objects["a"] - moved) < 5.0  # J2
    to_object, alone = found.sights
    np.testing.assert_array_equal(to_object.to_km, found.objects["a"])
    assert alone.object_id == ""
    np.testing.assert_allclose(alone.to_km - alone.from_km, [0, SIGHT_KM, 0], atol=1e-9)


def test_without_frames_or_places_of_sensors_there_is_none():
    assert read_globe(reader_of({}), None) is None
    frames = filled("frames", sensor_id=["s"], time=at_seconds(1), x_km=[None], y_km=[None],
                    z_km=[None])  # fmt: skip
    assert read_globe(reader_of({"frames": frames}), None) is None


def test_what_is_behind_the_earth_is_hidden_and_the_rest_is_in_its_place():
    near, behind, beside = [0.0, 7000, 0], [0.0, -7000, 0], [9000.0, -7000, 0]
    sensors = {name: np.array(r) for name, r in zip("nbs", (near, behind, beside), strict=True)}
    sight = Sight("b", "", sensors["b"], np.array([30_000.0, -7000, 0]))
    sensors['"><script>'] = sensors["n"]
    drawn = draw_globe(Globe(0, sensors, {}, [sight], 4, 0, 1), {}, {})
    assert len(ElementTree.fromstring(drawn).findall(".//{*}use")) == 4
    turn, scale = re.search(r'data-turn="(.*?) (.*?)" data-scale="(.*?)"', drawn).groups()[::2]
    lon, unit = np.radians(float(turn)), float(scale) / 1000
    dots = re.findall(r'x="(\S+)" y="(\S+)" data-p="(\S+) (\S+) (\S+)".*?/>', drawn)
    for x, y, *p in dots:
        east = (float(p[1]) * np.cos(lon) - float(p[0]) * np.sin(lon)) * 1000
        assert float(x) == pytest.approx(SIZE_PT / 2 + unit * east, abs=0.06)
        assert 0 <= float(y) <= SIZE_PT
    assert drawn.count('visibility="hidden"') <= 1
    (path,) = re.findall(r'<g class="sight lone"><path d="(.*?)"', drawn)
    assert path.startswith("M")


def test_of_thousands_some_are_drawn_and_all_are_counted(monkeypatch):
    monkeypatch.setattr(globe_module, "MAX_DOTS", 3)
    names = [f"s{k}" for k in range(5)]
    at = {name: [7000.0] * 5 for name in ("x_km", "y_km", "z_km")}
    frames = filled("frames", sensor_id=names, time=at_seconds(1, 1, 1, 1, 1), **at)
    found = read_globe(reader_of({"frames": frames}), None)
    assert (found.n_sensors, list(found.sensors)) == (5, names[:3])
