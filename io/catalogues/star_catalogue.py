"""The star catalogue of a run: Hipparcos-2, or a file written by `epipole catalog build`."""

import os
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from epipole.io.catalogues import hipparcos
from epipole.schemas.bridge import array, conform
from epipole.schemas.errors import CatalogueError
from epipole.schemas.star_lists import STAR_CATALOGUE, CatalogueLabel, label_of, labelled

BUILD = "make it with `epipole catalog build`"


def read_star_catalogue(which: str) -> pa.Table:
    """Return a catalogue as a table STAR_CATALOGUE with its label.

    Parameters
    ----------
    which
        "hipparcos", or the path of a catalogue file.

    Raises
    ------
    CatalogueError
        Where the file is missing, or is not a catalogue.
    """
    if which == hipparcos.NAME:
        return _hipparcos()
    label = _label(which)
    try:
        stars = conform(STAR_CATALOGUE, pq.read_table(which, partitioning=None))
    except (OSError, ValueError) as error:
        raise CatalogueError(f"{which}: cannot be read ({error}); {BUILD} again") from error
    for name in STAR_CATALOGUE.names:
        invalid = np.flatnonzero(~np.isfinite(array(stars, name)))
        if len(invalid):
            raise CatalogueError(
                f"{which}: row {invalid[0] + 1}, {name} is not a number; {BUILD} again"
            )
    return labelled(stars, label)


@cache
def _hipparcos() -> pa.Table:
    """Return the catalogue of the package, which never changes; every task asks for it."""
    return hipparcos.read_hipparcos()


def check_star_catalogue(which: str) -> None:
    """Raise where `read_star_catalogue` would find no catalogue file; its stars are not read."""
    if which != hipparcos.NAME:
        _label(which)


def _label(which: str) -> CatalogueLabel:
    if not Path(which).is_file():
        raise CatalogueError(
            f'{which}: no such catalogue file; set identification.catalogue to "{hipparcos.NAME}" '
            "or to the path of a catalogue file"
        )
    try:
        return label_of(pq.read_schema(which))
    except (OSError, ValueError) as error:
        raise CatalogueError(f"{which}: not a catalogue file ({error}); {BUILD}") from error


def write_star_catalogue(path: Path, stars: pa.Table) -> None:
    """Write a labelled catalogue as Parquet. An existing file is replaced in one step.

    Raises
    ------
    CatalogueError
        Where it cannot be written; an existing file is then unchanged.
    """
    label_of(stars.schema)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        os.close(handle)
        try:
            pq.write_table(stars, temporary, compression="zstd")
            os.chmod(temporary, 0o644)
            os.replace(temporary, path)
        finally:
            Path(temporary).unlink(missing_ok=True)
    except OSError as error:
        raise CatalogueError(f"{path}: cannot be written ({error.strerror or error})") from error
