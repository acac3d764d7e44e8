"""Simulation scenes: built-in ones and TOML files."""

import os
from pathlib import Path
from typing import Any

from epipole.io.names import refuse_device
from epipole.schemas.errors import SceneError
from epipole.schemas.simulation.scene import Scene, scene_values, validate_scene

_BUILT_IN = Path(__file__).parent / "built_in"


def built_in_scenes() -> list[str]:
    """Return the names of the scenes that come with the package."""
    return sorted(path.stem for path in _BUILT_IN.glob("*.toml"))


def read_scene(scene: str | os.PathLike[str]) -> Scene:
    """Return the built-in scene of this name, or the scene in a TOML file.

    Raises
    ------
    SceneError
        Where there is neither, or the file is invalid.
    """
    name = os.fspath(scene)
    is_built_in = name in built_in_scenes()
    path = _BUILT_IN / f"{name}.toml" if is_built_in else Path(name)
    try:
        refuse_device(path)
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        known = ", ".join(built_in_scenes())
        raise SceneError(f"{name}: no such scene file; the built-in scenes are {known}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"{name}: cannot be read as a scene: {error}") from error
    values = scene_values(text, name)
    return validate_scene(values if is_built_in else _beside(values, path.parent), name)


def _beside(values: Any, folder: Path) -> Any:
    """Return the values of a scene with the full path of each element file in its folder."""
    if isinstance(values, list):
        return [_beside(value, folder) for value in values]
    if not isinstance(values, dict):
        return values
    values = {key: _beside(value, folder) for key, value in values.items()}
    file = values.get("elements")
    if isinstance(file, str) and (folder / file).is_file():
        values["elements"] = str((folder / file).resolve())
    return values
