"""Scenes: checked, with a message of one line."""

import re

import pytest
from scenes.simulated import scene_of

from epipole.schemas.errors import SceneError
from epipole.schemas.scene import parse_scene

SHELL = {"altitude_km": 550.0, "walker": "53:1584/72/39"}
SHELLS = [SHELL]

BAD_SCENES = {
    "sensors.0.camera: a camera takes one of": {"camera": {"fov_deg": 2.0, "focal_px": 100.0}},
    "sensors.0.camera: k4 goes with a fisheye": {"camera": {"fov_deg": 2.0, "k4": 0.1}},
    "sensors.0.camera: p1 and p2 do not go with a fisheye": {
        "camera": {"fov_deg": 90.0, "fisheye": True, "p2": 0.1}
    },
    "sensors.0.orbit: the orbit's perigee lies below": {"orbit": {"a_km": 7000.0, "e": 0.5}},
    "sensors.0.orbit: an orbit takes one of": {"orbit": {"a_km": 7000.0, "random": "leo"}},
    "sensors.0.rate_hz = 0: input should be greater": {"rate_hz": 0},
    "unknown field sensors.0.colour": {"colour": "red"},
    "sensors.0.id = '../x': ": {"id": "../x"},
    'sensors.0.pointing: pointing "fixed" takes ra_deg': {"pointing": {"mode": "fixed"}},
    "sensors.0.orbit: satellites goes with elements": {"orbit": {"a_km": 7e3, "satellites": ["A"]}},
    "sensors.0.orbit: i_deg does not go with elements": {
        "orbit": {"elements": "a.tle", "i_deg": 3.0}
    },
    'sensors.0.pointing: pointing "track" takes one of': {
        "pointing": {"target": 0, "place_km": (1.0, 2.0, 3.0)}
    },
    "sensor a tracks target 3 of 0": {"pointing": {"target": 3}},
    "sensors.0.detection.star_drop = 2.0: input": {"detection": {"star_drop": 2.0}},
}


@pytest.mark.parametrize("says", BAD_SCENES)
def test_a_bad_scene_is_one_line_that_names_the_field(says):
    with pytest.raises(SceneError, match="^test: .*" + re.escape(says)) as error:
        scene_of(BAD_SCENES[says])
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("start", ["1971-12-31T12:00:00Z", "2150-01-01T00:00:00Z"])
def test_a_scene_starts_where_the_times_of_a_log_may_be(start):
    with pytest.raises(SceneError, match=r"start = .*: input should be"):
        scene_of({}, start=start)


@pytest.mark.parametrize(
    ("says", "target"),
    [
        ("magnitude or standard_magnitude", {"magnitude": 8.0, "standard_magnitude": 3.0}),
        ("spread_km does not go", {"spread_km": 3.0, "orbit": {"elements": "a.tle"}}),
        ("spread_km does not go", {"spread_km": 3.0, "orbit": {"random": "low"}}),
        ("takes one of a_km", {"orbit": {"a_km": 7000.0, "shells": SHELLS}}),
        ("e does not go with shells", {"orbit": {"e": 0.1, "shells": SHELLS}}),
        ("near goes with shells", {"orbit": {"a_km": 7000.0, "near": True}}),
        ("usable_only goes with elements", {"orbit": {"shells": SHELLS, "usable_only": True}}),
        ("t a multiple of p", {"orbit": {"shells": [SHELL | {"walker": "53:10/3/1"}]}}),
        ("f below p", {"orbit": {"shells": [SHELL | {"walker": "53:9/3/3"}]}}),
        ("i <= 180", {"orbit": {"shells": [SHELL | {"walker": "181:9/3/1"}]}}),
        ("walker = '53/9/3/1'", {"orbit": {"shells": [SHELL | {"walker": "53/9/3/1"}]}}),
    ],
)
def test_objects_that_contradict_themselves_are_refused(says, target):
    with pytest.raises(SceneError, match=rf"^test: targets.0.*{re.escape(says)}"):
        scene_of(targets=[{"orbit": {"a_km": 7000.0}} | target])


def test_a_scene_that_is_not_toml_or_lacks_a_field_is_refused():
    with pytest.raises(SceneError, match=r"^x.toml: not TOML: "):
        parse_scene("name = ", "x.toml")
    with pytest.raises(SceneError, match=r"^x.toml: name is missing$"):
        parse_scene("duration_s = 3.0", "x.toml")
