"""Datasets: one folder per night, with one folder per table, published night by night.

The layout is ``DATASET/night=YYYY-MM-DD/<table>/part-0.parquet``. A dataset is a local folder
(`local`: a night is put in place by one rename) or it is behind an fsspec URL such as
``s3://bucket/dataset`` (`object_store`: nights are committed by one object). A reader never sees
half a night. A run that fails or is killed leaves the dataset unchanged.
"""

import contextlib
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa

from epipole.io.datasets.local import REPORTS, RUNS
from epipole.io.datasets.lock_record import STAGING
from epipole.io.datasets.night_tables import NightReader
from epipole.io.datasets.storage import NightStorage, Where, night_storage, reading
from epipole.io.datasets.table_pieces import Between, read_pieces, unreadable
from epipole.io.paths import fault_of_name, line_of
from epipole.schemas.bridge import conform
from epipole.schemas.errors import DatasetError
from epipole.schemas.spans import Span
from epipole.schemas.tables import TABLES


def check_folder(dataset: Where) -> None:
    """Raise unless this is a dataset, or a dataset can be created here.

    Raises
    ------
    DatasetError
        Where it is a file, or a folder with other contents than a dataset.
    """
    if (fault := fault_of_name(str(dataset))) is not None:
        raise DatasetError(f"dataset {dataset}: {fault}")
    storage = night_storage(dataset)
    with reading(dataset, storage.errors):
        names = storage.names()
    if names and not any(n in (STAGING, REPORTS, RUNS) or n.startswith("night=") for n in names):
        raise DatasetError(
            f"{dataset}: holds other files and no dataset (no night=... folder); "
            "give an empty folder or a dataset"
        )


def require_dataset(dataset: Where) -> None:
    """Raise where there is no dataset, not even an empty one.

    Raises
    ------
    DatasetError
        As `check_folder`, and where the folder is missing.
    """
    check_folder(dataset)
    if not night_storage(dataset).exists():
        raise DatasetError(f"{dataset}: no such folder; check the path")


def nights_in(dataset: Where) -> list[str]:
    """Return the nights of a dataset, ``YYYY-MM-DD``, in order. A missing dataset has no nights.

    Folders whose names have no such date are skipped.
    """
    storage = night_storage(dataset)
    with reading(dataset, storage.errors):
        return storage.nights()


def check_sources(dataset: Where, nights: Sequence[str], sources: pa.Table, replace: bool) -> None:
    """Raise where a published night was made from a log that is not among these sources.

    A changed log of the same name that is not smaller is that log: it was still being written, or
    copied. A log that is recorded itself never stands for another one.

    Raises
    ------
    DatasetError
        Names the missing logs. With `replace` it is not raised.
    """
    if replace:
        return
    columns = ["name", "size", "sha256"]
    recorded = {
        night: read_table(dataset, "sources", night, columns).to_pylist() for night in nights
    }
    known = {row["sha256"] for rows in recorded.values() for row in rows}
    rows = sources.select(columns).to_pylist()
    given = {row["sha256"] for row in rows}
    changed = [row for row in rows if row["sha256"] not in known]
    for night in nights:
        gone = [row for row in recorded[night] if row["sha256"] not in given]
        if missing := _not_among(gone, changed):
            raise DatasetError(
                f"{dataset}/night={night}: was also made from {', '.join(missing)}; "
                "give all logs of the night, or --replace to publish it without them"
            )


def _not_among(gone: Sequence[dict[str, Any]], changed: Sequence[dict[str, Any]]) -> list[str]:
    """Return the names of the logs of which none of these is a later form, each of one at most."""
    sizes: dict[str, list[int]] = {}
    for row in sorted(changed, key=lambda row: row["size"]):
        sizes.setdefault(row["name"], []).append(row["size"])
    missing = []
    for row in sorted(gone, key=lambda row: (row["name"], row["size"])):
        larger = sizes.get(row["name"], [])
        fit = next((size for size in larger if size >= row["size"]), None)
        if fit is None:
            missing.append(row["name"])
        else:
            larger.remove(fit)
    return missing


def read_table(
    dataset: Where,
    table: str,
    night: str,
    columns: Sequence[str] | None = None,
    during: Span | None = None,
) -> pa.Table:
    """Return a table of a night. It has no rows where the night is missing.

    Columns that were added since the night was published are null, or what their declaration says.

    Parameters
    ----------
    columns
        Names of those to read; None: all.
    during
        Rows of other epochs are left out, or of other times where the table has no epochs.

    Raises
    ------
    DatasetError
        Where its files cannot be read, or do not hold this table.
    """
    names = list(columns or TABLES[table].names)
    between_ns = None if during is None else (during.start_ns, during.end_ns)
    pieces = table_pieces(dataset, table, night, names, between_ns)
    return pa.concat_tables([_schema(table, names).empty_table(), *pieces])


def table_pieces(
    dataset: Where,
    table: str,
    night: str,
    columns: Sequence[str],
    between_ns: Between | None = None,
) -> Iterator[pa.Table]:
    """Yield the rows of a table of a night, some at a time; none where the night is missing.

    Parameters
    ----------
    between_ns
        Rows of other epochs are left out, or of other times where the table has no epochs.

    Raises
    ------
    DatasetError
        As `read_table`.
    """
    schema = _schema(table, columns)
    time = None
    if between_ns is not None:
        time = "epoch" if "epoch" in TABLES[table].names else "time"
    wanted = schema if time is None or time in columns else schema.append(TABLES[table].field(time))
    storage = night_storage(dataset)
    with reading(dataset, storage.errors):
        parts = storage.files(night, table)
    try:
        for part in parts:
            for rows in read_pieces(part, wanted, time, between_ns or (None, None)):
                yield conform(schema, rows)
    except (OSError, ValueError, pa.ArrowException) as error:
        raise unreadable(f"{dataset}/night={night}/{table}", error) from error


def _schema(table: str, columns: Sequence[str]) -> pa.Schema:
    schema = TABLES[table]
    return pa.schema([schema.field(name) for name in columns], schema.metadata)


def night_row(dataset: Where, night: str) -> dict[str, Any] | None:
    """Return the row of a night in its table `nights`; None if missing.

    Raises
    ------
    DatasetError
        As `read_table`; also where it has several.
    """
    found = None
    for rows in table_pieces(dataset, "nights", night, TABLES["nights"].names):
        if found is not None or rows.num_rows > 1:
            raise DatasetError(
                f"{dataset}/night={night}/nights: has several rows, expected one; "
                "remove the folder of the night and run the night again"
            )
        (found,) = rows.to_pylist()
    return found


def missing_tables(dataset: Where, night: str) -> list[str]:
    """Return the tables that a night has no file of: made by an older version, or damaged."""
    storage = night_storage(dataset)
    with reading(dataset, storage.errors):
        present = storage.tables(night)
    return [name for name in TABLES if name not in present]


def night_location(dataset: Where, night: str) -> Where:
    """Return the folder of a night; of a dataset in a store, its URL."""
    return night_storage(dataset).location(night)


def report_location(dataset: str, night: str) -> str:
    """Return where the report of a night lies, if there is one."""
    return f"{dataset.rstrip('/')}/{REPORTS}/{night}.html"


def dataset_folder(dataset: Where) -> Path | None:
    """Return the local folder of a dataset. None: it is in an object store."""
    return night_storage(dataset).folder


def locked_nights(dataset: Where) -> set[str]:
    """Return the nights that living runs have locked."""
    storage = night_storage(dataset)
    with reading(dataset, storage.errors):
        return storage.locked_nights()


def night_reader(dataset: Where, night: str) -> NightReader:
    """Return a published night, to be read piece by piece."""
    storage = night_storage(dataset)
    files = partial(storage.open_files, night)
    return NightReader(str(storage.location(night)), night, files)


def write_beside(dataset: Where, folder: str, name: str, data: bytes) -> None:
    """Write a file into a folder beside the nights of a dataset that exists, or replace it.

    Raises
    ------
    DatasetError
        Where it cannot be written.
    """
    storage = night_storage(dataset)
    with _writing(dataset, storage):
        if storage.exists():
            storage.write_beside(folder, name, data)


def remove_beside(dataset: Where, folder: str, name: str) -> None:
    """Remove a file in a folder beside the nights of a dataset, if it exists.

    Raises
    ------
    DatasetError
        Where it cannot be removed.
    """
    storage = night_storage(dataset)
    with _writing(dataset, storage):
        storage.remove_beside(folder, name)


def read_beside(
    dataset: Where, folder: str, schema: pa.Schema, nights: Collection[str] | None = None
) -> list[dict[str, Any]]:
    """Return the rows of the Parquet files in a folder beside the nights; of all, or of some.

    Files that do not have this schema are left out.
    """
    storage = night_storage(dataset)
    rows = []
    with reading(dataset, storage.errors):
        files = storage.files_beside(folder, nights)
    for file in files:
        with contextlib.suppress(OSError, ValueError, pa.ArrowException):
            rows += [row for piece in read_pieces(file, schema) for row in piece.to_pylist()]
    return rows


def sizes(dataset: Where) -> dict[str, int]:
    """Return the bytes of each night (``night=DATE``), and of its files in `reports` and `runs`."""
    storage = night_storage(dataset)
    with reading(dataset, storage.errors):
        return storage.sizes()


def remove(dataset: Where, names: Sequence[str]) -> None:
    """Remove nights and files that `sizes` names; a reader meets whole nights or none.

    Raises
    ------
    DatasetError
        Where a run works on one of the nights, or something cannot be removed.
    """
    nights = [name.removeprefix("night=") for name in names if name.startswith("night=")]
    storage = night_storage(dataset)
    with lock_nights(dataset, nights) as run, _writing(dataset, storage):
        for name in names:
            storage.remove(name, run)


@contextlib.contextmanager
def lock_nights(dataset: Where, nights: Sequence[str]) -> Iterator[Path]:
    """Lock these nights for this run: no other run can work on them.

    Yields
    ------
    Path
        An empty folder for this run, on the dataset's file system, so that a folder staged in it
        can be put in place by a rename. It is removed at the end. The folder of a killed run is
        removed by the next run.

    Raises
    ------
    DatasetError
        Where another run works on one of the nights (the message names the night, the process,
        its host and its start), the folder is not a dataset, or it cannot be written.
    """
    check_folder(dataset)
    storage = night_storage(dataset)
    with contextlib.ExitStack() as stack:
        with _writing(dataset, storage):
            work = stack.enter_context(storage.lock_nights(nights))
        yield work


def finish_publication(dataset: Where) -> None:
    """Put the files in place of nights that a run has published and not finished.

    Readers of a store take such nights from where they are staged; other programs do not.

    Raises
    ------
    DatasetError
        Where they cannot be put in place.
    """
    storage = night_storage(dataset)
    with _writing(dataset, storage):
        storage.recover()


def publish_folders(
    dataset: Where, staged: Mapping[str, Path], sources: pa.Table, replace: bool = False
) -> None:
    """Put whole nights in place: all or none.

    Parameters
    ----------
    staged
        For each night, ``YYYY-MM-DD``, a folder with every table: ``<table>/*.parquet``. It lies
        on the dataset's file system (see `lock_nights`) and is moved from there.
    sources
        The logs that the nights were made from.
    replace
        Replace a night even if it was made from a log that is not among `sources`.

    Raises
    ------
    DatasetError
        Where a recorded log is missing or a file cannot be written. The dataset is then
        unchanged.

    Notes
    -----
    Waits while another run publishes to the same dataset.
    """
    check_folder(dataset)
    for folder in staged.values():
        _require_whole(folder)
    nights = list(staged)
    storage = night_storage(dataset)
    with _writing(dataset, storage):
        storage.publish(staged, check=lambda: check_sources(dataset, nights, sources, replace))


def _require_whole(folder: Path) -> None:
    missing = [name for name in TABLES if not any((folder / name).glob("*.parquet"))]
    if missing:
        raise ValueError(f"{folder}: is not a whole night: {', '.join(missing)} missing")


@contextlib.contextmanager
def _writing(dataset: Where, storage: NightStorage) -> Iterator[None]:
    """Turn errors of writing into `DatasetError`."""
    try:
        yield
    except DatasetError:
        raise
    except storage.errors() as error:
        reason = getattr(error, "strerror", None) or line_of(error)
        where = getattr(error, "filename", None)
        if where is not None and STAGING in Path(os.fsdecode(where)).parts:
            reason = f"{os.fsdecode(where)}: {reason}"
        raise DatasetError(
            f"{dataset}: cannot be written ({reason}); the dataset is unchanged"
        ) from error
