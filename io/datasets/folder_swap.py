"""Folders replaced in one step: a reader sees the old or the new folder, never a mixture."""

import ctypes
import errno
import os
from pathlib import Path

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
