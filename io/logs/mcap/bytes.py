"""The bytes of a log, wherever it is kept.

A file is read, not mapped: if another program cuts a mapped file short, the process that reads it
is killed without a message.
"""

import hashlib
import os
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from epipole.io.logs.mcap.blocks import BlockReader
from epipole.io.remote_files import known_as, open_remote
from epipole.schemas.errors import LogError

HASHED_BYTES = 1 << 20  # of a file that are hashed at once
NEAR_BYTES = 1 << 16  # read at once for a small range: the next range mostly follows it


class Reader(Protocol):
    """Reads the bytes of one log."""

    def stream(self) -> None:
        """Prepare for reading from front to back."""

    def read(self, start: int, end: int) -> bytes | memoryview:
        """Return the bytes from `start` to before `end`, or fewer where the log ends."""

    def sha256(self) -> str:
        """Return the SHA-256 of the whole."""

    def close(self) -> None:
        """End all work in the background, and release the file."""


class LogBytes:
    """The bytes of one log, of the size that it had when it was opened; a context manager.

    For one thread at a time.
    """

    def __init__(self, where: str, size: int, reader: Reader) -> None:
        self._where, self._size, self._reader = where, size, reader
        self.stream, self.close = reader.stream, reader.close

    def __len__(self) -> int:
        return self._size

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def view(self, start: int, end: int) -> memoryview:
        """Return the bytes from `start` to before `end`; both lie in the log.

        Raises
        ------
        LogError
            Where they cannot be read, or the log has become shorter.
        """
        data = self._reader.read(start, end)
        if len(data) < end - start:
            raise _has_shrunk(self._where, self._size)
        return memoryview(data)

    def sha256(self) -> str:
        """Return the SHA-256 of the whole log.

        Raises
        ------
        LogError
            Where it cannot be read, or has changed since it was opened.
        """
        return self._reader.sha256()


def open_log(where: str) -> LogBytes:
    """Return the bytes of a local file, or of an fsspec URL such as ``s3://bucket/a.mcap``.

    Of a URL only the ranges that are read are fetched.

    Raises
    ------
    LogError
        Where there is no such file, or it cannot be read.
    """
    if "://" in where:
        where = known_as(where)
        size, fetch, check = open_remote(where)
        return LogBytes(where, size, BlockReader(size, fetch, check))
    if Path(where).is_dir():
        raise LogError(f"{where}: is a folder; give the logs in it, such as {where}/*.mcap")
    try:
        descriptor = os.open(where, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError as error:
        raise LogError(f"{where}: no such file; check the path") from error
    except OSError as error:
        raise LogError(f"{where}: cannot be read: {error.strerror}") from error
    opened = os.fstat(descriptor)
    return LogBytes(where, opened.st_size, _FileReader(where, opened, descriptor))


class _FileReader:
    """A local file; a thread hashes it while it is read."""

    def __init__(self, where: str, opened: os.stat_result, descriptor: int) -> None:
        self._where, self._opened, self._descriptor = where, opened, descriptor
        self._size = opened.st_size
        self._worker = ThreadPoolExecutor(1, "hash log")
        self._hashing: Future[str] | None = None
        self._closed = False
        self._near, self._near_at = b"", 0

    def stream(self) -> None:
        self._hashing = self._hashing or self._worker.submit(self._hash)

    def read(self, start: int, end: int) -> bytes:
        if end - start > NEAR_BYTES // 4:
            return self._read(start, end)
        low = start - self._near_at
        if not 0 <= low <= len(self._near) - (end - start):
            self._near, self._near_at = self._read(start, start + NEAR_BYTES), start
            low = 0
        return self._near[low : low + end - start]

    def _read(self, start: int, end: int) -> bytes:
        data = b""
        try:
            while start < end and (piece := os.pread(self._descriptor, end - start, start)):
                data = data + piece if data else piece
                start += len(piece)
        except OSError as error:
            raise self._unreadable(error) from error
        return data

    def sha256(self) -> str:
        self.stream()
        assert self._hashing is not None  # `stream` starts it
        digest = self._hashing.result()
        now = os.fstat(self._descriptor)
        # A recorder may go on writing behind the bytes that are read. Only then is it worth the
        # time to look whether these have stayed as they were.
        if now.st_mtime_ns != self._opened.st_mtime_ns and (
            now.st_size <= self._size or self._hash() != digest
        ):
            raise LogError(
                f"{self._where}: has changed while it was read; "
                "read it when no program writes to it"
            )
        return digest

    def close(self) -> None:
        self._closed = True
        self._worker.shutdown()
        os.close(self._descriptor)

    def _hash(self) -> str:
        digest, at = hashlib.sha256(), 0
        piece = memoryview(bytearray(HASHED_BYTES))
        try:
            while at < self._size and not self._closed:
                n = os.preadv(self._descriptor, [piece[: self._size - at]], at)
                if n == 0:
                    raise _has_shrunk(self._where, self._size)
                digest.update(piece[:n])
                at += n
        except OSError as error:
            raise self._unreadable(error) from error
        return digest.hexdigest()

    def _unreadable(self, error: OSError) -> LogError:
        return LogError(f"{self._where}: cannot be read: {error.strerror}")


def _has_shrunk(where: str, size: int) -> LogError:
    return LogError(
        f"{where}: has become shorter than {size:,} bytes while it was read; "
        "read it when no program writes to it"
    )
