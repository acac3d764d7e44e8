"""The table `nights`: what a night was made from and with, and what it holds."""

from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from epipole.flows.night.summary import count
from epipole.io.datasets.night_files import write_table
from epipole.io.work.recipe import Recipe, digest_of
from epipole.schemas.bridge import table
from epipole.schemas.tables import NIGHTS


def write_night_row(
    folder: Path,
    recipe: Recipe,
    earlier_key: str,
    faults: Sequence[object],
    residuals: Sequence[object],
) -> None:
    """Write the table `nights` of a night whose other tables are written to `folder`.

    Parameters
    ----------
    earlier_key
        What the nights before were made from; see `EarlierNights.key`.
    faults, residuals
        Of sensors; each as text is a sentence.
    """
    row = {
        **{f"{name}_key": key for name, key in recipe._asdict().items()},
        "code_version": metadata.version("epipole"),
        "earlier_key": earlier_key,
        **count([folder]),
        "faults": [str(fault) for fault in faults],
        "residuals": [str(residual) for residual in residuals],
    }
    write_table(folder, "nights", [table(NIGHTS, {name: [row[name]] for name in NIGHTS.names})])


def recipe_in(row: dict[str, Any]) -> Recipe:
    """Return the recipe that a row of `nights` tells."""
    return Recipe(*(row[f"{name}_key"] for name in Recipe._fields))


def key_of(row: dict[str, Any] | None) -> str:
    """Return a digest of what a night was made from; "unknown" where it has no row."""
    if row is None:
        return "unknown"
    return digest_of([*(key or "" for key in recipe_in(row)), row["earlier_key"]])
