"""A cache of arrays on the disk: those that are costly to make and depend only on their inputs.

A file is written under a temporary name and renamed, so several processes can write the same file.
A damaged file is written again.
"""

import contextlib
import logging
import os
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from epipole.io.caches.private_folders import fault_of, is_ours, private_folder

Arrays = Mapping[str, npt.NDArray[Any]]
log = logging.getLogger(__name__)

LARGEST_BYTES = 500_000_000  # of all files together; the least recently used are removed first
OFF = "off"


def cache_folder() -> Path | None:
    """Return the cache folder. None: the user has switched the cache off.

    EPIPOLE_CACHE names the folder ("off": no cache). Otherwise it is ``epipole`` in the cache
    folder of the user, by the XDG base directory specification. Where that folder cannot be
    written or trusted, a warning says so, and a private temporary folder is used instead for this
    process and those that it starts.
    """
    if os.environ.get("EPIPOLE_CACHE") == OFF:
        return None
    folder = _folder_asked()
    fault = "there is no home folder" if folder is None else fault_of(folder)
    if folder is not None and fault is None:
        return folder
    private = private_folder("cache")
    log.warning(
        "%s: no cache here (%s): this run keeps nothing for later ones; "
        "set EPIPOLE_CACHE to a folder that only you can write to",
        folder or "~/.cache/epipole",
        fault,
    )
    os.environ["EPIPOLE_CACHE"] = str(private)
    return private


def _folder_asked() -> Path | None:
    named, home = os.environ.get("EPIPOLE_CACHE"), os.environ.get("XDG_CACHE_HOME")
    if named:
        return Path(named)
    try:
        return (Path(home) if home else Path.home() / ".cache") / "epipole"
    except RuntimeError:  # the user has no home folder
        return None


def cached(key: str, make: Callable[[], Arrays]) -> Arrays:
    """Return the arrays of a key from the cache; if missing, make and keep them.

    Parameters
    ----------
    key
        A digest of everything that the arrays depend on. It is the name of the file.
    """
    folder = cache_folder()
    if folder is None:
        return make()
    path = folder / f"{key}.npz"
    kept = _read(path)
    if kept is not None:
        return kept
    made = make()
    try:
        _write(path, made)
        _prune(folder)
    except OSError as error:  # without a cache the run is only slower
        log.info("%s: cannot keep arrays here (%s)", folder, error.strerror or error)
    return made


def _read(path: Path) -> dict[str, npt.NDArray[Any]] | None:
    try:
        if not is_ours(path.lstat()):
            raise OSError("belongs to another user")
        with np.load(path, allow_pickle=False) as file:  # checks the CRC of every array
            arrays = {name: file[name] for name in file.files}
        with contextlib.suppress(OSError):
            os.utime(path)  # marks it as used
    except FileNotFoundError:
        return None
    except (OSError, ValueError, EOFError, KeyError, RuntimeError, zipfile.BadZipFile) as error:
        log.info("%s: cannot be used and is written again (%s)", path, error)
        return None
    return arrays


def _write(path: Path, arrays: Arrays) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(prefix=".new-", suffix=".npz", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
        os.replace(temporary, path)
    finally:
        Path(temporary).unlink(missing_ok=True)


def _prune(folder: Path) -> None:
    """Remove the least recently used files until the rest is small enough.

    Another process may remove the same files at the same time.
    """
    files = []
    for path in folder.glob("*.npz"):
        with contextlib.suppress(FileNotFoundError):
            status = path.stat()
            files.append((status.st_mtime_ns, status.st_size, path))
    total = 0
    for _, size, path in sorted(files, reverse=True):
        total += size
        if total > LARGEST_BYTES:
            path.unlink(missing_ok=True)
