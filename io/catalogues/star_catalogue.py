"""The star catalogue of a run: one of `STAR_CATALOGUES`, or a file of `epipole catalog build`."""

import os
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from epipole.schemas.bridge import array, conform
from epipole.schemas.errors import CatalogueError
from epipole.schemas.options import DEFAULT_CATALOGUE, catalogue_of_runs, load_function
from epipole.schemas.star_lists import STAR_CATALOGUE, CatalogueLabel, label_of, labelled

BUILD = "make it with `epipole catalog build`"


def read_star_catalogue(which: str) -> pa.Table:
    """Return a catalogue as a table STAR_CATALOGUE with its label.

    Parameters
    ----------
    which
        A name in `STAR_CATALOGUES`, or the path of a catalogue file.

    Raises
    ------
    CatalogueError
        Where the file is missing, or is not a catalogue.
    """
    if (source := catalogue_of_runs(which)) is not None:
        return _read_once(source.read)
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
def _read_once(read: str) -> pa.Table:
    """Return the catalogue of a data package, which never changes; every task asks for it."""
    return load_function(read)()


def check_star_catalogue(which: str) -> None:
    """Raise where `read_star_catalogue` would find no catalogue file; its stars are not read."""
    if catalogue_of_runs(which) is None:
        _label(which)


def _label(which: str) -> CatalogueLabel:
    if not Path(which).is_file():
        raise CatalogueError(
            f"{which}: no such catalogue file; set identification.catalogue to "
            f'"{DEFAULT_CATALOGUE}" or to the path of a catalogue file'
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
