"""Nights in a local folder: claimed by a lock, put in place by a rename, recovered after a kill.

Unfinished work lies in ``DATASET/.staging``:

- ``lock``: held briefly by a run that changes the staging folder or puts nights in place;
- ``run-*/``: the folder of one run. Its file ``claim`` is locked as long as the run lives, and
  names the nights that the run works on;
- ``swap-*/``: nights that are being replaced, and the file ``commit.json``, which publishes all
  nights of a run at once: if the run is killed between two renames, the next run or reader
  finishes them.

Other files in it are left alone.

The kernel releases a lock when its process ends, however it ends. So a claim that can be locked
belongs to a run that has ended, and the next run removes its folder.
"""

import contextlib
import fcntl
import json
import os
import shutil
import stat
import threading
import uuid
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO

from epipole.io.datasets.folder_swap import put_in_place, sync, take_back
from epipole.io.datasets.night_holder import Holder
from epipole.schemas.errors import DatasetError

STAGING = ".staging"
CLAIM = "claim"
COMMIT = "commit.json"


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
    run = dataset / STAGING / f"run-{os.getpid()}-{uuid.uuid4().hex[:8]}"
    try:
        dataset.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as held:
            with _locked(dataset) as staging:
                _clear(dataset, staging)
                for other in _folders(staging, "run-*"):
                    claimed = other / CLAIM
                    Holder.read(claimed.read_text(), claimed).refuse(dataset, nights)
                run.mkdir()
                file = held.enter_context((run / CLAIM).open("w"))
                fcntl.flock(file, fcntl.LOCK_EX)
                file.write(Holder.of(nights).text())
                file.flush()
            yield run
    finally:  # of the claim too: Ctrl-C may come between any two of its steps
        _release(dataset, run)
        if made:
            with contextlib.suppress(OSError):  # not empty if nights were published
                dataset.rmdir()


def claimed_nights(dataset: Path) -> set[str]:
    """Return the nights that living runs have claimed."""
    claims = [run / CLAIM for run in _folders(dataset / STAGING, "run-*") if _is_alive(run)]
    return {night for file in claims for night in Holder.read(file.read_text(), file).nights}


def _release(dataset: Path, run: Path) -> None:
    """Remove the folder of a run that ends. What cannot be removed the next run removes."""
    if not run.exists() and not (dataset / STAGING / "lock").exists():
        return  # refused, or never made
    with contextlib.suppress(OSError, DatasetError), _locked(dataset):
        gone = run.rename(run.with_name(f"{run.name}-gone"))  # a task may still be writing there
        shutil.rmtree(gone, ignore_errors=True)


def put_all_in_place(dataset: Path, staged: Mapping[str, Path]) -> None:
    """Make these folders the nights of a dataset, each by one rename: all or none.

    Must be called inside `alone`. Where this process is killed once the commit is written, `alone`
    and `recover` finish it.

    Raises
    ------
    OSError
        Where a rename fails; the dataset and the folders are then unchanged.
    """
    aside = dataset / STAGING / f"swap-{uuid.uuid4().hex[:8]}"
    aside.mkdir()
    done: list[str] = []
    try:
        _commit(aside, staged)
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
        with contextlib.suppress(OSError):
            (aside / COMMIT).unlink(missing_ok=True)  # first: nothing is left to finish
        shutil.rmtree(aside, ignore_errors=True)


def _commit(aside: Path, staged: Mapping[str, Path]) -> None:
    """Write which folders become the nights. A folder keeps its inode wherever it is moved."""
    nights = {
        night: {"folder": os.path.relpath(folder, aside), "inode": folder.stat().st_ino}
        for night, folder in staged.items()
    }
    written = aside / f"{COMMIT}.new"
    written.write_text(json.dumps(nights), encoding="utf-8")
    sync(written)
    written.rename(aside / COMMIT)
    sync(aside)


def recover(dataset: Path) -> None:
    """Finish what a killed run has committed; a reader that may not write reads what is there."""
    if any((dataset / STAGING).glob(f"swap-*/{COMMIT}")):
        with contextlib.suppress(PermissionError), alone(dataset):
            pass


def _finish(dataset: Path, swap: Path) -> None:
    """Put in place what a killed run has committed and not moved yet."""
    try:
        nights = json.loads((swap / COMMIT).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return  # killed before it had published anything
    for night, new in nights.items():
        target, folder = dataset / f"night={night}", swap / new["folder"]
        if _inode(target) != new["inode"] and _inode(folder) == new["inode"]:
            put_in_place(folder, target, swap / f"old-night={night}")
    sync(dataset)
    (swap / COMMIT).unlink()


def _inode(path: Path) -> int | None:
    try:
        return path.stat().st_ino
    except FileNotFoundError:
        return None


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
    with contextlib.ExitStack() as held:
        _let_go(path)
        while True:
            if staging.is_symlink():  # what is behind it is not ours to change
                raise DatasetError(f"{staging}: is a symbolic link; remove it")
            with contextlib.suppress(FileNotFoundError):  # its last holder has just removed it
                try:
                    staging.mkdir(parents=True, exist_ok=True)
                except FileExistsError:  # `mkdir` looks twice: removed in between, or a file
                    if stat.S_ISDIR(staging.lstat().st_mode):
                        continue
                    raise
                lock = held.enter_context(path.open("w"))
                _HELD[path, threading.get_ident()] = lock
                fcntl.flock(lock, fcntl.LOCK_EX)
                if path.exists() and os.path.samestat(os.fstat(lock.fileno()), path.stat()):
                    break
                lock.close()
        held.callback(_unlock, staging, path)
        yield staging


def _unlock(staging: Path, path: Path) -> None:
    # The file is removed while it is locked. A waiting process notices this in the loop above.
    path.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # not empty if another run has its folder there
        staging.rmdir()


# The open lock files of this process, by path and thread.
_HELD: dict[tuple[Path, int], IO[str]] = {}


def _let_go(path: Path) -> None:
    """Close this thread's lock file if it is still open: else the thread would wait for itself.

    Ctrl-C may come between two steps of taking the lock; the exception then keeps the file open.
    """
    left = _HELD.pop((path, threading.get_ident()), None)
    if left is not None:
        left.close()


def _clear(dataset: Path, staging: Path) -> None:
    """Remove what killed runs left. A night that was moved away but not replaced goes back.

    The caller holds the lock, so no living run is replacing the nights in `swap-*`.
    """
    for swap in _folders(staging, "swap-*"):
        _finish(dataset, swap)
        for old in swap.glob("old-night=*"):
            target = dataset / old.name.removeprefix("old-")
            if not target.exists():
                old.rename(target)
        shutil.rmtree(swap)
    for run in _folders(staging, "run-*"):
        if not _is_alive(run):
            shutil.rmtree(run)


def _folders(staging: Path, pattern: str) -> list[Path]:
    """Return the folders in the staging folder; files and links there are not ours."""
    return [path for path in staging.glob(pattern) if path.is_dir() and not path.is_symlink()]


def _is_alive(run: Path) -> bool:
    try:
        with (run / CLAIM).open("r+") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except FileNotFoundError:
        return False  # killed before it wrote its claim
    return False
