"""The logs in a folder, of a glob or at a URL."""

import glob
import logging
import os
from pathlib import Path

from epipole.io.paths import (
    fault_of_name,
    file_system,
    known_as,
    line_of,
    shown_error,
    storage_errors,
)
from epipole.schemas.errors import LogError
from epipole.schemas.text import without_secrets

LOGGER = logging.getLogger(__name__)

SUFFIX = ".mcap"  # of the logs in a folder
PATTERN = f"*{SUFFIX}"


def list_logs(where: str) -> tuple[list[str], bool]:
    """Return the logs that a path or URL names, sorted, and whether it names one log directly.

    Parameters
    ----------
    where
        A file, a folder (its ``*.mcap``, however deep) or a glob (``**`` matches sub-folders). It
        is local or an fsspec URL such as ``s3://bucket/logs``. A ``file://`` URL becomes a local
        path.

    Raises
    ------
    LogError
        Where there are no logs, or the storage does not answer.
    """
    if (fault := fault_of_name(where)) is not None:
        raise LogError(f"log {without_secrets(where)}: {fault}")
    where = known_as(where)
    logs, is_one = _list_url(where) if "://" in where else _list_local(where)
    if not logs:
        raise LogError(f"{where}: {_nothing(where)}")
    for log in logs:
        if (fault := fault_of_name(log)) is not None:
            raise LogError(f"{log}: {fault}")
    return sorted(logs), is_one


def _list_local(where: str) -> tuple[list[str], bool]:
    path = Path(where)
    try:
        if path.is_dir():
            return _list_folder(path), False
        if path.is_file():
            return [where], True
        if path.exists():
            raise LogError(f"{where}: is a pipe or a device, not a file; give a file")
        return [name for name in glob.iglob(where, recursive=True) if Path(name).is_file()], False
    except OSError as error:
        raise LogError(f"{where}: cannot be read: {error.strerror}") from error


def _list_folder(folder: Path) -> list[str]:
    """Return the logs in a folder, however deep; a line says which folders cannot be read.

    Links lead to folders too; a folder that several paths lead to is read once.
    """
    logs: list[str] = []
    read: set[str] = set()
    for at, folders, names in os.walk(folder, onerror=_warn_of_folder, followlinks=True):
        real = os.path.realpath(at)
        if real in read:
            folders.clear()
            continue
        read.add(real)
        folders.sort()
        files = (Path(at) / name for name in names if name.endswith(SUFFIX))
        logs += [str(file) for file in files if file.is_file()]
    return logs


def _warn_of_folder(error: OSError) -> None:
    LOGGER.warning("%s: left out: cannot be read: %s", error.filename, error.strerror)


def _list_url(where: str) -> tuple[list[str], bool]:
    from fsspec.implementations.local import LocalFileSystem

    try:
        storage, path = file_system(where)
        if isinstance(storage, LocalFileSystem):
            return _list_local(path)
        storage.invalidate_cache()  # a worker runs for weeks, and new logs come every night
        is_glob = glob.has_magic(path)
        if not is_glob and storage.isfile(path):
            return [where], True
        if is_glob:
            entries = storage.glob(path, detail=True).values()
        else:
            entries = storage.find(path, detail=True).values()
        files = [
            entry["name"]
            for entry in entries
            if entry["type"] == "file" and (is_glob or entry["name"].endswith(SUFFIX))
        ]
        return [known_as(storage.unstrip_protocol(name)) for name in files], False
    except FileNotFoundError as error:
        raise LogError(f"{where}: no such folder; check the URL") from shown_error(error)
    except storage_errors() as error:
        raise LogError(f"{where}: cannot be read: {line_of(error)}") from shown_error(error)


def _nothing(where: str) -> str:
    if glob.has_magic(where):
        return "no file matches; check the pattern"
    if "://" in where:
        return f"no such log, and no folder with logs ({PATTERN}); check the URL"
    if Path(where).is_dir():
        return f"no logs in this folder ({PATTERN}); check the path"
    return "no such file; check the path"
