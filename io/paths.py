"""Paths and URLs: names that people give, files behind URLs, and errors of stores in one line.

A URL with a password, a token or a signature is known to the rest of the program without it: so
none is in a message, a table, a parameter of Prefect or the name of a folder. What was cut stays in
the environment of this process and of those that it starts, and comes back where a file is opened.
"""

import contextlib
import errno
import itertools
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from epipole.schemas.errors import LogError
from epipole.schemas.text import without_secrets

# Files behind URLs (fsspec).

# URLs with their secrets, a line each. Behind the limit they go on in EPIPOLE_URLS_1, _2 ...:
# Linux starts no process with a variable of 128 KiB.
SECRETS = "EPIPOLE_URLS"
MAX_SECRETS_BYTES = 100_000
BUCKETS = ("s3", "s3a", "gs", "gcs")  # schemes whose URLs begin with a bucket


def known_as(where: str) -> str:
    """Return a path or URL as it may be shown and stored, and keep what was cut from it."""
    shown = without_secrets(where)
    if shown != where and "\0" not in where:
        url, known = where.replace("\n", "%0A"), _secrets()
        if url not in known:
            _keep_secrets([*(each for each in known if without_secrets(each) != shown), url])
    return shown


def _secrets() -> list[str]:
    """Return the URLs with secrets that are known, in the order in which they were given."""
    return [url for name in _variables() for url in os.environ[name].split("\n") if url]


def _variables() -> list[str]:
    names = (f"{SECRETS}_{k}" if k else SECRETS for k in itertools.count())
    return list(itertools.takewhile(lambda name: name in os.environ, names))


def _keep_secrets(urls: Iterable[str]) -> None:
    texts: list[list[str]] = [[]]
    size = 0
    for url in urls:
        size += len(os.fsencode(url)) + 1
        if size > MAX_SECRETS_BYTES and texts[-1]:
            texts.append([])
            size = len(os.fsencode(url)) + 1
        texts[-1].append(url)
    for name in _variables()[len(texts) :]:
        del os.environ[name]
    for k, text in enumerate(texts):
        os.environ[f"{SECRETS}_{k}" if k else SECRETS] = "\n".join(text)


def _with_secrets(where: str) -> str:
    """Return a URL as it was given; one that was found in a folder has the folder's password."""
    by_host = {}
    for url in reversed(_secrets()):
        if without_secrets(url) == where:
            return url
        scheme, _, rest = url.partition("://")
        of_url, is_there, path = rest.partition("/")[0].rpartition("@")
        if is_there:
            by_host[scheme, path] = of_url
    scheme, _, rest = where.partition("://")
    known = by_host.get((scheme, rest.partition("/")[0]))
    return where if known is None else f"{scheme}://{known}@{rest}"


def file_system(where: str) -> tuple[Any, str]:
    """Return the storage that a URL names, as fsspec has it, and the path in it."""
    import fsspec

    given = _with_secrets(where)
    parts, options = urlsplit(given), {}  # raises for an invalid URL, such as http://[::1
    if parts.scheme in ("http", "https"):
        return fsspec.filesystem(parts.scheme), given  # fsspec itself takes :: for something else
    if parts.scheme in BUCKETS and not parts.hostname:
        raise ValueError(f"the URL has no bucket; write {parts.scheme}://BUCKET/PATH")
    if parts.scheme in ("s3", "s3a") and "@" in parts.netloc:
        options = {"key": unquote(parts.username or ""), "secret": unquote(parts.password or "")}
        given = without_secrets(given)
    try:
        return fsspec.core.url_to_fs(given, **options)  # type: ignore[no-any-return]
    except TypeError as error:  # a storage that needs more than a URL, such as reference://
        raise ValueError(f"no storage can be opened by this URL ({line_of(error)})") from error


def open_remote(where: str) -> tuple[int, Callable[[int, int], bytes], Callable[[], None]]:
    """Return the size of the file behind a URL, and two functions: read a range, and check it.

    The check raises where the file has changed since it was opened, if its store has versions of
    files. HTTP has no versions.

    Raises
    ------
    LogError
        Where the file is missing or cannot be read, or its server has no ranges of it.
    """
    where = known_as(where)
    with _as_log_errors(where):
        storage, path = file_system(where)
        storage.invalidate_cache()  # an earlier listing may be out of date
        info, version = storage.info(path), storage.ukey(path)
    if info["type"] == "directory":
        raise LogError(
            f"{where}: is a folder; give the logs in it by a glob pattern, such as {where}/*.mcap"
        )
    if info["size"] is None:
        raise LogError(
            f"{where}: its server does not tell how large it is; copy the file and give that"
        )

    def read(start: int, end: int) -> bytes:
        if start >= end:
            return b""
        with _as_log_errors(where):
            data: bytes = storage.cat_file(path, start=start, end=end)
        if len(data) > end - start:
            raise LogError(
                f"{where}: its server sends more than the range that is asked for; "
                "copy the file and give that"
            )
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
        raise LogError(f"{where}: no such file; check the URL") from shown_error(error)
    except storage_errors() as error:
        raise LogError(f"{where}: cannot be read: {line_of(error)}") from shown_error(error)


def storage_errors() -> tuple[type[Exception], ...]:
    """Return the errors that a store may raise. Those of its client are not all OSErrors."""
    errors: list[Any] = [OSError, ValueError, ImportError]
    if (http := sys.modules.get("aiohttp")) is not None:
        errors.append(http.ClientError)
    client = sys.modules.get("botocore.exceptions")
    if client is not None:
        errors += [client.BotoCoreError, client.ClientError]
    return tuple(errors)


def line_of(error: BaseException) -> str:
    """Return the message of an error as one line, without the secrets of URLs in it."""
    return without_secrets(_line(error))


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def shown_error(error: Exception) -> Exception:
    """Return an error as the cause of another, whose message may be logged.

    Where it quotes a URL with a secret, it is replaced by one of the same effect: a task is tried
    again for it or not.
    """
    if line_of(error) == _line(error):
        return error
    lasting = (FileNotFoundError, PermissionError)
    kind = next((kind for kind in (*lasting, OSError) if isinstance(error, kind)), ValueError)
    return kind(line_of(error))


# Names of files and folders.

LONGEST_PART, LONGEST_PATH = 255, 4095  # bytes that Linux takes


def fault_of_name(name: str) -> str | None:
    """Return why this cannot be the name of a file or folder. None: it can.

    Tables, JSON and Prefect hold text in UTF-8. An empty name would mean the current folder.
    """
    if not name.strip():
        return "the name is empty; give a path or a URL"
    if "\0" in name:
        return "the name has a zero character; give another one"
    try:
        name.encode()
    except UnicodeEncodeError:
        return "the name is not UTF-8; rename it"
    parts = [len(os.fsencode(part)) for part in name.split("/")]
    if "://" not in name and (max(parts) > LONGEST_PART or sum(parts) + len(parts) > LONGEST_PATH):
        return "the name is too long; give a shorter one"
    return None


def is_one_of(out: Path, sources: Iterable[str]) -> bool:
    """Return whether a file to write is one of those that are read: writing would destroy it."""
    paths = [Path(source) for source in sources if "://" not in source]
    return out.exists() and any(path.exists() and out.samefile(path) for path in paths)


def refuse_device(path: Path) -> None:
    """Raise where a path is a pipe or a device, of which reading may never end.

    Raises
    ------
    OSError
        Says so.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OSError(errno.EINVAL, "is a pipe or a device, not a file", str(path))


def bytes_in(folder: Path) -> int:
    """Return the bytes of all files in a folder; those that go meanwhile are not counted."""
    total = 0
    for at, _, files in os.walk(folder):
        for name in files:
            with contextlib.suppress(FileNotFoundError):
                total += os.lstat(os.path.join(at, name)).st_size
    return total


def local_size(where: str) -> int | None:
    """Return the bytes of a file of this machine; None of one behind a URL, or without access."""
    try:
        return os.path.getsize(where)
    except (OSError, ValueError):  # a path with a null byte is a ValueError
        return None
