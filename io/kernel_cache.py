"""Where compiled kernels are kept: a folder that is another one for other code.

Numba keeps them beside the code and looks at one file only, so what a kernel calls in another
file may change unseen, and an upgrade in place may find signatures of classes that are no more.
"""

import hashlib
import os
import shutil
import sys
from pathlib import Path

from epipole.io.array_cache import cache_folder

KEPT = 8  # folders: of the code as it was last, in several environments


def use_kernel_cache(code: Path) -> None:
    """Have numba keep kernels in the user's cache folder, under a digest of the code.

    A user's own NUMBA_CACHE_DIR wins, and so does EPIPOLE_CACHE=off: then they stay beside the
    code.

    Parameters
    ----------
    code
        The folder that holds all kernels and what they call.
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


def _digest(code: Path) -> str:
    digest = hashlib.sha256()
    for file in sorted(code.rglob("*.py")):
        digest.update(file.relative_to(code).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


def _prune(root: Path) -> None:
    newest = sorted(root.iterdir(), key=lambda folder: folder.stat().st_mtime, reverse=True)
    for old in newest[KEPT:]:
        shutil.rmtree(old, ignore_errors=True)
