"""The folder of compiled kernels, and what each of them depends on.

By default numba keeps a kernel beside its source file, checks only that file, and compiles for the
processor at hand. So it does not notice a change in a function of another file that the kernel
calls, and no kernel serves another environment or machine. Here one folder holds the kernels of all
versions: those of a module are in a folder with a digest in its name, of the module and all modules
that it imports. They are made for any x86-64 processor of level 3 (AVX2, since 2013), where this
is one. A wheel carries such a folder, `compiled`; its first use copies it into the user's cache.
"""

import contextlib
import functools
import hashlib
import importlib.metadata
import logging
import os
import re
import shutil
import tempfile
from pathlib import Path

from epipole.io.caches.arrays import cache_folder
from epipole.io.caches.kernel_target import common_target
from epipole.io.caches.private_folders import fault_of, is_ours, private_folder

LOGGER = logging.getLogger(__name__)

PACKAGE = "epipole"
_ROOT = Path(__file__).parents[2]  # of the package
COMPILED = Path(__file__).parent / "compiled"  # of a wheel; a checkout lacks it
# The folder of a process, for those that it starts: a temporary one is shared with them.
HANDED_ON = "EPIPOLE_KERNELS"
NAMING = 2  # of functions in kernels: those of another naming are not used
KEPT = 400  # folders of modules: those of seven versions that differ in all of them

_IMPORT = re.compile(
    rf"^\s*(?:from\s+({PACKAGE}[\w.]*)\s+import\s+(\([^)]*\)|[^\n]*)|import\s+({PACKAGE}[\w.]*))",
    re.MULTILINE,
)

_folder: Path | None = None


def use_kernel_cache() -> None:
    """Let numba find and keep kernels in the user's cache folder.

    A user's NUMBA_CACHE_DIR takes precedence, if it can be written: numba then works as always.
    With EPIPOLE_CACHE=off nothing is kept: without the wheel's kernels each process compiles.

    Called before any kernel is declared: numba then decides where it is kept.
    """
    global _folder
    # Imports numba: as late as possible.
    from epipole.io.caches.kernel_locator import locate_kernels, name_uniquely, use_target

    name_uniquely()
    given = os.environ.get(HANDED_ON)
    is_given = bool(given) and Path(str(given)).is_dir()
    named = os.environ.get("NUMBA_CACHE_DIR")
    if not is_given and named and _is_writable(Path(named)):
        return
    target = common_target()
    if target is not None:
        use_target(target)
    if is_given:
        _folder = Path(str(given))
    else:
        root = cache_folder()
        _folder = _filled(private_folder("kernels") if root is None else _trusted(root / "kernels"))
    os.environ[HANDED_ON] = str(_folder)
    locate_kernels(folder_of)


def kernel_folder() -> Path | None:
    """Return the folder of all kernels. None: not yet known, or numba chooses."""
    return _folder


def folder_of(module: str) -> Path | None:
    """Return the folder of a module's kernels. None: of another package, or numba chooses."""
    if _folder is None or not module.startswith(f"{PACKAGE}."):
        return None
    return _folder / f"{module.removeprefix(PACKAGE + '.')}-{digest_of(module)}"


@functools.cache  # asked for each kernel of a module
def digest_of(module: str, root: Path = _ROOT) -> str:
    """Return the digest of a module, of all modules that it imports, and of numba's version."""
    digest = hashlib.sha256(f"{importlib.metadata.version('numba')} {NAMING}".encode())
    for name in sorted(imported_by(module, root)):
        digest.update(name.encode() + b"\0" + _source(name, root).encode())
    return digest.hexdigest()[:16]


def imported_by(module: str, root: Path = _ROOT) -> set[str]:
    """Return the modules of this package that a module imports, directly or not, and itself."""
    found, left = set[str](), [module]
    while left:
        name = left.pop()
        if name not in found:
            found.add(name)
            left.extend(_imports(name, root))
    return found


@functools.cache
def _imports(module: str, root: Path) -> tuple[str, ...]:
    """Return the modules of this package that stand in a module's imports.

    Those that are only part of their path are left out: packages run no code of kernels.
    """
    found = []
    for of, names, whole in _IMPORT.findall(_source(module, root)):
        parts = [part.split() for part in names.strip("()").split(",")]
        found += [whole or of, *(f"{of}.{part[0]}" for part in parts if part)]
    return tuple(name for name in found if _source(name, root))


@functools.cache
def _source(module: str, root: Path) -> str:
    """Return the text of a module of this package; empty: it is a package, or there is none."""
    path = root.joinpath(*module.split(".")[1:]).with_suffix(".py")
    try:
        return path.read_text(encoding="utf-8")
    except OSError:
        return ""


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


def _trusted(kernels: Path) -> Path:
    """Return the folder; a private one where others may have put kernels into it.

    A kernel is code: numba runs what it finds.
    """
    fault = fault_of(kernels)
    if fault is None and not _all_ours(kernels):
        fault = "has files of another user"
    if fault is not None:
        LOGGER.warning("%s: kernels are not kept here (%s); remove the folder", kernels, fault)
        return private_folder("kernels")
    _prune(kernels)
    return kernels


def _all_ours(kernels: Path) -> bool:
    for at, folders, files in os.walk(kernels):
        for name in (*folders, *files):
            with contextlib.suppress(FileNotFoundError):  # another run has renamed or removed it
                if not is_ours(os.lstat(os.path.join(at, name))):
                    return False
    return True


def _filled(folder: Path) -> Path:
    """Copy the kernels of the wheel that the folder lacks, each module's as a whole."""
    given = COMPILED.iterdir() if COMPILED.is_dir() else ()
    with contextlib.suppress(OSError):  # another run was first, or the disk is full: it compiles
        for module in given:
            kept = folder / module.name
            if not kept.exists():
                with tempfile.TemporaryDirectory(dir=folder, prefix=".copy-") as new:
                    made = Path(shutil.copytree(module, Path(new) / "kernels"))
                    made.chmod(0o700)
                    with contextlib.suppress(OSError):
                        made.rename(kept)
    return folder


def _prune(kernels: Path) -> None:
    """Remove the folders that no process has used for longest."""
    with contextlib.suppress(OSError):  # another run removes the same ones
        newest = sorted(kernels.iterdir(), key=lambda folder: folder.stat().st_mtime, reverse=True)
        for old in newest[KEPT:]:
            shutil.rmtree(old, ignore_errors=True)
