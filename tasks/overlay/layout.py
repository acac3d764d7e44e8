"""The layout of a viewer: images of the first sensors, the scene, and what was left out.

In the form in which Foxglove and Lichtblick export and import layouts.
"""

from collections.abc import Sequence
from typing import Any

from epipole.tasks.overlay.messages import LEFT_OUT, OBJECTS
from epipole.tasks.overlay.scene import ROOT_FRAME

MAX_IMAGES = 4  # more are too small to see a centroid
# Distance of the viewer at first, and range that is drawn [m]: the geostationary ring fits.
DISTANCE_M, NEAR_M, FAR_M = 1.2e8, 1e4, 1e9


def viewer_layout(sensors: Sequence[str]) -> dict[str, Any]:
    """Return the layout for these sensors, ready for JSON."""
    images = {f"Image!{k + 1}": _image(name) for k, name in enumerate(sensors[:MAX_IMAGES])}
    scene, log = "3D!scene", "RosOut!rejects"
    panels = {**images, scene: _scene(), log: {"topicToRender": LEFT_OUT}}
    right = _divided(scene, log, "column", 70)
    left = _stacked(list(images))
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _divided(left, right, "row", 45) if left else right,
    }


def _image(sensor: str) -> dict[str, Any]:
    return {
        "imageMode": {
            "imageTopic": f"/{sensor}/image",
            "calibrationTopic": f"/{sensor}/calibration",
            "annotations": {f"/{sensor}/annotations": {"visible": True}},
        }
    }


def _scene() -> dict[str, Any]:
    return {
        "cameraState": {
            "perspective": True, "distance": DISTANCE_M, "phi": 60, "thetaOffset": 45,
            "target": [0, 0, 0], "targetOffset": [0, 0, 0], "targetOrientation": [0, 0, 0, 1],
            "fovy": 45, "near": NEAR_M, "far": FAR_M,
        },
        "followMode": "follow-none",
        "followTf": ROOT_FRAME,
        "topics": {OBJECTS: {"visible": True}},
    }  # fmt: skip


def _stacked(panels: Sequence[str]) -> Any:
    """Return panels below each other, all of the same height."""
    if len(panels) < 2:
        return panels[0] if panels else None
    return _divided(panels[0], _stacked(panels[1:]), "column", 100 / len(panels))


def _divided(first: Any, second: Any, direction: str, percent: float) -> dict[str, Any]:
    return {
        "first": first,
        "second": second,
        "direction": direction,
        "splitPercentage": percent,
    }
