"""One night of a dataset, read piece by piece: only the columns and the times that are asked for.

A night may have more rows than fit in memory, so the large tables are read in pieces.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq

from epipole.io.datasets.table_pieces import MOST_BYTES, read_pieces, within_bounds
from epipole.io.remote_files import line_of, storage_errors
from epipole.schemas.bridge import to_polars
from epipole.schemas.errors import DatasetError
from epipole.schemas.tables import TABLES


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

    def read(self, table: str, columns: Sequence[str]) -> pl.DataFrame:
        """Return all rows of a table that is small, or of few columns."""
        with self._as_dataset_errors(table):
            pieces = map(to_polars, within_bounds(self._pieces(table, columns), MOST_BYTES))
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
        """Return an entry of a table's metadata; '' where it has none."""
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
            raise self._unreadable(table, error) from error
        except storage_errors() as error:
            raise self._unreadable(table, error) from error

    def _unreadable(self, table: str, error: Exception) -> DatasetError:
        return DatasetError(f"{self.where}/{table}: cannot be read ({line_of(error)})")


def _rows(file: pq.ParquetFile, group: int) -> int:
    count: int = file.metadata.row_group(group).num_rows
    return count
