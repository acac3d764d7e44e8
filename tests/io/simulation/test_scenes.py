"""Scene files."""

import pytest

from epipole.io.simulation.scenes import read_scene
from epipole.schemas.errors import SceneError


def test_an_unknown_scene_is_an_error_that_lists_the_built_in_scenes(tmp_path):
    with pytest.raises(SceneError, match=r"the built-in scenes are .*night"):
        read_scene(tmp_path / "none.toml")


def test_a_scene_file_is_read_with_what_all_sensors_share(tmp_path):
    text = """
    name = "mine"
    [sensor_defaults]
    camera = { fov_deg = 9.0, k1 = -0.1 }
    pointing = { mode = "random" }
    [[sensors]]
    id = "a"
    orbit = { a_km = 7000.0 }
    [[sensors]]
    id = "b"
    orbit = { a_km = 7000.0 }
    camera = { k1 = 0.1 }
    """
    (tmp_path / "mine.toml").write_text(text)
    cameras = [sensor.camera for sensor in read_scene(tmp_path / "mine.toml").sensors]
    assert [(c.fov_deg, c.k1) for c in cameras] == [(9.0, -0.1), (9.0, 0.1)]
