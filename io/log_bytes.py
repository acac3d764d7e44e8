"""The bytes of a log, wherever it is kept, read in blocks of which only a few are held.

A file is read, not mapped: a mapped file that is cut short by someone else ends the process
that looks at it, without a word.
"""

import hashlib
import os
from collections import OrderedDict, deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

from epipole.io.remote_files import open_remote
from epipole.schemas.errors import LogError

BLOCK_BYTES = 4 << 20
AHEAD = 2  # blocks that are fetched while the ones before them are looked at
KEPT = 4  # blocks held at most: those ahead, and the latest

Read = Callable[[int, int], bytes]


class LogBytes:
    """The bytes of one log, of a size that is fixed when it is opened; a context manager.

    For one thread at a time. Before `stream` every view is a read of its own, for what lies
    scattered; from then on blocks are read ahead, and the SHA-256 is made of them as they pass.
    """

    def __init__(
        self, where: str, size: int, read: Read, check: Callable[[], None] = lambda: None
    ) -> None:
        self._where, self._size, self._read, self._check = where, size, read, check
        self._held = ExitStack()
        self._loads: ThreadPoolExecutor | None = None
        self._blocks: OrderedDict[int, Future[memoryview]] = OrderedDict()
        self._hash = _BlockHash()

    @classmethod
    def of(cls, data: bytes) -> Self:
        """Return bytes in memory as those of a log."""
        return cls("memory", len(data), lambda start, end: data[start:end])

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

    def close(self) -> None:
        """End what reads ahead, and close the file."""
        self._held.close()

    def close_with(self, close: Callable[[], object]) -> Self:
        """Have something done at the end; return this."""
        self._held.callback(close)
        return self

    def stream(self) -> None:
        """Read blocks ahead from now on: the log is about to be walked from front to back."""
        if self._loads is None:
            self._loads = ThreadPoolExecutor(AHEAD, "read log")
            self._held.callback(self._loads.shutdown, cancel_futures=True)
            self._held.callback(self._hash.close)

    def view(self, start: int, end: int) -> memoryview:
        """Return the bytes from `start` to before `end`; both lie in the log.

        Raises
        ------
        LogError
            Where they cannot be read, or are there no more.
        """
        if self._loads is None or start >= end:
            return self._exactly(start, end)
        first, last = start // BLOCK_BYTES, (end - 1) // BLOCK_BYTES
        parts = []
        for k in range(first, last + 1):
            low = k * BLOCK_BYTES
            parts.append(self._block(k)[max(start - low, 0) : end - low])
        return parts[0] if len(parts) == 1 else memoryview(b"".join(parts))

    def sha256(self) -> str:
        """Return the SHA-256 of the whole log, of which the rest is read now.

        Raises
        ------
        LogError
            Also where the log is no longer the one that was opened.
        """
        self.stream()
        for k in range(self._hash.n_taken, -(-self._size // BLOCK_BYTES)):
            self._block(k)
        self._check()
        return self._hash.hexdigest()

    def _block(self, k: int) -> memoryview:
        """Return a block; those before it that were never looked at are hashed first."""
        for passed in range(self._hash.n_taken, k):
            self._hash.take(self._loaded(passed))
        block = self._loaded(k)
        if k == self._hash.n_taken:
            self._hash.take(block)
        return block

    def _loaded(self, k: int) -> memoryview:
        for i in range(k, k + 1 + AHEAD):
            if i in self._blocks:
                self._blocks.move_to_end(i)
            elif i * BLOCK_BYTES < self._size and self._loads is not None:
                self._blocks[i] = self._loads.submit(self._load, i)
        loading = self._blocks[k]
        while len(self._blocks) > KEPT:
            self._blocks.popitem(last=False)
        return loading.result()

    def _load(self, k: int) -> memoryview:
        start = k * BLOCK_BYTES
        return self._exactly(start, min(start + BLOCK_BYTES, self._size))

    def _exactly(self, start: int, end: int) -> memoryview:
        data = self._read(start, end)
        if len(data) != end - start:
            raise LogError(
                f"{self._where}: has become shorter than {self._size:,} bytes while it was read; "
                "read it when nobody writes it"
            )
        return memoryview(data)


class _BlockHash:
    """The SHA-256 of blocks, one behind the other, made beside the work on them."""

    def __init__(self) -> None:
        self.n_taken = 0
        self._digest = hashlib.sha256()
        self._worker: ThreadPoolExecutor | None = None
        self._waiting: deque[Future[None]] = deque()

    def take(self, block: memoryview) -> None:
        """Add the next block."""
        if self._worker is None:
            self._worker = ThreadPoolExecutor(1, "hash log")
        self._waiting.append(self._worker.submit(self._digest.update, block))
        self.n_taken += 1
        if len(self._waiting) > AHEAD:
            self._waiting.popleft().result()

    def hexdigest(self) -> str:
        """Return the hash of all that was taken."""
        while self._waiting:
            self._waiting.popleft().result()
        return self._digest.hexdigest()

    def close(self) -> None:
        """End the worker."""
        if self._worker is not None:
            self._worker.shutdown(cancel_futures=True)


def open_log(where: str) -> LogBytes:
    """Return the bytes of a local file, or of an fsspec URL such as ``s3://bucket/a.mcap``.

    Of a URL the ranges that are looked at are fetched.

    Raises
    ------
    LogError
        Where there is no such file, or it cannot be read.
    """
    if "://" in where:
        return LogBytes(where, *open_remote(where))
    if Path(where).is_dir():
        raise LogError(f"{where}: is a folder; give the logs in it, such as {where}/*.mcap")
    try:
        descriptor = os.open(where, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError as error:
        raise LogError(f"{where}: no such file; check the path") from error
    except OSError as error:
        raise LogError(f"{where}: cannot be read: {error.strerror}") from error

    def read(start: int, end: int) -> bytes:
        data = b""
        try:
            while start < end and (part := os.pread(descriptor, end - start, start)):
                data = data + part if data else part
                start += len(part)
        except OSError as error:
            raise LogError(f"{where}: cannot be read: {error.strerror}") from error
        return data

    size = os.fstat(descriptor).st_size
    return LogBytes(where, size, read).close_with(lambda: os.close(descriptor))
