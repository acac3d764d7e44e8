"""The catalogue of known objects: a file of element sets, and its digest."""

import hashlib
from pathlib import Path
from typing import NamedTuple

from epipole.io.catalogues.element_sets import Fault, parse_element_sets
from epipole.io.remote_files import known_as, open_remote
from epipole.schemas.catalogues.element_set import ElementSet
from epipole.schemas.errors import CatalogueError, LogError

ADVICE = "give two-line elements, or OMM in CSV, JSON or XML"


class KnownObjects(NamedTuple):
    """The element sets of a file, in its order, and its records that are none."""

    file: str  # its name, without folders
    sha256: str
    sets: list[ElementSet]
    faults: list[Fault]


def read_known_objects(where: str) -> KnownObjects:
    """Return the catalogue of known objects that a path or a URL names.

    Raises
    ------
    CatalogueError
        Where it is missing, cannot be read or has no element set.
    """
    where = known_as(where)
    data = _bytes_of(where)
    try:
        sets, faults = parse_element_sets(data)
    except CatalogueError as error:
        raise CatalogueError(f"{where}: {error}; {ADVICE}") from error
    if not sets:
        first = f" ({faults[0]})" if faults else ""
        raise CatalogueError(f"{where}: has no element sets{first}; {ADVICE}")
    return KnownObjects(Path(where).name, hashlib.sha256(data).hexdigest(), sets, faults)


def _bytes_of(where: str) -> bytes:
    if "://" in where:
        try:
            size, read, _ = open_remote(where)
            return read(0, size)
        except LogError as error:
            raise CatalogueError(str(error)) from error
    path = Path(where)
    if not path.is_file():
        what = "is no file" if path.exists() else "no such file"
        raise CatalogueError(f"{where}: {what}; {ADVICE}")
    try:
        return path.read_bytes()
    except OSError as error:
        raise CatalogueError(f"{where}: cannot be read: {error.strerror}; {ADVICE}") from error
