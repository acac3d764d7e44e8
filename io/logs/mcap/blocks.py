"""A remote log, fetched in blocks. Each block is fetched once, and a few are kept."""

import hashlib
from collections import OrderedDict, deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

BLOCK_BYTES = 4 << 20
AHEAD = 2  # blocks that are fetched while the block before them is read
KEPT = 4  # blocks in memory at most: those ahead and the latest


class BlockReader:
    """Reads ranges of a remote file; for one thread at a time.

    Before `stream`, each read fetches its own range, which suits scattered reads. After it, blocks
    are fetched ahead, and the SHA-256 is computed from them.
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
        """Return the SHA-256 of the whole file; what is still missing is fetched now.

        What `check` raises is raised here, when everything has been fetched.
        """
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
        """Return a block; blocks before it that were not read yet are hashed first."""
        for passed in range(self._hash.n_taken, k):
            self._hash.take(self._fetched(passed))
        block = self._fetched(k)
        if k == self._hash.n_taken:
            self._hash.take(block)
        return block

    def _fetched(self, k: int) -> memoryview:
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
