"""The folder of compiled kernels: its name contains a digest of the code.

By default numba keeps a kernel beside its source file and checks only that file. It does not notice
a change in a function of another file that the kernel calls. After an upgrade it may also find
signatures with classes that no longer exist. With a digest of all code in the folder's name,
neither can happen.
"""

import contextlib
import fcntl
import hashlib
import os
import shutil
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

from epipole.io.caches.arrays import cache_folder

KEPT = 8  # folders: several versions and environments of one user
_USED = "used"  # this file exists after a run has succeeded


def use_kernel_cache(*code: Path) -> None:
    """Let numba keep kernels in the user's cache folder, under a digest of the code.

    A user's NUMBA_CACHE_DIR takes precedence. With EPIPOLE_CACHE=off they are kept beside the code.

    Parameters
    ----------
    code
        The folders that hold all kernels and what they call.
    """
    root = cache_folder()
    if root is None or os.environ.get("NUMBA_CACHE_DIR"):
        return
    folder = root / "kernels" / _digest(code)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
        _prune(folder.parent)
    except OSError:  # numba uses its default place
        return
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    numba = sys.modules.get("numba")
    if numba is not None:
        numba.config.CACHE_DIR = str(folder)


def new_kernel_folder() -> Path | None:
    """Return the kernel folder of this code, as long as no run of this code has succeeded."""
    root, path = cache_folder(), os.environ.get("NUMBA_CACHE_DIR")
    if root is None or not path or Path(path).parent != root / "kernels":
        return None
    folder = Path(path)
    return folder if folder.is_dir() and not (folder / _USED).exists() else None


def mark_used(folder: Path) -> None:
    """Record that a run has succeeded: all kernels that it needs are compiled."""
    with contextlib.suppress(OSError):
        (folder / _USED).touch()


@contextlib.contextmanager
def only_one(folder: Path) -> Iterator[bool]:
    """Yield whether no other process has called this for the same folder, and keep others out."""
    with (folder / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            yield False
        else:
            yield True


def _digest(folders: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for folder in folders:
        for file in sorted(folder.rglob("*.py")):
            name = file.relative_to(folder).as_posix()
            digest.update(name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


def _prune(root: Path) -> None:
    newest = sorted(root.iterdir(), key=lambda folder: folder.stat().st_mtime, reverse=True)
    for old in newest[KEPT:]:
        shutil.rmtree(old, ignore_errors=True)
