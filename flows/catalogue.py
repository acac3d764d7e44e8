"""Build a star catalogue file for a run."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from epipole.io.catalogues.star_catalogue import write_star_catalogue
from epipole.io.catalogues.star_list import read_star_list
from epipole.io.paths import fault_of_name, is_one_of
from epipole.schemas.bridge import array
from epipole.schemas.errors import CatalogueError
from epipole.schemas.options import STAR_CATALOGUES, load_function
from epipole.schemas.star_lists import UNKNOWN_MOTION_MAS_YR, label_of


@dataclass(frozen=True)
class BuiltCatalogue:
    """The catalogue that was written."""

    file: str
    name: str
    epoch: float
    source: str
    stars: int
    brightest: float
    faintest: float
    without_motion: int
    variable: int
    ignored: list[str]

    def as_dict(self) -> dict[str, Any]:
        """Return the fields by name, for JSON."""
        return asdict(self)

    def lines(self) -> list[str]:
        """Return the fields as lines for people."""
        ignored = [f"ignored     columns {', '.join(self.ignored)}"] if self.ignored else []
        return [
            f"catalogue   {self.name}, positions at {self.epoch:g}",
            f"source      {self.source}",
            f"stars       {self.stars:,} of magnitude {self.brightest:.2f} to {self.faintest:.2f}; "
            f"{self.without_motion:,} without a motion, {self.variable:,} variable",
            *ignored,
            f"file        {self.file}",
            f"to use it   set identification.catalogue = {self.file!r} in the settings",
        ]


def build_catalogue(
    source: str,
    out: Path,
    epoch: float | None = None,
    name: str | None = None,
    magnitude_limit: float | None = None,
) -> BuiltCatalogue:
    """Build a star catalogue and write it as Parquet.

    Parameters
    ----------
    source
        A name in `STAR_CATALOGUES`, or a CSV or Parquet file of stars.
    out
        The file to write. An existing file is replaced, but for the source.
    epoch, name
        For a file of stars only, see `read_star_list`.
    magnitude_limit
        Fainter stars are left out.

    Raises
    ------
    CatalogueError
        Where the source is invalid; no file is then written.
    """
    if (fault := fault_of_name(out.name)) is not None:
        raise CatalogueError(f"file {out}: {fault}")
    if source not in STAR_CATALOGUES and is_one_of(out, [source]):
        raise CatalogueError(f"{out}: is the source, and would be lost; give another file to write")
    if source in STAR_CATALOGUES and (epoch is not None or name is not None):
        raise CatalogueError(f"{source} has an epoch and a name; leave these options out")
    ignored: list[str] = []
    if source in STAR_CATALOGUES:
        stars = load_function(STAR_CATALOGUES[source].read)()
    else:
        stars, ignored = _of_user(source, epoch, name)
    if magnitude_limit is not None:
        stars = stars.filter(pa.array(array(stars, "magnitude") <= magnitude_limit))
    if not stars.num_rows:
        raise CatalogueError(f"{source}: no star of magnitude {magnitude_limit} or brighter")
    write_star_catalogue(out, stars)
    return _built(out, stars, ignored)


def _of_user(source: str, epoch: float | None, name: str | None) -> tuple[pa.Table, list[str]]:
    if not Path(source).is_file():
        raise CatalogueError(
            f"{source}: no such file; give {', '.join(STAR_CATALOGUES)}, or a CSV or Parquet file"
        )
    name = name or Path(source).stem
    if name in STAR_CATALOGUES:
        raise CatalogueError(f"{source}: the name {name} is reserved; give another with --name")
    return read_star_list(Path(source), epoch, name)


def _built(out: Path, stars: pa.Table, ignored: list[str]) -> BuiltCatalogue:
    label, magnitude = label_of(stars.schema), array(stars, "magnitude")
    return BuiltCatalogue(
        file=str(out),
        name=label.name,
        epoch=label.epoch,
        source=label.source,
        stars=stars.num_rows,
        brightest=float(magnitude.min()),
        faintest=float(magnitude.max()),
        without_motion=int(np.sum(array(stars, "pm_sigma_mas_yr") == UNKNOWN_MOTION_MAS_YR)),
        variable=int(np.sum(array(stars, "variable"))),
        ignored=ignored,
    )
