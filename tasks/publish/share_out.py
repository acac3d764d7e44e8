"""The rows of a night's objects, shared out among tasks.

Each task fits the orbits of some objects, whose rows are scattered through the night's tables. So
one task reads these tables once and writes their rows by share.
"""

import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import polars as pl

from epipole.io.datasets.night_tables import NightReader
from epipole.io.work.parts import (
    SHARED_SEEN,
    SHARED_SOLVED,
    PartTables,
    read_part,
    write_part,
)
from epipole.schemas.bridge import array, concat, from_polars, to_polars
from epipole.schemas.stages import Stage
from epipole.tasks.common.stage_tasks import stage_task

SHARED_OUT = {"observations": SHARED_SEEN, "positions": SHARED_SOLVED}
ROWS_OF_PART = 400_000  # about; of `observations` they take 0.1 GB


@stage_task(Stage.PUBLISH, "objects of {night} among {shares} tasks")
def share_out(folder: Path, night: str, shares: int) -> None:
    """Write the observations and the positions of a night's objects by share, in some parts."""
    reader = NightReader.of_folder(folder, night)
    for name, declared in SHARED_OUT.items():
        waiting, n_rows, number = [], 0, 0
        for piece in _with_share(reader, name, declared, shares):
            waiting.append(piece)
            n_rows += len(piece)
            if n_rows >= ROWS_OF_PART:
                _write(_folder(folder, name) / str(number), name, declared, waiting)
                waiting, n_rows, number = [], 0, number + 1
        if waiting:
            _write(_folder(folder, name) / str(number), name, declared, waiting)


def of_share(folder: Path, name: str, share: int) -> pl.DataFrame:
    """Return the rows of `observations` or `positions` of the objects of a share, in order.

    `row` is each one's row in the night's table.
    """
    parts = sorted(_folder(folder, name).glob("[0-9]*"), key=lambda part: int(part.name))
    tables = [read_part(part, name) for part in parts]
    ends = [np.searchsorted(array(table, "share"), [share, share + 1]) for table in tables]
    mine = [table.slice(a, b - a) for table, (a, b) in zip(tables, ends, strict=True)]
    return to_polars(concat(SHARED_OUT[name][name], mine)).drop("share")


def _folder(folder: Path, name: str) -> Path:
    return folder.with_name(f"{folder.name}-shared") / name


def _with_share(
    reader: NightReader, name: str, declared: PartTables, shares: int
) -> Iterator[pl.DataFrame]:
    """Yield the rows of a table that have an object, with its share, which follows from its id."""
    columns = [column for column in declared[name].names if column not in ("share", "row")]
    first, share_of = 0, dict[str, int]()
    for piece in reader.pieces(name, columns):
        rows = piece.with_row_index("row", first).filter(pl.col("object_id").is_not_null())
        first += len(piece)
        if rows.is_empty():
            continue
        for each in rows["object_id"].unique():
            share_of[each] = zlib.crc32(each.encode()) % shares
        share = pl.col("object_id").replace_strict(share_of, return_dtype=pl.Int64)
        yield rows.with_columns(share=share)


def _write(part: Path, name: str, declared: PartTables, pieces: list[pl.DataFrame]) -> None:
    rows = pl.concat(pieces).sort("share", maintain_order=True)
    write_part(part, declared, {name: from_polars(declared[name], rows)})
