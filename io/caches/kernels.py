"""Where compiled kernels are kept: a folder that is another one for other code.

Numba keeps them beside the code and looks at one file only, so what a kernel calls in another
file may change unseen, and an upgrade in place may find signatures of classes that are no more.
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

KEPT = 8  # folders: of the code as it was last, in several environments
_USED = "used"  # a file there once a run has ended well


def use_kernel_cache(*code: Path) -> None:
    """Have numba keep kernels in the user's cache folder, under a digest of the code.

    A user's own NUMBA_CACHE_DIR wins, and so does EPIPOLE_CACHE=off: then they stay beside the
    code.

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
    except OSError:  # numba finds a place of its own
        return
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    numba = sys.modules.get("numba")
    if numba is not None:
        numba.config.CACHE_DIR = str(folder)


def new_kernel_folder() -> Path | None:
    """Return where this code's kernels are kept while no run with them has ended well yet."""
    root, said = cache_folder(), os.environ.get("NUMBA_CACHE_DIR")
    if root is None or not said or Path(said).parent != root / "kernels":
        return None
    folder = Path(said)
    return folder if folder.is_dir() and not (folder / _USED).exists() else None


def mark_used(folder: Path) -> None:
    """Say that a run has ended well: what it needs is compiled."""
    with contextlib.suppress(OSError):
        (folder / _USED).touch()


@contextlib.contextmanager
def only_one(folder: Path) -> Iterator[bool]:
    """Tell whether no other process is in here for the same folder."""
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
