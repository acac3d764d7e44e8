"""Files behind fsspec URLs, and the errors of their stores as lines for people."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import Any

from epipole.schemas.errors import LogError


def open_remote(where: str) -> tuple[int, Callable[[int, int], bytes], Callable[[], None]]:
    """Return the size of what a URL names, and functions that fetch a range and that check it.

    The latter raises where what is there is no longer what was opened.

    Raises
    ------
    LogError
        Where there is no such file, or it cannot be read.
    """
    try:
        import fsspec
    except ImportError as error:
        raise LogError(f"{where}: URLs need the package fsspec; install it") from error

    with _as_log_errors(where):
        storage, path = fsspec.core.url_to_fs(where)
        storage.invalidate_cache()  # a listing of earlier may be out of date
        info, version = storage.info(path), storage.ukey(path)
    if info["type"] == "directory":
        raise LogError(f"{where}: is a folder; give the logs in it, such as {where}/*.mcap")

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
                raise LogError(f"{where}: has changed while it was read; run again")

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
    """Return what a store may raise: S3's client has errors that are no OSError."""
    errors: list[Any] = [OSError, ValueError, ImportError]
    client = sys.modules.get("botocore.exceptions")
    if client is not None:
        errors += [client.BotoCoreError, client.ClientError]
    return tuple(errors)


def line_of(error: BaseException) -> str:
    """Return what an error says, in one line."""
    return " ".join(str(error).split()) or type(error).__name__
