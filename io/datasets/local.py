"""Nights in a local folder: claimed by a lock, put in place by a rename, recovered after a kill.

Unfinished work lies in ``DATASET/.staging``:

- ``lock``: held briefly by a run that changes the staging folder or puts nights in place;
- ``run-*/``: the folder of one run. Its file ``claim`` is locked as long as the run lives, and
  names the nights that the run works on;
- ``swap-*/``: nights that are being replaced, and the file ``commit.json``, which publishes all
  nights of a run at once: if the run is killed between two renames, the next run or reader
  finishes them.

Other files in it are left alone. Whoever may write to the dataset may have written these files
too. So a commit is finished only where it names dates, and folders of runs in the staging folder,
and where none of these is a link.

The kernel releases a lock when its process ends, however it ends. So a claim that can be locked
belongs to a run that has ended, and the next run removes its folder.
"""

import contextlib
import ctypes
import errno
import fcntl
import json
import logging
import os
import re
import shutil
import stat
import threading
import uuid
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, NamedTuple

from epipole.io.datasets.lock_record import Holder
from epipole.io.datasets.plain_files import entered, opened, read_small, refuse_link
from epipole.schemas.dates import is_night
from epipole.schemas.errors import DatasetError

# Folders replaced in one step: a reader sees the old or the new folder, never a mixture.

AT_FDCWD = -100
RENAME_EXCHANGE = 2

# The errors of a kernel, C library or file system that has no exchange.
_UNSUPPORTED = {errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP}


def exchange(first: Path, second: Path) -> bool:
    """Swap two paths of one file system in one step (Linux's renameat2, RENAME_EXCHANGE).

    Returns
    -------
    bool
        False where it is not supported; the paths are then unchanged.

    Raises
    ------
    OSError
        Where it fails for another reason.
    """
    renameat2 = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if renameat2 is None:
        return False
    failed = renameat2(
        AT_FDCWD, os.fsencode(first), AT_FDCWD, os.fsencode(second), ctypes.c_uint(RENAME_EXCHANGE)
    )
    if not failed:
        return True
    code = ctypes.get_errno()
    if code in _UNSUPPORTED:
        return False
    raise OSError(code, os.strerror(code), str(second))


def put_in_place(new: Path, target: Path, old: Path) -> None:
    """Move the folder `new` to `target`, and what was there to `old`.

    Where `target` is missing, or the two can be exchanged, a reader never misses it. Otherwise it
    takes two renames, and `target` is missing for an instant; `old` then holds it.

    Raises
    ------
    OSError
        Where a rename fails; `target` is then unchanged.
    """
    if not target.exists():
        new.rename(target)
    elif exchange(new, target):
        new.rename(old)  # the exchange left the old folder under the new one's name
    else:
        target.rename(old)
        try:
            new.rename(target)
        except OSError:
            old.rename(target)
            raise


def take_back(target: Path, old: Path, new: Path) -> None:
    """Undo `put_in_place`: move `target` back to `new`, and `old`, if it exists, to `target`."""
    if old.exists() and exchange(old, target):
        old.rename(new)
        return
    target.rename(new)
    if old.exists():
        old.rename(target)


def sync(path: Path) -> None:
    """Wait until the bytes of a file, or the entries of a folder, are on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


# Nights of a dataset.

LOGGER = logging.getLogger(__name__)

STAGING = ".staging"
CLAIM = "claim"
COMMIT = "commit.json"

# A folder in the folder of a run, as a commit names it from `swap-*`.
_STAGED = re.compile(r"\.\./(run-[\w-]+)/([\w=-]+)", re.ASCII)


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
                    Holder.read(read_small(claimed), claimed).refuse(dataset, nights)
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
    return {night for file in claims for night in Holder.read(read_small(file), file).nights}


def _release(dataset: Path, run: Path) -> None:
    """Remove the folder of a run that ends. What cannot be removed the next run removes."""
    if not run.exists() and not (dataset / STAGING / "lock").exists():
        return  # refused, or never made
    with contextlib.suppress(OSError, DatasetError), _locked(dataset):
        gone = run.rename(run.with_name(f"{run.name}-gone"))  # a task may still be writing there
        shutil.rmtree(gone, ignore_errors=True)


def put_all_in_place(dataset: Path, staged: Mapping[str, Path]) -> None:
    """Make these folders the nights of a dataset, each by one rename: all or none.

    The folders lie in the folder of a run; see `claim`. Must be called inside `alone`. Where this
    process is killed once the commit is written, `alone` and `recover` finish it.

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
    _read_commit(written)  # what cannot be finished is not begun
    sync(written)
    written.rename(aside / COMMIT)
    sync(aside)


class _Move(NamedTuple):
    """A night of a commit: the run that made it, and its folder there."""

    night: str
    run: str
    folder: str
    inode: int


def _read_commit(commit: Path) -> list[_Move]:
    """Return the nights of a commit.

    Raises
    ------
    DatasetError
        Where `_commit` has not written it.
    """
    try:
        moves = []
        for night, new in json.loads(read_small(commit)).items():
            named = _STAGED.fullmatch(new["folder"])
            if named is None or not is_night(night):
                raise ValueError(night)
            moves.append(_Move(night, named[1], named[2], int(new["inode"])))
    except (AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise DatasetError(f"{commit}: is not a commit of a run; remove it") from error
    return moves


def recover(dataset: Path) -> None:
    """Finish what a killed run has committed; a reader that may not write reads what is there.

    Nothing else is changed, and a line says that it was done.
    """
    if any((dataset / STAGING).glob(f"swap-*/{COMMIT}")):
        with contextlib.suppress(PermissionError), _locked(dataset) as staging:
            for swap in _folders(staging, "swap-*"):
                _finish(dataset, swap)


def _finish(dataset: Path, swap: Path) -> None:
    """Put in place what a killed run has committed and not moved yet.

    Raises
    ------
    DatasetError
        Where the commit is not one of a run, or a folder that it names is a link.
    """
    try:
        moves = _read_commit(swap / COMMIT)
    except FileNotFoundError:
        return  # killed before it had published anything
    for move in moves:
        refuse_link(dataset / f"night={move.night}")
        with contextlib.suppress(FileNotFoundError):  # moved before: its run's folder may be gone
            _finish_one(dataset, swap.name, move)
    sync(dataset)
    (swap / COMMIT).unlink()
    LOGGER.warning(
        "%s: finished the publication of %s, in which a run was stopped",
        dataset,
        ", ".join(move.night for move in moves),
    )


def _finish_one(dataset: Path, swap: str, move: _Move) -> None:
    name = f"night={move.night}"
    with (
        entered(dataset) as nights,
        entered(dataset, STAGING, swap) as aside,
        entered(dataset, STAGING, move.run) as run,
    ):
        new, target = run / move.folder, nights / name
        if _inode(target) != move.inode and _inode(new) == move.inode:
            put_in_place(new, target, aside / f"old-{name}")


def _inode(path: Path) -> int | None:
    try:
        return path.lstat().st_ino
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
            refuse_link(staging)  # what is behind it is not ours to change
            refuse_link(path)
            with contextlib.suppress(FileNotFoundError):  # its last holder has just removed it
                try:
                    staging.mkdir(parents=True, exist_ok=True)
                except FileExistsError:  # `mkdir` looks twice: removed in between, or a file
                    if stat.S_ISDIR(staging.lstat().st_mode):
                        continue
                    raise
                with entered(dataset, STAGING) as folder:
                    descriptor = opened(folder / path.name, os.O_RDWR | os.O_CREAT)
                lock = held.enter_context(open(descriptor, "w"))
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
            is_one = is_night(target.name.removeprefix("night=")) and not old.is_symlink()
            if is_one and _inode(target) is None:
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
        with open(opened(run / CLAIM, os.O_RDWR), "r+") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except FileNotFoundError:
        return False  # killed before it wrote its claim
    return False
