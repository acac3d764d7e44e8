"""Datasets as polars tables."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import polars as pl
import pyarrow as pa

from epipole.io.datasets.dataset import check_folder, dataset_folder, nights_in, read_table
from epipole.io.paths import known_as
from epipole.schemas.bridge import empty
from epipole.schemas.columns import values_before
from epipole.schemas.errors import DatasetError
from epipole.schemas.tables import TABLES


class Dataset(Mapping[str, pl.LazyFrame]):
    """The tables of a dataset by their names, all nights together.

    Each table is a polars `LazyFrame` with the column `night` (a date) in addition. A filter on
    `night` reads the files of these nights only. A column that was added since a night was
    published is null there, or as the page of tables says.

    Attributes
    ----------
    nights : list of str
        The nights, ``YYYY-MM-DD``, in order.
    """

    def __init__(self, dataset: str | Path) -> None:
        self._where = dataset = known_as(str(dataset))
        self.nights = nights_in(dataset)

    def __getitem__(self, name: str) -> pl.LazyFrame:
        if name not in TABLES:
            raise KeyError(f"{name}: there is no such table; the tables are {', '.join(TABLES)}")
        rows: pa.Table = empty(TABLES[name])
        types = pl.DataFrame(rows).schema
        folder = dataset_folder(self._where)
        above = [] if folder is None else _columns_of(folder)
        if folder is None or not {"night", *types}.isdisjoint(above):
            return pl.concat([self._of_night(name, night) for night in self.nights])
        tables = [folder.absolute() / f"night={night}" / name for night in nights_in(self._where)]
        parts = [part for table in tables for part in sorted(table.glob("*.parquet"))]
        if not parts:
            return pl.LazyFrame(rows).with_columns(night=pl.lit(None, pl.Date))
        found = pl.scan_parquet(
            parts,
            schema=types,
            hive_schema={**dict.fromkeys(above, pl.String), "night": pl.Date},
            hive_partitioning=True,
            missing_columns="insert",
            extra_columns="ignore",
            glob=False,  # the name of a folder may have a * or [
        ).drop(above, strict=False)
        added = {k: value for k, value in values_before(rows.schema).items() if value is not None}
        return found.with_columns(
            pl.col(column).fill_null(pl.lit(value, types[column]))
            for column, value in added.items()
        )

    def _of_night(self, name: str, night: str) -> pl.LazyFrame:
        rows: pa.Table = pa.concat_tables(
            [empty(TABLES[name]), read_table(self._where, name, night)]
        )
        return pl.LazyFrame(rows).with_columns(night=pl.lit(night).str.to_date())

    def __iter__(self) -> Iterator[str]:
        return iter(TABLES)

    def __len__(self) -> int:
        return len(TABLES)

    def __repr__(self) -> str:
        return f"<{self._where}: {len(self.nights)} nights, tables {', '.join(TABLES)}>"


def _columns_of(folder: Path) -> list[str]:
    """Return the columns that polars makes of a folder's path: one of each part as site=a."""
    parts = folder.absolute().parts
    return [part.partition("=")[0] for part in parts if part.count("=") == 1]


def open_dataset(dataset: str | Path) -> Dataset:
    """Return the tables of a dataset: what `epipole run --out` wrote.

    Parameters
    ----------
    dataset
        A folder, or an fsspec URL such as ``s3://bucket/dataset``. Tables of a URL are read as a
        whole when they are asked for.

    Returns
    -------
    Dataset
        A mapping from the name of a table to a polars `LazyFrame`: units stand in the names of
        the columns, and the page of tables says what each one means.

    Raises
    ------
    DatasetError
        Where there is no dataset. It is a `ValueError`.

    Examples
    --------
    >>> from epipole.flows import api
    >>> tables = api.open_dataset("out/")
    >>> tables.nights
    ['2019-04-01']
    >>> positions = tables["positions"].collect()
    >>> positions["object_id"].n_unique()
    9
    """
    dataset = known_as(str(dataset))
    check_folder(dataset)
    found = Dataset(dataset)
    if not found.nights:
        raise DatasetError(
            f"{dataset}: holds no night; make one with `epipole run LOG --out {dataset}`"
        )
    return found
