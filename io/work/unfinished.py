"""Unfinished work: what stopped runs have left for the next run of their night."""

import shutil
from pathlib import Path
from typing import NamedTuple

from epipole.io.datasets.dataset import claim_nights, dataset_folder
from epipole.io.datasets.local_nights import claimed_nights
from epipole.io.work.folder import NAME, work_root
from epipole.schemas.dates import is_night
from epipole.schemas.errors import DatasetError


class Unfinished(NamedTuple):
    """The work folders of a night; `size` in bytes."""

    night: str
    size: int
    folders: list[Path]


def unfinished_work(dataset: str) -> list[Unfinished]:
    """Return the work that stopped runs have left, by night; not that of runs that go on."""
    local = dataset_folder(dataset)
    held = claimed_nights(local) if local is not None else set()
    by_night: dict[str, list[Path]] = {}
    for folder in sorted(work_root(dataset).glob(f"{NAME}-*")):
        night = folder.name.removeprefix(f"{NAME}-")[: len("YYYY-MM-DD")]
        is_work = is_night(night) and folder.is_dir() and not folder.is_symlink()
        if is_work and night not in held:
            by_night.setdefault(night, []).append(folder)
    return [Unfinished(night, sum(map(_size, f)), f) for night, f in by_night.items()]


def clear_unfinished(dataset: str) -> list[Unfinished]:
    """Remove the work that stopped runs have left, and return what was removed.

    A night on which a run works is left alone.
    """
    removed = []
    for unfinished in unfinished_work(dataset):
        try:
            with claim_nights(dataset, [unfinished.night]):
                for folder in unfinished.folders:
                    shutil.rmtree(folder, ignore_errors=True)
        except DatasetError:  # a run has claimed it meanwhile
            continue
        removed.append(unfinished)
    return removed


def _size(folder: Path) -> int:
    return sum(file.lstat().st_size for file in folder.rglob("*") if file.is_file())
