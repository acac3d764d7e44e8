"""The work folder of a night. If the run is killed, the next run reuses its finished parts.

Its name has a digest of everything that its parts depend on (see `epipole.io.work.recipe`). So no
part in it can be out of date.
"""

import contextlib
import hashlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from epipole.io.caches.arrays import cache_folder
from epipole.io.caches.private_folders import fault_of, private_folder
from epipole.io.datasets.dataset import dataset_folder, lock_nights, locked_nights
from epipole.io.datasets.lock_record import STAGING
from epipole.io.datasets.plain_files import refuse_link
from epipole.schemas.dates import is_night
from epipole.schemas.errors import DatasetError

NAME = "work"


@contextlib.contextmanager
def work_folder(root: Path, night: str, key: str) -> Iterator[Path]:
    """Yield the folder for a night and this key. It is removed when the work succeeds.

    Folders of the same night under another key are removed: they were made from other logs,
    settings or code. The caller has locked the night. A folder that is a link is refused with
    a `DatasetError`.
    """
    name = f"{NAME}-{night}"
    for other in root.glob(f"{name}-*"):
        if other.name != f"{name}-{key}":
            shutil.rmtree(other, ignore_errors=True)
    folder = root / f"{name}-{key}"
    refuse_link(folder)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield folder
    except BaseException:
        with contextlib.suppress(OSError):
            folder.rmdir()  # nothing was finished
        raise
    shutil.rmtree(folder, ignore_errors=True)


def work_root(dataset: str) -> Path:
    """Return where a dataset's work folders lie: in it, or for a URL in the user's cache folder.

    Without a cache folder that can be trusted, it is a private temporary folder of this process.
    """
    folder = dataset_folder(dataset)
    if folder is not None:
        return folder / STAGING
    cache = cache_folder()
    root = cache / "work" if cache is not None else private_folder("work")
    if fault_of(root) is not None:
        root = private_folder("work")
    return root / hashlib.sha256(dataset.encode()).hexdigest()[:12]


# Unfinished work of stopped runs.


class Unfinished(NamedTuple):
    """The work folders of a night; `size` in bytes."""

    night: str
    size: int
    folders: list[Path]


def unfinished_work(dataset: str) -> list[Unfinished]:
    """Return the work that stopped runs have left, by night; that of living runs is skipped."""
    by_night: dict[str, list[Path]] = {}
    for folder in sorted(work_root(dataset).glob(f"{NAME}-*")):
        night = folder.name.removeprefix(f"{NAME}-")[: len("YYYY-MM-DD")]
        if is_night(night) and folder.is_dir() and not folder.is_symlink():
            by_night.setdefault(night, []).append(folder)
    for night in locked_nights(dataset) if by_night else ():
        by_night.pop(night, None)
    return [Unfinished(night, sum(map(_size, f)), f) for night, f in by_night.items()]


def clear_unfinished(dataset: str) -> list[Unfinished]:
    """Remove the work that stopped runs have left, and return what was removed.

    A night on which a run works is left alone.
    """
    removed = []
    for unfinished in unfinished_work(dataset):
        try:
            with lock_nights(dataset, [unfinished.night]):
                for folder in unfinished.folders:
                    shutil.rmtree(folder, ignore_errors=True)
        except DatasetError:  # a run has locked it meanwhile
            continue
        removed.append(unfinished)
    return removed


def _size(folder: Path) -> int:
    return sum(file.lstat().st_size for file in folder.rglob("*") if file.is_file())
