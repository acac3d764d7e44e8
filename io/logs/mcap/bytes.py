"""The bytes of a log: a local file, or a URL from which each block is fetched once.

A file is read, not mapped: if another program cuts a mapped file short, the process that reads it
is killed without a message.
"""

import hashlib
import os
from collections import OrderedDict, deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from epipole.io.paths import known_as, open_remote, refuse_device
from epipole.schemas.errors import LogError

# Remote logs.

BLOCK_BYTES = 4 << 20
AHEAD = 2  # blocks that are fetched while the block before them is read
KEPT = 4  # blocks in memory at most: those ahead and the latest


class BlockReader:
    """Reads ranges of a remote file; for one thread at a time.

    Before `stream`, each read fetches exactly its range, which suits scattered reads. After it,
    blocks are fetched ahead, and the SHA-256 is computed from them. `fetch` returns the bytes from
    one offset to before another; `check` raises if the file has changed.
    """

    def __init__(
        self,
        size: int,
        fetch: Callable[[int, int], bytes],
        check: Callable[[], None] = lambda: None,
    ) -> None:
        self._size, self._fetch, self._check = size, fetch, check
        self._pool: ThreadPoolExecutor | None = None
        self._blocks: OrderedDict[int, Future[memoryview]] = OrderedDict()
        self._hash = _BlockHash()

    def stream(self) -> None:
        """Fetch blocks ahead from now on: the file will be read from front to back."""
        if self._pool is None:
            self._pool = ThreadPoolExecutor(AHEAD, "fetch log")

    def read(self, start: int, end: int) -> bytes | memoryview:
        """Return the bytes from `start` to before `end`."""
        if self._pool is None or start >= end:
            return self._fetch(start, end)
        first, last = start // BLOCK_BYTES, (end - 1) // BLOCK_BYTES
        pieces = []
        for k in range(first, last + 1):
            low = k * BLOCK_BYTES
            pieces.append(self._block(k)[max(start - low, 0) : end - low])
        return pieces[0] if len(pieces) == 1 else b"".join(pieces)

    def sha256(self) -> str:
        """Return the SHA-256 of the whole file; fetch what was not read, and call `check` last."""
        self.stream()
        for k in range(self._hash.n_taken, -(-self._size // BLOCK_BYTES)):
            self._block(k)
        self._check()
        return self._hash.hexdigest()

    def close(self) -> None:
        """Cancel the fetches that have not begun, and end the threads."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
        self._hash.close()

    def _block(self, k: int) -> memoryview:
        """Return block k; blocks before it that were not read yet are fetched and hashed first."""
        for passed in range(self._hash.n_taken, k):
            self._hash.take(self._fetched(passed))
        block = self._fetched(k)
        if k == self._hash.n_taken:
            self._hash.take(block)
        return block

    def _fetched(self, k: int) -> memoryview:
        """Return block k, and begin to fetch those ahead of it."""
        for i in range(k, k + 1 + AHEAD):
            if i in self._blocks:
                self._blocks.move_to_end(i)
            elif i * BLOCK_BYTES < self._size and self._pool is not None:
                self._blocks[i] = self._pool.submit(self._fetch_block, i)
        fetching = self._blocks[k]
        while len(self._blocks) > KEPT:
            self._blocks.popitem(last=False)
        return fetching.result()

    def _fetch_block(self, k: int) -> memoryview:
        start = k * BLOCK_BYTES
        return memoryview(self._fetch(start, min(start + BLOCK_BYTES, self._size)))


class _BlockHash:
    """The SHA-256 of consecutive blocks, computed by a thread while they are read."""

    def __init__(self) -> None:
        self.n_taken = 0
        self._digest = hashlib.sha256()
        self._worker = ThreadPoolExecutor(1, "hash log")
        self._waiting: deque[Future[None]] = deque()

    def take(self, block: memoryview) -> None:
        """Add the next block."""
        self._waiting.append(self._worker.submit(self._digest.update, block))
        self.n_taken += 1
        if len(self._waiting) > AHEAD:
            self._waiting.popleft().result()

    def hexdigest(self) -> str:
        """Return the hash of all blocks that were added."""
        while self._waiting:
            self._waiting.popleft().result()
        return self._digest.hexdigest()

    def close(self) -> None:
        """End the worker."""
        self._worker.shutdown(cancel_futures=True)


# Logs of both kinds.

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
        refuse_device(Path(where))
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
