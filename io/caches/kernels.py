"""The folder of compiled kernels: its name contains a digest of the code and of where it lies.

By default numba keeps a kernel beside its source file and checks only that file. It does not notice
a change in a function of another file that the kernel calls. After an upgrade it may also find
signatures with classes that no longer exist. With a digest of all code in the folder's name,
neither can happen. numba also identifies kernels by the path of their source file: two environments
with the same code each compile their kernels, so each has its folder.
"""

import contextlib
import fcntl
import hashlib
import logging
import os
import shutil
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from epipole.io.caches.arrays import cache_folder
from epipole.io.caches.private_folders import fault_of, is_ours, private_folder

LOGGER = logging.getLogger(__name__)

_ROOT = Path(__file__).parents[2]
CODE = (_ROOT / "tasks" / "algorithms", _ROOT / "io")  # all kernels, and what they call
KEPT = 8  # folders: several versions and environments of one user
_USED = "used"  # this file exists after a run has succeeded


def use_kernel_cache(code: Sequence[Path] = CODE) -> None:
    """Let numba keep kernels in the user's cache folder, under a digest of the code.

    A user's NUMBA_CACHE_DIR takes precedence, if it can be written. With EPIPOLE_CACHE=off they
    are kept beside the code if it can be written, else for this process only.

    Called before any kernel is declared: numba then decides where it is kept.
    """
    named = os.environ.get("NUMBA_CACHE_DIR")
    if named and _is_writable(Path(named)):
        return
    root = cache_folder()
    if root is not None:
        folder = _trusted(root / "kernels", _digest(code))
    elif all(os.access(part, os.W_OK) for part in code):
        return
    else:
        folder = private_folder("kernels")
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    numba = sys.modules.get("numba")
    if numba is not None:
        numba.config.CACHE_DIR = str(folder)


def _is_writable(named: Path) -> bool:
    """Return whether kernels can be kept in the folder that the user has named."""
    try:
        named.mkdir(parents=True, exist_ok=True)
        reason = None if os.access(named, os.W_OK | os.X_OK) else "cannot be written"
    except OSError as error:
        reason = error.strerror or str(error)
    if reason is not None:
        LOGGER.warning("NUMBA_CACHE_DIR=%s: kernels are not kept here (%s)", named, reason)
    return reason is None


def _trusted(kernels: Path, name: str) -> Path:
    """Return the folder of this name; a private one where others may have put kernels into it.

    A kernel is code: numba runs what it finds.
    """
    folder = kernels / name
    fault = fault_of(kernels) or fault_of(folder)
    if fault is None and not all(is_ours(path.lstat()) for path in folder.rglob("*")):
        fault = "has files of another user"
    if fault is not None:
        LOGGER.warning(
            "%s: kernels are not kept here (%s), this run compiles for a minute; remove the folder",
            folder,
            fault,
        )
        return private_folder("kernels")
    with contextlib.suppress(OSError):  # another run may remove the same old folders
        os.utime(folder)
        _prune(kernels)
    return folder


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
        digest.update(str(folder.resolve()).encode())
        for file in sorted(folder.rglob("*.py")):
            name = file.relative_to(folder).as_posix()
            digest.update(name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


def _prune(root: Path) -> None:
    newest = sorted(root.iterdir(), key=lambda folder: folder.stat().st_mtime, reverse=True)
    for old in newest[KEPT:]:
        shutil.rmtree(old, ignore_errors=True)
