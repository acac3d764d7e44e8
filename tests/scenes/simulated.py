"""A small scene to simulate, with changes."""

from epipole.schemas.scene import validate_scene

SENSOR = {
    "id": "a",
    "orbit": {"a_km": 7000.0},
    "camera": {"fov_deg": 10.0},
    "pointing": {"mode": "fixed", "ra_deg": 10.0, "dec_deg": 5.0},
    "phase": 0.0,
}


def scene_of(sensor=None, **changes):
    scene = {"name": "test", "sensors": [SENSOR | (sensor or {})], "duration_s": 20.0}
    return validate_scene(scene | changes, "test")
