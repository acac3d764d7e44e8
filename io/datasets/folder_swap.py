"""Folders put in place at once, so that a reader sees the old or the new, never half."""

import ctypes
import errno
import os
from pathlib import Path

AT_FDCWD = -100
RENAME_EXCHANGE = 2

# What a kernel, a C library or a file system without the exchange answers.
_UNSUPPORTED = {errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP}


def exchange(first: Path, second: Path) -> bool:
    """Swap two paths of one file system at once (Linux's renameat2, RENAME_EXCHANGE).

    Returns
    -------
    bool
        False where it is not supported; then nothing has happened.

    Raises
    ------
    OSError
        Where the system refuses for another reason.
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
    """Make the folder `new` the folder `target`; what stood there goes to `old`.

    One rename where nothing stood there or the two can be exchanged; two renames otherwise,
    in which `target` is missing for an instant (`old` then holds it, whole).

    Raises
    ------
    OSError
        Where the system refuses; `target` is then as it was.
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
    """Undo `put_in_place`: `target` goes back to `new`, and `old`, if there, to `target`."""
    if old.exists() and exchange(old, target):
        old.rename(new)
        return
    target.rename(new)
    if old.exists():
        old.rename(target)


def sync(path: Path) -> None:
    """Have a file's bytes, or a folder's entries, on the disk before going on."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
