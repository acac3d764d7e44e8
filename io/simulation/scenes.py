"""Simulation scenes: built-in ones and TOML files."""

import os
from pathlib import Path

from epipole.schemas.errors import SceneError
from epipole.schemas.simulation.scene import Scene, parse_scene

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
    path = _BUILT_IN / f"{name}.toml" if name in built_in_scenes() else Path(name)
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        known = ", ".join(built_in_scenes())
        raise SceneError(f"{name}: no such scene file; the built-in scenes are {known}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"{name}: cannot be read as a scene: {error}") from error
    return parse_scene(text, name)
