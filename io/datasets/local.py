"""Nights in a local folder: locked by a file, put in place by a rename, recovered after a kill.

Unfinished work is in ``DATASET/.staging``:

- ``lock``: taken briefly by a run that changes the staging folder or puts nights in place;
- ``run-*/``: the folder of one run. Its file ``claim`` is locked as long as the run lives, and
  names the nights that the run works on;
- ``swap-*/``: nights that are being replaced, and the file ``commit.json``, which publishes all
  nights of a run at once: if the run is killed between two renames, the next run or reader
  finishes them.

Other files in it are left alone. Whoever may write to the dataset may have written these files
too. So a commit is finished only where it names dates, and folders of runs in the staging folder,
and only if no link is among these.

The kernel releases a lock when its process ends, however it ends. So where the file of a run can be
locked, the run has ended, and the next run removes its folder.
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
import tempfile
import threading
import uuid
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, NamedTuple

from epipole.io.datasets.lock_record import STAGING, LockRecord
from epipole.io.datasets.plain_files import entered, opened, read_small, refuse_link
from epipole.io.paths import bytes_in
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

LOCK = "claim"  # the file in the folder of a run; earlier versions give it this name too
COMMIT = "commit.json"
# Beside the nights, never in them: readers scan night=*.
REPORTS, RUNS = "reports", "runs"

# A folder in the folder of a run, as a commit names it from `swap-*`.
_STAGED = re.compile(r"\.\./(run-[\w-]+)/([\w=-]+)", re.ASCII)


class LocalNights:
    """The nights of a dataset in a local folder; see `NightStorage` for the methods."""

    def __init__(self, folder: Path, dataset: str) -> None:
        """`dataset` is the name of the folder in messages."""
        self.folder, self._dataset = folder, dataset

    def errors(self) -> tuple[type[Exception], ...]:
        """Return the errors of a file system."""
        return (OSError,)

    def names(self) -> list[str]:
        """Return the names at the top of the dataset."""
        try:
            if self.folder.exists() and not self.folder.is_dir():
                raise DatasetError(f"{self._dataset}: is a file, not a folder; give another folder")
            return [entry.name for entry in self.folder.iterdir()] if self.folder.is_dir() else []
        except OSError as error:
            raise DatasetError(f"{self._dataset}: {error.strerror}; give another folder") from error

    def exists(self) -> bool:
        """Return whether the folder exists; it may be empty."""
        return self.folder.is_dir()

    def recover(self) -> None:
        """Finish what a stopped run has committed; readers do so too."""
        recover(self.folder)

    def nights(self) -> list[str]:
        """Return the published nights, in order."""
        recover(self.folder)
        folders = [path for path in self.folder.glob("night=*") if path.is_dir()]
        return sorted(filter(is_night, (path.name.removeprefix("night=") for path in folders)))

    def tables(self, night: str) -> set[str]:
        """Return the names of the tables that a night has files of."""
        recover(self.folder)
        return {file.parent.name for file in self._night(night).glob("*/*.parquet")}

    def files(self, night: str, table: str) -> list[Path]:
        """Return the files of a table of a night, in order."""
        recover(self.folder)
        return sorted((self._night(night).absolute() / table).glob("*.parquet"))

    def open_files(self, night: str, table: str) -> list[Path]:
        """Return the same: of a file only what is needed is read anyway."""
        return self.files(night, table)

    def location(self, night: str) -> Path:
        """Return the folder of a night."""
        return self._night(night)

    def _night(self, night: str) -> Path:
        return self.folder / f"night={night}"

    def write_beside(self, folder: str, name: str, data: bytes) -> None:
        """Write a file by one rename from beside it."""
        target = self.folder / folder
        refuse_link(target)
        target.mkdir(exist_ok=True)
        handle, made = tempfile.mkstemp(dir=target, prefix=".")
        try:
            with open(handle, "wb") as file:
                file.write(data)
            os.chmod(made, 0o666 & ~_umask())
            os.replace(made, target / name)
        finally:
            Path(made).unlink(missing_ok=True)

    def remove_beside(self, folder: str, name: str) -> None:
        """Remove such a file, if it exists."""
        refuse_link(self.folder / folder)
        (self.folder / folder / name).unlink(missing_ok=True)

    def files_beside(self, folder: str, nights: Collection[str] | None = None) -> list[Path]:
        """Return the Parquet files in a folder beside the nights, in order; of all, or of some."""
        paths = sorted((self.folder / folder).absolute().glob("[!.]*.parquet"))
        return [path for path in paths if nights is None or path.stem in nights]

    def sizes(self) -> dict[str, int]:
        """Return the bytes of each night, and of each file beside the nights."""
        found = {f"night={n}": bytes_in(self._night(n)) for n in self.nights()}
        for beside in (REPORTS, RUNS):
            for file in sorted((self.folder / beside).glob("[!.]*")):
                if is_night(file.stem) and file.is_file() and not file.is_symlink():
                    found[f"{beside}/{file.name}"] = file.lstat().st_size
        return found

    def remove(self, name: str, run: Path) -> None:
        """Remove a night or a file: by one rename into the folder of a run."""
        refuse_link((self.folder / name).parent)
        refuse_link(self.folder / name)
        (self.folder / name).rename(run / name.replace("/", "-"))

    @contextlib.contextmanager
    def lock_nights(self, nights: Sequence[str]) -> Iterator[Path]:
        """Lock these nights, and yield a folder for this run on the dataset's file system."""
        made = not self.folder.exists()
        run = self.folder / STAGING / f"run-{os.getpid()}-{uuid.uuid4().hex[:8]}"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with contextlib.ExitStack() as stack:
                with _locked(self.folder) as staging:
                    _clear(self.folder, staging)
                    for other in _folders(staging, "run-*"):
                        _read_lock(other).refuse(self._dataset, nights)
                    run.mkdir()
                    file = stack.enter_context((run / LOCK).open("w"))
                    file.write(LockRecord.of(nights).text())
                    file.flush()  # first: what is locked can be read
                    fcntl.flock(file, fcntl.LOCK_EX)
                yield run
        finally:  # of the lock too: Ctrl-C may come between any two of its steps
            _release(self.folder, run)
            if made:
                with contextlib.suppress(OSError):  # not empty if nights were published
                    self.folder.rmdir()

    def locked_nights(self) -> set[str]:
        """Return the nights that living runs have locked."""
        nights: set[str] = set()
        for run in filter(_is_alive, _folders(self.folder / STAGING, "run-*")):
            with contextlib.suppress(FileNotFoundError):  # it has just ended
                nights.update(_read_lock(run).nights)
        return nights

    def publish(self, staged: Mapping[str, Path], check: Callable[[], None]) -> None:
        """Put the nights in place, each by one rename: all or none."""
        for folder in staged.values():
            for path in [*folder.rglob("*"), folder]:
                sync(path)
        with _locked(self.folder) as staging:  # waits while another run publishes
            _clear(self.folder, staging)
            check()
            _put_all_in_place(self.folder, staged)


def _umask() -> int:
    """Return the umask of this process: files that are made in secret get its mode too."""
    mask = os.umask(0o077)
    os.umask(mask)
    return mask


def _read_lock(run: Path) -> LockRecord:
    return LockRecord.read(read_small(run / LOCK), run / LOCK)


def _release(dataset: Path, run: Path) -> None:
    """Remove the folder of a run that ends. What cannot be removed the next run removes."""
    if not run.exists() and not (dataset / STAGING / "lock").exists():
        return  # refused, or never made
    with contextlib.suppress(OSError, DatasetError), _locked(dataset):
        gone = run.rename(run.with_name(f"{run.name}-gone"))  # a task may still be writing there
        shutil.rmtree(gone, ignore_errors=True)


def _put_all_in_place(dataset: Path, staged: Mapping[str, Path]) -> None:
    """Make these folders the nights of a dataset, each by one rename: all or none.

    The folders are in the folder of a run; the caller has locked the staging folder. Where this
    process is killed once the commit is written, the next run or reader finishes it.

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
    """Finish what a killed run has committed, if this process may write to the dataset.

    Nothing else is changed, and a line says that it was done.
    """
    if any((dataset / STAGING).glob(f"swap-*/{COMMIT}")):
        try:
            with _locked(dataset) as staging:
                for swap in _folders(staging, "swap-*"):
                    _finish(dataset, swap)
        except OSError as error:
            if not isinstance(error, PermissionError) and error.errno != errno.EROFS:
                raise


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
        return  # killed before it published anything
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
def _locked(dataset: Path) -> Iterator[Path]:
    """Yield the staging folder, locked: waits while another run changes or publishes something."""
    staging = dataset / STAGING
    path = staging / "lock"
    with contextlib.ExitStack() as stack:
        _close_lock_file(path)
        while True:
            refuse_link(staging)  # nothing outside the dataset may be changed
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
                lock = stack.enter_context(open(descriptor, "w"))
                _LOCK_FILES[path, threading.get_ident()] = lock
                fcntl.flock(lock, fcntl.LOCK_EX)
                if path.exists() and os.path.samestat(os.fstat(lock.fileno()), path.stat()):
                    break
                lock.close()
        stack.callback(_unlock, staging, path)
        yield staging


def _unlock(staging: Path, path: Path) -> None:
    # The file is removed while it is locked. A waiting process notices this in the loop above.
    path.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # not empty if another run has its folder there
        staging.rmdir()


# The open lock files of this process, by path and thread.
_LOCK_FILES: dict[tuple[Path, int], IO[str]] = {}


def _close_lock_file(path: Path) -> None:
    """Close this thread's lock file if it is still open: else the thread would wait for itself.

    Ctrl-C may come between two steps of taking the lock; the exception then keeps the file open.
    """
    left = _LOCK_FILES.pop((path, threading.get_ident()), None)
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
            is_valid = is_night(target.name.removeprefix("night=")) and not old.is_symlink()
            if is_valid and _inode(target) is None:
                old.rename(target)
        shutil.rmtree(swap)
    for run in _folders(staging, "run-*"):
        if not _is_alive(run):
            shutil.rmtree(run)


def _folders(staging: Path, pattern: str) -> list[Path]:
    """Return the folders in the staging folder; files and links in it are ignored."""
    return [path for path in staging.glob(pattern) if path.is_dir() and not path.is_symlink()]


def _is_alive(run: Path) -> bool:
    """Return whether the lock of a run is taken; who may only read the dataset can ask too."""
    try:
        with open(opened(run / LOCK), "rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except FileNotFoundError:
        return False  # killed before it wrote its lock
    return False
