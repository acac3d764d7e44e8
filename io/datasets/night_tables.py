"""The Parquet files of one night: written span by span, read piece by piece.

A night may have more rows than fit in memory. So its large tables are read in pieces, and only the
columns and times that are asked for.
"""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq

from epipole.io.datasets.table_pieces import (
    MAX_BYTES,
    read_pieces,
    unreadable,
    within_bounds,
)
from epipole.io.paths import file_system, shown_error, storage_errors
from epipole.schemas.arrays import Integers
from epipole.schemas.bridge import conform, to_polars
from epipole.schemas.errors import DatasetError
from epipole.schemas.tables import TABLES

# Reading.


class NightReader:
    """The tables of one night. A table that the night does not have is read as empty.

    Its functions raise `DatasetError` where a file cannot be read, or does not hold the table.
    """

    def __init__(self, where: str, night: str, files: Callable[[str], Sequence[Any]]) -> None:
        """`files` returns the Parquet files of a table: paths, or open files."""
        self.where, self.night, self._files = where, night, files

    @classmethod
    def of_folder(cls, folder: Path, night: str) -> "NightReader":
        """Return the night whose tables lie in this local folder."""
        return cls(str(folder), night, lambda table: sorted((folder / table).glob("*.parquet")))

    def read(
        self, table: str, columns: Sequence[str], between_ns: tuple[int, int] | None = None
    ) -> pl.DataFrame:
        """Return the rows of a table, all or of some time (see `pieces`): few, or few columns."""
        with self._as_dataset_errors(table):
            rows = within_bounds(self._pieces(table, columns, between_ns), MAX_BYTES)
            pieces = map(to_polars, rows)
            return pl.concat([self.empty(table, columns), *pieces])

    def pieces(
        self, table: str, columns: Sequence[str], between_ns: tuple[int, int] | None = None
    ) -> Iterator[pl.DataFrame]:
        """Yield the rows of a table, some at a time, in their order.

        Parameters
        ----------
        between_ns
            Only rows whose first column is a time from here to before there. Row groups of other
            times are not read. The rows are sorted by that column.
        """
        with self._as_dataset_errors(table):
            yield from map(to_polars, self._pieces(table, columns, between_ns))

    def _pieces(
        self, table: str, columns: Sequence[str], between_ns: tuple[int, int] | None = None
    ) -> Iterator[pa.Table]:
        schema = pa.schema([TABLES[table].field(name) for name in columns])
        time = None if between_ns is None else columns[0]
        for file in self._files(table):
            yield from read_pieces(file, schema, time, between_ns or (None, None))

    def count(self, table: str) -> int:
        """Return the number of rows of a table."""
        return sum(file.metadata.num_rows for file in self._opened(table))

    def metadata(self, table: str, key: str) -> str:
        """Return an entry of a table's metadata; '' if missing."""
        for file in self._opened(table):
            found = (file.schema_arrow.metadata or {}).get(key.encode(), b"")
            return str(found.decode("utf-8", "replace"))
        return ""

    def bounds_ns(self, table: str, column: str) -> tuple[int, int] | None:
        """Return the first and the last time of a table that is sorted by it; None: no rows."""
        ends: list[int] = []
        for file in self._opened(table):
            with self._as_dataset_errors(table):
                full = [k for k in range(file.num_row_groups) if _rows(file, k)]
                for group in {*full[:1], *full[-1:]}:
                    times = file.read_row_group(group, columns=[column])[column]
                    ends += [times[0].value, times[-1].value]
        return (min(ends), max(ends)) if ends else None

    def empty(self, table: str, columns: Sequence[str]) -> pl.DataFrame:
        """Return columns of a table, without rows."""
        return to_polars(TABLES[table].empty_table().select(list(columns)))

    def _opened(self, table: str) -> list[pq.ParquetFile]:
        with self._as_dataset_errors(table):
            return [pq.ParquetFile(file) for file in self._files(table)]

    @contextlib.contextmanager
    def _as_dataset_errors(self, table: str) -> Iterator[None]:
        try:
            yield
        except DatasetError:
            raise
        except (KeyError, pa.ArrowException, pl.exceptions.PolarsError) as error:
            raise unreadable(f"{self.where}/{table}", error) from error
        except storage_errors() as error:
            raise unreadable(f"{self.where}/{table}", error) from error


def _rows(file: pq.ParquetFile, group: int) -> int:
    count: int = file.metadata.row_group(group).num_rows
    return count


# Options of the files, chosen for fast queries over years.

ROWS_IN_GROUP = 1 << 17


def part_options(schema: pa.Schema) -> dict[str, Any]:
    """Return the options of `pyarrow.parquet.ParquetWriter` and `write_table` for a table.

    Measured values rarely repeat: what compresses is their exponents, apart from the other bytes
    (BYTE_STREAM_SPLIT), and the differences of whole numbers and times (DELTA_BINARY_PACKED).
    LZ4 reads at nearly the speed of memory; zstd takes twice the time and saves 7 % more. A
    dictionary costs as much again, and more for a column of distinct values such as `time`. Only
    names, epochs and stars repeat, so only they have a dictionary. Rows are sorted by time, so a
    query can skip the row groups of other times.
    """
    of_star = ("star_id", "magnitude") if "star_id" in schema.names else ()
    repeats = [f.name for f in schema if f.type == pa.string() or f.name in ("epoch", *of_star)]
    encoding = {
        f.name: "BYTE_STREAM_SPLIT" if pa.types.is_floating(f.type) else "DELTA_BINARY_PACKED"
        for f in schema
        if f.name not in repeats and (_is_whole(f.type) or pa.types.is_floating(f.type))
    }
    return {"compression": "lz4", "use_dictionary": repeats, "column_encoding": encoding}


def _is_whole(kind: pa.DataType) -> bool:
    """Return whether the values of a type are whole numbers of 32 or 64 bits, or times."""
    return pa.types.is_timestamp(kind) or kind in (pa.int32(), pa.int64())


# Writing a night that is not published yet: one file per table.

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


def rewrite_table(night: Path, name: str, pieces: Iterable[pa.Table]) -> int:
    """Write a table of a night again; the pieces may be made from its rows as they are.

    The rest is as of `write_table`. The file is replaced when the new one is complete.
    """
    beside = night.with_name(f"{night.name}-again")
    count = write_table(beside, name, pieces)
    try:
        (beside / name / PART).replace(night / name / PART)
    except OSError as error:
        raise DatasetError(f"{night / name}: cannot be written ({error.strerror})") from error
    return count


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
    """Return some columns of a table that `write_table` wrote.

    Raises
    ------
    DatasetError
        Where the file is missing or cannot be read.
    """
    with _opened(night, name) as file:
        return pq.read_table(file, columns=list(columns), partitioning=None)


def take_rows(night: Path, name: str, columns: Sequence[str], rows: Integers) -> pa.Table:
    """Return some rows of a table that `write_table` wrote; `rows` are in order."""
    file = pq.ParquetFile((night / name / PART).absolute())
    start, taken = 0, []
    for group in range(file.num_row_groups):
        end = start + file.metadata.row_group(group).num_rows
        inside = rows[(rows >= start) & (rows < end)] - start
        if len(inside):
            taken.append(file.read_row_group(group, columns=list(columns)).take(inside))
        start = end
    schema = TABLES[name]
    return pa.concat_tables(
        [pa.schema([schema.field(column) for column in columns]).empty_table(), *taken],
        promote_options="permissive",
    )


def count_rows(night: Where, name: str) -> int:
    """Return the number of rows of a table that `write_table` wrote; errors as `read_columns`."""
    with _opened(night, name) as file:
        rows: int = pq.read_metadata(file).num_rows
    return rows


@contextlib.contextmanager
def _opened(night: Where, name: str) -> Iterator[Any]:
    """Open a table's file. Of a URL only the ranges that are read are fetched."""
    try:
        if isinstance(night, Path):
            yield (night / name / PART).absolute()
            return
        storage, path = file_system(f"{night}/{name}/{PART}")
        storage.invalidate_cache()  # an earlier listing may be out of date
        with storage.open(path, cache_type="readahead") as file:
            yield file
    except DatasetError:
        raise
    except (KeyError, pa.ArrowException, *storage_errors()) as error:
        raise unreadable(f"{night}/{name}", error) from shown_error(error)
