"""Folders that only this user can write to: the cache holds code, which others must not change.

A temporary folder is locked as long as its process lives. The kernel releases the lock however the
process ends. So one that can be locked was left by a killed process, and the next one removes it.
"""

import atexit
import contextlib
import fcntl
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from epipole.schemas.errors import EpipoleError

_TEMPORARY = "epipole-run-"


@cache
def private_folder(purpose: str) -> Path:
    """Return a temporary folder of this process: only its user may enter it, nobody can guess it.

    It is removed when the process ends. The same purpose gets the same folder.

    Raises
    ------
    EpipoleError
        Where no temporary folder can be made.
    """
    folder, _ = _locked_folder(purpose)  # locked as long as the process lives
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@contextlib.contextmanager
def temporary_folder(purpose: str) -> Iterator[Path]:
    """Yield a folder like `private_folder`, a new one each time, and remove it at the end."""
    folder, lock = _locked_folder(purpose)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def _locked_folder(purpose: str) -> tuple[Path, int]:
    """Return a new temporary folder, and the open handle that locks it."""
    try:
        _clear_left()
        while True:
            folder = Path(tempfile.mkdtemp(prefix=f"{_TEMPORARY}{purpose}-"))
            # Another process may just have taken it for one that was left, and removed it.
            with contextlib.suppress(FileNotFoundError):
                lock = os.open(folder, os.O_RDONLY)
                fcntl.flock(lock, fcntl.LOCK_EX)
                if folder.exists():
                    return folder, lock
                os.close(lock)
    except OSError as error:
        raise EpipoleError(
            f"no temporary folder can be made ({error.strerror or error}); "
            "set TMPDIR to a folder that can be written"
        ) from error


def _clear_left() -> None:
    """Remove the temporary folders that killed processes of this user have left."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_TEMPORARY}*"):
        with contextlib.suppress(OSError):  # its process lives, or another one removes it
            status = folder.lstat()
            if stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid():
                _remove_unless_locked(folder)


def _remove_unless_locked(folder: Path) -> None:
    lock = os.open(folder, os.O_RDONLY | os.O_NOFOLLOW)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        shutil.rmtree(folder)
    finally:
        os.close(lock)


def fault_of(folder: Path) -> str | None:
    """Return why a folder cannot be used and trusted. None: it can. It is created if missing.

    As ssh does with its keys: the folder must belong to this user or to root, and nobody else may
    write to it.
    """
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat()
    except OSError as error:
        return error.strerror or str(error)
    if not is_ours(status):
        return "belongs to another user"
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return "other users can write to it"
    if not os.access(folder, os.W_OK | os.X_OK):
        return "cannot be written"
    return None


def is_ours(status: os.stat_result) -> bool:
    """Return whether a file belongs to this user or to root."""
    return status.st_uid in (os.geteuid(), 0)
