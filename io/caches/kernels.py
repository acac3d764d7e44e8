"""The folder of compiled kernels: where numba finds them, and keeps those that it compiles.

By default numba keeps a kernel beside its source file, checks only that file, and compiles for the
processor at hand. So it does not notice a change in a function of another file that the kernel
calls, and no kernel serves another environment or machine. Here one folder holds the kernels of one
version of the code: a digest of all code is in its name, and kernels are found by module. They are
made for any x86-64 processor of level 3 (AVX2, since 2013), where this one is. A wheel carries such
a folder, `compiled`; it is copied into the user's cache at the first use.
"""

import contextlib
import functools
import hashlib
import importlib.metadata
import logging
import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

from epipole.io.caches.arrays import cache_folder
from epipole.io.caches.kernel_target import common_target
from epipole.io.caches.private_folders import fault_of, is_ours, private_folder

LOGGER = logging.getLogger(__name__)

_ROOT = Path(__file__).parents[2]
CODE = (_ROOT / "tasks" / "algorithms", _ROOT / "io")  # all kernels, and what they call
COMPILED = Path(__file__).parent / "compiled"  # of a wheel; a checkout lacks it
DIGEST = "digest"  # the file in it with the digest of the code it was made from
# The folder of a process, for those that it starts: a temporary one is shared with them.
HANDED_ON = "EPIPOLE_KERNELS"
KEPT = 8  # folders: several versions of one user

_folder: Path | None = None


def use_kernel_cache(code: Sequence[Path] = CODE) -> None:
    """Let numba find and keep kernels in the user's cache folder, under a digest of the code.

    A user's NUMBA_CACHE_DIR takes precedence, if it can be written: numba then works as always.
    With EPIPOLE_CACHE=off the wheel's kernels are used where they lie; without them each process
    compiles.

    Called before any kernel is declared: numba then decides where it is kept.
    """
    digest = digest_of(tuple(code))
    given = Path(os.environ.get(HANDED_ON, ""))
    is_given = given.name == digest and given.is_dir()
    named = os.environ.get("NUMBA_CACHE_DIR")
    if not is_given and named and _is_writable(Path(named)):
        return
    # Imports numba: as late as possible.
    from epipole.io.caches.kernel_locator import locate_kernels, use_target

    target = common_target()
    if target is not None:
        use_target(target)
    global _folder
    _folder = given if is_given else _folder_of(digest)
    os.environ[HANDED_ON] = str(_folder)
    locate_kernels(kernel_folder)


def kernel_folder() -> Path | None:
    """Return the folder of all kernels. None: not yet known, or numba chooses."""
    return _folder


def _folder_of(digest: str) -> Path:
    root = cache_folder()
    if root is not None:
        return _trusted(root / "kernels", digest)
    return COMPILED if _fits(digest) else _private(digest)


def _private(digest: str) -> Path:
    folder = private_folder("kernels") / digest
    folder.mkdir(exist_ok=True)
    return folder


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
    fault = fault_of(kernels)
    if fault is None and not folder.exists() and _fits(name):
        _copy(COMPILED, folder)
    fault = fault or fault_of(folder)
    if fault is None and not all(is_ours(path.lstat()) for path in folder.rglob("*")):
        fault = "has files of another user"
    if fault is not None:
        cure = "remove the folder" if _fits(name) else "this run compiles; remove the folder"
        LOGGER.warning("%s: kernels are not kept here (%s); %s", folder, fault, cure)
        return COMPILED if _fits(name) else _private(name)
    with contextlib.suppress(OSError):  # another run may remove the same old folders
        os.utime(folder)
        _prune(kernels)
    return folder


@functools.cache
def _fits(digest: str) -> bool:
    """Return whether this package came with kernels of this code, compiled by this numba."""
    try:
        return (COMPILED / DIGEST).read_text(encoding="ascii") == digest
    except (OSError, ValueError):
        return False


def _copy(compiled: Path, folder: Path) -> None:
    """Copy a folder of kernels as a whole: another run never sees half of them."""
    with (
        contextlib.suppress(OSError),  # another run was first, or the disk is full: it compiles
        tempfile.TemporaryDirectory(dir=folder.parent, prefix=".copy-") as new,
    ):
        made = Path(shutil.copytree(compiled, Path(new) / "kernels"))
        made.chmod(0o700)
        made.rename(folder)


@functools.cache
def digest_of(folders: tuple[Path, ...]) -> str:
    """Return the digest of all code in the folders, and of the version of numba."""
    digest = hashlib.sha256(importlib.metadata.version("numba").encode())
    for folder in folders:
        for file in sorted(folder.rglob("*.py")):
            name = file.relative_to(folder).as_posix()
            digest.update(name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


def _prune(root: Path) -> None:
    newest = sorted(root.iterdir(), key=lambda folder: folder.stat().st_mtime, reverse=True)
    for old in newest[KEPT:]:
        shutil.rmtree(old, ignore_errors=True)
