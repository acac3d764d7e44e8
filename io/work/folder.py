"""The work folder of a night. If the run is killed, the next run reuses its finished parts.

Its name has a digest of everything that its parts depend on (see `epipole.io.work.recipe`). So no
part in it can be out of date. Parts of other runs that do not depend on what has changed are taken
from a second folder (see `epipole.io.work.kept_parts`).
"""

import contextlib
import hashlib
import logging
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from epipole.io.caches.arrays import cache_folder
from epipole.io.caches.private_folders import fault_of, private_folder
from epipole.io.datasets.dataset import dataset_folder, lock_nights, locked_nights
from epipole.io.datasets.lock_record import STAGING
from epipole.io.datasets.plain_files import refuse_link
from epipole.io.paths import bytes_in
from epipole.io.work.kept_parts import move_parts
from epipole.io.work.recipe import Recipe
from epipole.io.work.work_layout import WorkFolder
from epipole.schemas.dates import is_night
from epipole.schemas.errors import DatasetError

LOGGER = logging.getLogger(__name__)

NAME, KEPT = "work", "kept"


@contextlib.contextmanager
def work_folder(
    root: Path, night: str, recipe: Recipe, keep: bool = False, run: Iterable[str] = ()
) -> Iterator[WorkFolder]:
    """Yield the folder for a night and its recipe. It is removed when the work succeeds.

    Other folders of the night are removed: they were made from other logs, settings or code. Where
    only the logs differ, their parts are kept. The caller has locked the night. A folder that is a
    link is refused with a `DatasetError`.

    Parameters
    ----------
    keep
        Whether parts are kept, for a run with more logs, when the work succeeds.
    run
        The sensors and logs of the run; see `Recipe.work_key`.
    """
    made_with = recipe.made_with
    folder = root / f"{NAME}-{night}-{made_with}-{recipe.work_key(night, run)}"
    kept = root / f"{KEPT}-{night}-{made_with}"
    mine = {folder, kept}
    for path in mine:
        refuse_link(path)
    folder.mkdir(parents=True, exist_ok=True)
    for other in {*root.glob(f"{NAME}-{night}-*"), *root.glob(f"{KEPT}-{night}-*")} - mine:
        if other.name.startswith(f"{NAME}-{night}-{made_with}-") and not other.is_symlink():
            move_parts(other, kept)
        shutil.rmtree(other, ignore_errors=True)
    n_kept = len(list(kept.glob("*")))
    try:
        yield WorkFolder(folder, kept)
    except BaseException:
        with contextlib.suppress(OSError):
            folder.rmdir()  # nothing was finished
        raise
    if n_kept:
        n_used = n_kept - len(list(kept.glob("*")))
        LOGGER.info("used %d of %d parts of a run before", n_used, n_kept)
    shutil.rmtree(kept, ignore_errors=True)  # what could not be used
    if keep:
        move_parts(folder, kept)
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
    return root / hashlib.sha256(dataset.rstrip("/").encode()).hexdigest()[:12]


# Unfinished work of stopped runs.


class Unfinished(NamedTuple):
    """The work folders of a night; `size` in bytes."""

    night: str
    size: int
    folders: list[Path]


def unfinished_work(dataset: str, kept: bool = False) -> list[Unfinished]:
    """Return the work that stopped runs have left, by night; that of living runs is skipped.

    With `kept`, work that is kept (see `work_folder`) is counted too.
    """
    by_night: dict[str, list[Path]] = {}
    for folder in sorted(work_root(dataset).glob("*-*")):
        name, _, rest = folder.name.partition("-")
        night = rest[: len("YYYY-MM-DD")]
        if name not in ((NAME, KEPT) if kept else (NAME,)):
            continue
        if is_night(night) and folder.is_dir() and not folder.is_symlink():
            by_night.setdefault(night, []).append(folder)
    for night in locked_nights(dataset) if by_night else ():
        by_night.pop(night, None)
    return [Unfinished(night, sum(map(bytes_in, f)), f) for night, f in by_night.items()]


def clear_unfinished(dataset: str, kept: bool = False) -> list[Unfinished]:
    """Remove the work that stopped runs have left, and return what was removed.

    A night on which a run works is left alone. `kept` as for `unfinished_work`.

    Raises
    ------
    DatasetError
        Where something cannot be removed.
    """
    removed = []
    for unfinished in unfinished_work(dataset, kept):
        try:
            with lock_nights(dataset, [unfinished.night]):
                for folder in unfinished.folders:
                    shutil.rmtree(folder, ignore_errors=True)
                    if folder.exists():
                        raise DatasetError(f"{folder}: cannot be removed; see who may write to it")
        except DatasetError:
            if unfinished.night in locked_nights(dataset):  # a run has locked it meanwhile
                continue
            raise
        removed.append(unfinished)
    return removed
