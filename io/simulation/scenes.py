"""The files of a simulation scene: built-in or TOML, with the element sets that it names."""

import os
from pathlib import Path
from typing import Any

from epipole.io.catalogues.element_sets import parse_element_sets
from epipole.io.paths import refuse_device
from epipole.schemas.errors import CatalogueError, SceneError
from epipole.schemas.scene import Scene, scene_values, validate_scene
from epipole.schemas.star_lists import ElementSet

# Scenes.

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


# Element sets: from the package, or from a file.


def built_in_element_files() -> list[str]:
    """Return the names of the files of element sets that come with the package."""
    return sorted(path.name for path in _BUILT_IN.glob("*.tle"))


def read_element_sets(path: str | os.PathLike[str]) -> list[ElementSet]:
    """Return the element sets of a file, in its order; see `parse_element_sets`.

    The file is of the package (such as ``real_orbits.tle``) or on the disk.

    Raises
    ------
    SceneError
        Where the file is missing, has no element sets, or one of them is invalid.
    """
    name = os.fspath(path)
    where = _BUILT_IN / name if name in built_in_element_files() else Path(name)
    try:
        found, faults = parse_element_sets(where.read_bytes())
    except (OSError, CatalogueError) as error:
        raise SceneError(f"{name}: cannot be read as element sets: {error}") from error
    if faults:
        raise SceneError(f"{name}, {faults[0]}")
    if not found:
        raise SceneError(f"{name}: has no element sets; give two-line elements or OMM")
    return found
