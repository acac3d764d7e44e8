"""Arrays kept on disk between runs: what is costly to make and the same for the same inputs.

A file is written under another name and renamed, so processes that make the same arrays at
once do each other no harm; one that is damaged is made again.
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

Arrays = Mapping[str, npt.NDArray[Any]]
log = logging.getLogger(__name__)

LARGEST_BYTES = 500_000_000  # of all files; those not used for longest go first
OFF = "off"


def cache_folder() -> Path | None:
    """Return where arrays are kept, None where the user wants none.

    EPIPOLE_CACHE names the folder ("off": keep none); otherwise it is epipole's in the user's
    cache folder, as the XDG base directory specification has it.
    """
    said = os.environ.get("EPIPOLE_CACHE")
    if said:
        return None if said == OFF else Path(said)
    home = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(home) if home else Path.home() / ".cache") / "epipole"
    except RuntimeError:  # a user without a home
        return None


def cached(key: str, make: Callable[[], Arrays]) -> Arrays:
    """Return the arrays kept under a key; where there are none, make and keep them.

    Parameters
    ----------
    key
        A digest of all that the arrays depend on; it is the file's name.
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
    except OSError as error:  # a cache is no reason to fail
        log.info("%s: nothing is kept (%s)", folder, error.strerror or error)
    return made


def _read(path: Path) -> dict[str, npt.NDArray[Any]] | None:
    try:
        with np.load(path, allow_pickle=False) as file:  # checks every array's CRC
            arrays = {name: file[name] for name in file.files}
        with contextlib.suppress(OSError):
            os.utime(path)  # just used
    except FileNotFoundError:
        return None
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
        log.info("%s: damaged, made again (%s)", path, error)
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
    """Remove what was not used for longest until the rest is small enough.

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
