"""The bytes of a log, wherever it is kept."""

import mmap
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

from epipole.schemas.errors import LogError


def open_log(where: str) -> memoryview:
    """Return the bytes of a local file, or of an fsspec URL such as ``s3://bucket/a.mcap``.

    They are mapped, not read: memory is taken for what is looked at, and given back when it
    is short. What a URL names is copied to a temporary file first.

    Raises
    ------
    LogError
        Where there is no such file, or it cannot be read.
    """
    if "://" in where:
        return _open_url(where)
    path = Path(where)
    if path.is_dir():
        raise LogError(f"{where}: is a folder; give the logs in it, such as {where}/*.mcap")
    try:
        with path.open("rb") as file:
            return _mapped(file.fileno())
    except FileNotFoundError as error:
        raise LogError(f"{where}: no such file; check the path") from error
    except OSError as error:
        raise LogError(f"{where}: cannot be read: {error.strerror}") from error


def _mapped(descriptor: int) -> memoryview:
    if os.fstat(descriptor).st_size == 0:
        return memoryview(b"")
    return memoryview(mmap.mmap(descriptor, 0, access=mmap.ACCESS_READ))


def forget(data: memoryview, start: int, end: int) -> None:
    """Give back the memory of bytes that have been looked at; they can be looked at again."""
    if isinstance(data.obj, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
        start = -(-start // mmap.PAGESIZE) * mmap.PAGESIZE
        length = end // mmap.PAGESIZE * mmap.PAGESIZE - start
        if length > 0:
            data.obj.madvise(mmap.MADV_DONTNEED, start, length)


def _open_url(where: str) -> memoryview:
    try:
        import fsspec
    except ImportError as error:
        raise LogError(f"{where}: URLs need the package fsspec; install it") from error
    try:
        storage, path = fsspec.core.url_to_fs(where)
        if storage.info(path)["type"] == "directory":
            raise LogError(f"{where}: is a folder; give the logs in it, such as {where}/*.mcap")
        with tempfile.NamedTemporaryFile(prefix="epipole-") as file:
            storage.get_file(path, file.name)
            with Path(file.name).open("rb") as copy:
                return _mapped(copy.fileno())
    except LogError:
        raise
    except FileNotFoundError as error:
        raise LogError(f"{where}: no such file; check the URL") from error
    except _storage_errors() as error:
        raise LogError(f"{where}: cannot be read: {_line(error)}") from error


def _storage_errors() -> tuple[type[Exception], ...]:
    """Return what a store may raise: S3's client has errors that are no OSError."""
    errors: list[Any] = [OSError, ValueError, ImportError]
    client = sys.modules.get("botocore.exceptions")
    if client is not None:
        errors += [client.BotoCoreError, client.ClientError]
    return tuple(errors)


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
