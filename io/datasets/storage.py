"""Where a dataset is stored: in a local folder or in an object store, behind one protocol."""

import contextlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import unquote, urlsplit

from epipole.io.datasets.local import LocalNights
from epipole.io.datasets.object_store import store_nights
from epipole.io.paths import known_as, line_of, shown_error, storage_errors
from epipole.schemas.errors import DatasetError

Where = Path | str


class NightStorage(Protocol):
    """The nights of one dataset. Methods raise `DatasetError`, or one of `errors`."""

    @property
    def folder(self) -> Path | None:
        """The folder of the dataset. None: it is in an object store."""

    def errors(self) -> tuple[type[Exception], ...]:
        """Return the errors of this kind of storage."""

    def names(self) -> list[str]:
        """Return the names at the top of the dataset."""

    def exists(self) -> bool:
        """Return whether there is a dataset, which may be empty."""

    def nights(self) -> list[str]:
        """Return the published nights, ``YYYY-MM-DD``, in order."""

    def tables(self, night: str) -> set[str]:
        """Return the names of the tables that a night has files of."""

    def files(self, night: str, table: str) -> Sequence[Any]:
        """Return the files of a table of a night, as pyarrow reads them: all of one version."""

    def open_files(self, night: str, table: str) -> Sequence[Any]:
        """Return the same for a reader that needs only parts of them."""

    def location(self, night: str) -> Where:
        """Return the folder of a night, or its URL."""

    def write_beside(self, folder: str, name: str, data: bytes) -> None:
        """Write a file into a folder beside the nights, or replace it, at once."""

    def remove_beside(self, folder: str, name: str) -> None:
        """Remove such a file, if it exists."""

    def files_beside(self, folder: str, nights: Collection[str] | None = None) -> Sequence[Any]:
        """Return the Parquet files in a folder beside the nights, as pyarrow reads them.

        Each has the name of a night. None: of all nights.
        """

    def sizes(self) -> dict[str, int]:
        """Return the bytes of each night (``night=DATE``), and of each file beside the nights."""

    def remove(self, name: str, run: Path) -> None:
        """Remove what `sizes` names; `run` is the folder of this run."""

    def lock_nights(self, nights: Sequence[str]) -> contextlib.AbstractContextManager[Path]:
        """Lock nights for this run, and yield an empty folder for it; see `dataset.lock_nights`."""

    def locked_nights(self) -> set[str]:
        """Return the nights that living runs have locked."""

    def recover(self) -> None:
        """Finish what stopped runs have committed, except on nights that another run has locked."""

    def publish(self, staged: Mapping[str, Path], check: Callable[[], None]) -> None:
        """Put the folders of nights in place, all or none.

        `check` is called before, when no other run can publish these nights; what it raises ends
        the publication.
        """


def night_storage(dataset: Where) -> NightStorage:
    """Return the storage of a dataset: by its URL, or the folder that a path or file URL names."""
    where = str(dataset)
    if "://" not in where:
        return LocalNights(Path(dataset), where)
    if where.startswith("file://"):
        return LocalNights(Path(unquote(urlsplit(where).path)), where)
    with reading(dataset, storage_errors):
        return store_nights(known_as(where))


@contextlib.contextmanager
def reading(dataset: Where, errors: Callable[[], tuple[type[Exception], ...]]) -> Iterator[None]:
    """Turn errors of reading into `DatasetError`."""
    try:
        yield
    except DatasetError:
        raise
    except errors() as error:
        raise DatasetError(f"{dataset}: cannot be read: {line_of(error)}") from shown_error(error)
