"""A folder in which another program makes and removes files all the time."""

import contextlib
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path

N_FILES = 30


@contextlib.contextmanager
def busy(folder: Path) -> Iterator[None]:
    """Make and remove a folder of files in this one, again and again, until the end."""
    ended = threading.Event()

    def work() -> None:
        while not ended.is_set():
            inner = folder / "new" / "inner"
            inner.mkdir(parents=True)
            for k in range(N_FILES):
                (inner / f"{k}").write_bytes(b"x")
            shutil.rmtree(folder / "new")

    worker = threading.Thread(target=work)
    worker.start()
    try:
        yield
    finally:
        ended.set()
        worker.join()
