"""Element sets for scenes: of a file that comes with the package, or of one on the disk."""

import os
from pathlib import Path

from epipole.io.catalogues.element_sets import parse_element_sets
from epipole.schemas.catalogues.element_set import ElementSet
from epipole.schemas.errors import CatalogueError, SceneError

_BUILT_IN = Path(__file__).parent / "built_in"


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
