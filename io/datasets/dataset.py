"""Datasets: a folder a night, a folder a table, published night by night.

``DATASET/night=YYYY-MM-DD/<table>/part-0.parquet``, in a local folder (`local_nights`: put in
place by one rename) or behind an fsspec URL such as ``s3://bucket/dataset`` (`store_nights`:
committed by one object). A reader never sees half a night, and a run that fails or is killed
leaves the dataset as it was.
"""

import contextlib
import datetime
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from epipole.io.datasets import local_nights
from epipole.io.datasets.folder_swap import sync
from epipole.io.datasets.local_nights import STAGING
from epipole.io.datasets.store_nights import StoreNights, store_nights
from epipole.io.remote_files import line_of, storage_errors
from epipole.schemas.bridge import array, conform, empty
from epipole.schemas.columns import TIME
from epipole.schemas.errors import DatasetError
from epipole.schemas.tables import TABLES

DAY_NS = 86_400_000_000_000

# The column that says to which night a row belongs; the rest have `time`. Calibrations and
# sources are of a whole night, not of an instant.
_NIGHT_COLUMN = {"tracklets": "start_time"}
_WHOLE_NIGHT = {"calibrations", "sources"}


Where = Path | str


def check_folder(dataset: Where) -> None:
    """Raise unless a dataset is here, or can be made here.

    Raises
    ------
    DatasetError
        Where it is a file, or a folder that holds other things than a dataset.
    """
    if (store := _store(dataset)) is not None:
        with _read(dataset):
            names = store.names()
    else:
        try:
            folder = _folder(dataset)
            if folder.exists() and not folder.is_dir():
                raise DatasetError(f"{dataset}: is a file, not a folder; give another --out")
            names = [entry.name for entry in folder.iterdir()] if folder.is_dir() else []
        except OSError as error:
            raise DatasetError(f"{dataset}: {error.strerror}; give another --out") from error
    if names and not any(name == STAGING or name.startswith("night=") for name in names):
        raise DatasetError(
            f"{dataset}: holds other files and no dataset (no night=... folder); "
            "give an empty folder or a dataset"
        )


def nights_in(dataset: Where) -> list[str]:
    """Return the nights of a dataset, ``YYYY-MM-DD``, in order; none where there is no dataset."""
    if (store := _store(dataset)) is not None:
        with _read(dataset):
            return store.nights()
    return sorted(p.name.removeprefix("night=") for p in _folder(dataset).glob("night=*"))


def check_sources(dataset: Where, nights: Sequence[str], sources: pa.Table, replace: bool) -> None:
    """Raise where a night was made of a log that is not among these sources.

    Raises
    ------
    DatasetError
        Names the logs; not raised with `replace`.
    """
    if replace:
        return
    given = set(sources["sha256"].to_pylist())
    for night in nights:
        recorded = read_table(dataset, "sources", night).select(["name", "sha256"])
        missing = [row["name"] for row in recorded.to_pylist() if row["sha256"] not in given]
        if missing:
            raise DatasetError(
                f"{dataset}/night={night}: was also made of {', '.join(missing)}; "
                "give all logs of the night, or --replace to publish it without"
            )


def read_table(dataset: Where, table: str, night: str) -> pa.Table:
    """Return a table of a night; with no rows where the night is not there.

    Raises
    ------
    DatasetError
        Where its files cannot be read as this table.
    """
    schema = TABLES[table]
    if (store := _store(dataset)) is not None:
        with _read(dataset):
            parts: Sequence[Any] = [pa.BufferReader(part) for part in store.read(night, table)]
    else:
        parts = sorted((_folder(dataset) / f"night={night}" / table).glob("*.parquet"))
    try:
        rows = [conform(schema, pq.read_table(part, partitioning=None)) for part in parts]
    except (OSError, ValueError) as error:
        raise DatasetError(
            f"{dataset}/night={night}/{table}: cannot be read ({error}); "
            "remove the night's folder and run it again"
        ) from error
    return pa.concat_tables([empty(schema), *rows])


@contextlib.contextmanager
def claim_nights(dataset: Where, nights: Sequence[str]) -> Iterator[Path]:
    """Keep other runs off these nights while this one works on them.

    Yields
    ------
    Path
        An empty folder of this run's own, on the dataset's file system: what is staged in it
        can be put in place by a rename. It is removed at the end. What a run that was killed
        has left there is removed by the next one.

    Raises
    ------
    DatasetError
        Where another run is at work on one of the nights (names the night, the process, its
        host and since when), the folder is no dataset, or it cannot be written.
    """
    check_folder(dataset)
    with contextlib.ExitStack() as held:
        with _written(dataset):
            if (store := _store(dataset)) is not None:
                held.enter_context(store.claims.claim(nights))
                work = Path(held.enter_context(tempfile.TemporaryDirectory(prefix="epipole-")))
            else:
                work = held.enter_context(local_nights.claim(_folder(dataset), nights))
        yield work


def publish_folders(
    dataset: Where, staged: Mapping[str, Path], sources: pa.Table, replace: bool = False
) -> None:
    """Put whole nights in place: all of them, or none.

    Parameters
    ----------
    staged
        By night, ``YYYY-MM-DD``, a folder that holds every table: ``<table>/*.parquet``. It
        lies on the dataset's file system (see `claim_nights`) and is gone afterwards.
    sources
        The logs that the nights were made of.
    replace
        Publish a night even though it was made of a log that is not among `sources`.

    Raises
    ------
    DatasetError
        Where a recorded log is missing or the disk refuses. The dataset is then as it was.
        While another run publishes here, this one waits.
    """
    check_folder(dataset)
    for folder in staged.values():
        _require_whole(folder)
    nights = list(staged)
    with _written(dataset):
        if (store := _store(dataset)) is not None:
            with store.claims.claim(store.claims.missing(nights)):
                store.recover()
                check_sources(dataset, nights, sources, replace)
                store.publish(staged)
            return
        for folder in staged.values():
            for path in [*folder.rglob("*"), folder]:
                sync(path)
        with local_nights.alone(_folder(dataset)):
            check_sources(dataset, nights, sources, replace)
            local_nights.put_all_in_place(_folder(dataset), staged)


def _require_whole(folder: Path) -> None:
    missing = [name for name in TABLES if not any((folder / name).glob("*.parquet"))]
    if missing:
        raise ValueError(f"{folder}: is no whole night, without {', '.join(missing)}")


def _store(dataset: Where) -> StoreNights | None:
    """Return the object store that a URL names; None: it is a local folder."""
    where = str(dataset)
    return store_nights(where) if "://" in where and not where.startswith("file://") else None


def dataset_folder(dataset: Where) -> Path | None:
    """Return the local folder of a dataset; None: it is a URL of an object store."""
    return _folder(dataset) if _store(dataset) is None else None


def _folder(dataset: Where) -> Path:
    return Path(unquote(urlsplit(str(dataset)).path)) if "://" in str(dataset) else Path(dataset)


@contextlib.contextmanager
def _written(dataset: Where) -> Iterator[None]:
    """Have what the system says of a write told as an error of the dataset."""
    kinds = (OSError,) if _store(dataset) is None else storage_errors()
    try:
        yield
    except DatasetError:
        raise
    except kinds as error:
        reason = getattr(error, "strerror", None) or line_of(error)
        raise DatasetError(
            f"{dataset}: cannot be written ({reason}); nothing was changed"
        ) from error


@contextlib.contextmanager
def _read(dataset: Where) -> Iterator[None]:
    try:
        yield
    except DatasetError:
        raise
    except storage_errors() as error:
        raise DatasetError(f"{dataset}: cannot be read: {line_of(error)}") from error


def nights_of(time_ns: np.ndarray) -> list[str]:
    """Return the UTC dates, ``YYYY-MM-DD``, in which these instants lie, in order."""
    return [_date(day) for day in np.unique(time_ns // DAY_NS)]


def rows_of_night(name: str, rows: pa.Table, night: str) -> pa.Table:
    """Return the rows of a table that belong to a night.

    A row belongs to the UTC date of its epoch where it has one, of its time otherwise; a
    log to every night between its first and last frame; a calibration to all.
    """
    day = _day(night)
    if name == "sources":
        first, last = array(rows, "first_time") // DAY_NS, array(rows, "last_time") // DAY_NS
        return rows.filter(pa.array((first <= day) & (day <= last)))
    if name in _WHOLE_NIGHT:
        return rows
    column = "epoch" if "epoch" in rows.column_names else _NIGHT_COLUMN.get(name, "time")
    return rows.filter(pa.array(array(rows, column) // DAY_NS == day))


def in_order(rows: pa.Table) -> pa.Table:
    """Return the rows sorted by time, then by the columns that identify them.

    Rows that agree in all of these keep their order.
    """
    times = [field.name for field in rows.schema if field.type == TIME]
    keys = [f.name for f in rows.schema if pa.types.is_integer(f.type) or f.type == pa.string()]
    by = [(name, "ascending") for name in (*times, *keys)]
    return rows.take(pc.sort_indices(rows, sort_keys=by)) if rows.num_rows else rows


def _day(night: str) -> int:
    return (datetime.date.fromisoformat(night) - datetime.date(1970, 1, 1)).days


def _date(day: int) -> str:
    return (datetime.date(1970, 1, 1) + datetime.timedelta(days=int(day))).isoformat()
