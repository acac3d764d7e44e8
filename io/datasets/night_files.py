"""The Parquet files of an unpublished night: one per table, written span by span."""

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from epipole.io.datasets.parquet_options import ROWS_IN_GROUP, part_options
from epipole.io.remote_files import file_system
from epipole.schemas.bridge import conform
from epipole.schemas.errors import DatasetError
from epipole.schemas.tables import TABLES

PART = "part-0.parquet"

Where = Path | str  # the folder of a night, or its URL


def write_table(night: Path, name: str, pieces: Iterable[pa.Table]) -> int:
    """Write a table of a night from pieces that follow one another in time.

    Parameters
    ----------
    night
        The night's folder. The table's folder is created in it.
    pieces
        Each sorted. Each makes at least one row group, so that a reader can skip other times.

    Returns
    -------
    int
        The number of rows.

    Raises
    ------
    DatasetError
        Where a file cannot be written.
    """
    folder = night / name
    try:
        return _write(folder, name, pieces)
    except OSError as error:
        raise DatasetError(
            f"{folder}: cannot be written ({error.strerror or error}); the dataset is unchanged"
        ) from error


def _write(folder: Path, name: str, pieces: Iterable[pa.Table]) -> int:
    # It exists where a worker was killed as it wrote: the task starts again, the file anew.
    folder.mkdir(parents=True, exist_ok=True)
    count = 0
    writer = None
    for rows in pieces:
        rows = conform(TABLES[name], rows)
        if rows.num_rows == 0:
            continue
        if writer is None:  # metadata of the rows that the schema does not have are kept
            writer = _writer(folder, rows.schema)
        writer.write_table(rows, ROWS_IN_GROUP)
        count += rows.num_rows
    if writer is None:
        writer = _writer(folder, TABLES[name])
    writer.close()
    return count


def _writer(folder: Path, schema: pa.Schema) -> pq.ParquetWriter:
    # Arrow takes a relative path such as http:/x for a URL.
    return pq.ParquetWriter((folder / PART).absolute(), schema, **part_options(schema))


def read_columns(night: Where, name: str, columns: Sequence[str]) -> pa.Table:
    """Return some columns of a table that `write_table` wrote."""
    with _opened(night, name) as file:
        return pq.read_table(file, columns=list(columns), partitioning=None)


def take_rows(
    night: Path, name: str, columns: Sequence[str], rows: npt.NDArray[np.int64]
) -> pa.Table:
    """Return some rows of a table that `write_table` wrote; `rows` are in order."""
    file = pq.ParquetFile((night / name / PART).absolute())
    start, taken = 0, []
    for group in range(file.num_row_groups):
        end = start + file.metadata.row_group(group).num_rows
        own = rows[(rows >= start) & (rows < end)] - start
        if len(own):
            taken.append(file.read_row_group(group, columns=list(columns)).take(own))
        start = end
    schema = TABLES[name]
    return pa.concat_tables(
        [pa.schema([schema.field(column) for column in columns]).empty_table(), *taken],
        promote_options="permissive",
    )


def count_rows(night: Where, name: str) -> int:
    """Return the number of rows of a table that `write_table` wrote."""
    with _opened(night, name) as file:
        rows: int = pq.read_metadata(file).num_rows
    return rows


@contextlib.contextmanager
def _opened(night: Where, name: str) -> Iterator[Any]:
    """Open a table's file. Of a URL only the ranges that are read are fetched."""
    if isinstance(night, Path):
        yield (night / name / PART).absolute()
        return
    storage, path = file_system(f"{night}/{name}/{PART}")
    storage.invalidate_cache()  # an earlier listing may be out of date
    with storage.open(path, cache_type="readahead") as file:
        yield file
