"""Files behind fsspec URLs, and the errors of object stores as one-line messages."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import Any

from epipole.schemas.errors import LogError


def open_remote(where: str) -> tuple[int, Callable[[int, int], bytes], Callable[[], None]]:
    """Return the size of the file behind a URL, and two functions: read a range, and check it.

    The check raises where the file has changed since it was opened.

    Raises
    ------
    LogError
        Where the file is missing or cannot be read.
    """
    try:
        import fsspec
    except ImportError as error:
        raise LogError(f"{where}: URLs need the package fsspec; install it") from error

    with _as_log_errors(where):
        storage, path = fsspec.core.url_to_fs(where)
        storage.invalidate_cache()  # an earlier listing may be out of date
        info, version = storage.info(path), storage.ukey(path)
    if info["type"] == "directory":
        raise LogError(
            f"{where}: is a folder; give the logs in it by a glob pattern, such as {where}/*.mcap"
        )

    def read(start: int, end: int) -> bytes:
        if start >= end:
            return b""
        with _as_log_errors(where):
            data: bytes = storage.cat_file(path, start=start, end=end)
        return data

    def check() -> None:
        with _as_log_errors(where):
            storage.invalidate_cache()
            if storage.ukey(path) != version:
                raise LogError(f"{where}: changed while it was read; run again")

    return int(info["size"]), read, check


@contextlib.contextmanager
def _as_log_errors(where: str) -> Iterator[None]:
    try:
        yield
    except LogError:
        raise
    except FileNotFoundError as error:
        raise LogError(f"{where}: no such file; check the URL") from error
    except storage_errors() as error:
        raise LogError(f"{where}: cannot be read: {line_of(error)}") from error


def storage_errors() -> tuple[type[Exception], ...]:
    """Return the errors that a store may raise. Those of S3's client are not all OSErrors."""
    errors: list[Any] = [OSError, ValueError, ImportError]
    client = sys.modules.get("botocore.exceptions")
    if client is not None:
        errors += [client.BotoCoreError, client.ClientError]
    return tuple(errors)


def line_of(error: BaseException) -> str:
    """Return the message of an error as one line."""
    return " ".join(str(error).split()) or type(error).__name__
