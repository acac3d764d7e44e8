"""Nights in a local folder: claimed by a lock, put in place by a rename, recovered after a kill.

Unfinished work lies in ``DATASET/.staging``:

- ``lock``: held briefly by a run that changes the staging folder or puts nights in place;
- ``run-*/``: the folder of one run. Its file ``claim`` is locked as long as the run lives, and
  names the nights that the run works on;
- ``swap-*/``: nights that are being replaced.

The kernel releases a lock when its process ends, however it ends. So a claim that can be locked
belongs to a run that has ended, and the next run removes its folder.
"""

import contextlib
import fcntl
import os
import shutil
import stat
import uuid
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from epipole.io.datasets.folder_swap import put_in_place, sync, take_back
from epipole.io.datasets.night_holder import Holder

STAGING = ".staging"
CLAIM = "claim"


@contextlib.contextmanager
def claim(dataset: Path, nights: Sequence[str]) -> Iterator[Path]:
    """Reserve these nights, and yield a folder for this run on the dataset's file system.

    Raises
    ------
    DatasetError
        Where a living run has claimed one of them. The message names the run.
    OSError
        Where the folder cannot be written.
    """
    made = not dataset.exists()
    dataset.mkdir(parents=True, exist_ok=True)
    try:
        with _locked(dataset) as staging:
            _clear(dataset, staging)
            for claimed in staging.glob(f"run-*/{CLAIM}"):
                Holder.read(claimed.read_text()).refuse(dataset, nights)
            run = staging / f"run-{os.getpid()}-{uuid.uuid4().hex[:8]}"
            run.mkdir()
            held = (run / CLAIM).open("w")
            fcntl.flock(held, fcntl.LOCK_EX)
            held.write(Holder.of(nights).text())
            held.flush()
        try:
            yield run
        finally:
            with _locked(dataset), held:
                shutil.rmtree(run, ignore_errors=True)
    finally:
        if made:
            with contextlib.suppress(OSError):  # not empty if nights were published
                dataset.rmdir()


def put_all_in_place(dataset: Path, staged: Mapping[str, Path]) -> None:
    """Make these folders the nights of a dataset, each by one rename: all or none.

    Must be called inside `alone`.

    Raises
    ------
    OSError
        Where a rename fails; the dataset and the folders are then unchanged.
    """
    aside = dataset / STAGING / f"swap-{uuid.uuid4().hex[:8]}"
    aside.mkdir()
    done: list[str] = []
    try:
        for night, folder in staged.items():
            name = f"night={night}"
            put_in_place(folder, dataset / name, aside / f"old-{name}")
            done.append(name)
        sync(dataset)
    except BaseException:
        for name in reversed(done):
            take_back(dataset / name, aside / f"old-{name}", staged[name.removeprefix("night=")])
        raise
    finally:
        shutil.rmtree(aside, ignore_errors=True)


@contextlib.contextmanager
def alone(dataset: Path) -> Iterator[None]:
    """Wait until no other run publishes here, and keep others out. Clear what killed runs left."""
    with _locked(dataset) as staging:
        _clear(dataset, staging)
        yield


@contextlib.contextmanager
def _locked(dataset: Path) -> Iterator[Path]:
    staging = dataset / STAGING
    path = staging / "lock"
    while True:
        with contextlib.suppress(FileNotFoundError):  # the last holder has just removed the folder
            try:
                staging.mkdir(parents=True, exist_ok=True)
            except FileExistsError:  # `mkdir` looks twice: it was removed in between, or is a file
                if stat.S_ISDIR(staging.lstat().st_mode):
                    continue
                raise
            lock = path.open("w")
            fcntl.flock(lock, fcntl.LOCK_EX)
            if path.exists() and os.path.samestat(os.fstat(lock.fileno()), path.stat()):
                break
            lock.close()
    try:
        yield staging
    finally:
        # The file is removed while it is locked. A waiting process notices this in the loop above.
        path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # not empty if another run has its folder there
            staging.rmdir()
        lock.close()


def _clear(dataset: Path, staging: Path) -> None:
    """Remove what killed runs left. A night that was moved away but not replaced goes back.

    The caller holds the lock, so no living run is replacing the nights in `swap-*`.
    """
    for swap in staging.glob("swap-*"):
        for old in swap.glob("old-night=*"):
            target = dataset / old.name.removeprefix("old-")
            if not target.exists():
                old.rename(target)
        shutil.rmtree(swap)
    for run in staging.glob("run-*"):
        if not _is_alive(run):
            shutil.rmtree(run)


def _is_alive(run: Path) -> bool:
    try:
        with (run / CLAIM).open("r+") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except FileNotFoundError:
        return False  # killed before it wrote its claim
    return False
