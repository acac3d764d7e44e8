"""A second process that compiles kernels during a first run, as numba compiles one at a time.

The run compiles from the first kernel on, this process from the last kernel back. When they meet,
the run finds the rest in the cache. `compile_beside` starts the process with a pipe as standard
input. It ends when the other end of the pipe is closed.
"""

import contextlib
import logging
import os
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen

from epipole.io.caches.kernels import mark_used, new_kernel_folder, only_one

LOGGER = logging.getLogger(__name__)

# Files in the kernel folder after a first run of the example, one per function; for a bar only.
FILES_OF_A_RUN = 220
LOOKED_EVERY_S = 0.5


@contextlib.contextmanager
def compile_beside() -> Iterator[bool]:
    """Compile in a second process during the first run of this code.

    Yields whether this is the first run. A failure of the process only makes the run slower.
    """
    folder = new_kernel_folder()
    if folder is None:
        yield False
        return
    helper = _start() if (os.cpu_count() or 1) > 1 else None
    try:
        yield True
        mark_used(folder)
    finally:
        if helper is not None:
            helper.kill()
            helper.communicate()


@contextlib.contextmanager
def report_compiling(report: Callable[[int, int], None], is_first: bool = False) -> Iterator[None]:
    """Report how many functions are compiled, as long as this lasts.

    Parameters
    ----------
    report
        Called with the number of new files in the kernel folder, and with how many a first run
        makes; this is 0 in a later run, where nobody knows how many more it needs.
    """
    ended = threading.Event()
    before = 0 if is_first else _count()

    def watch() -> None:
        nonlocal before
        while not ended.wait(LOOKED_EVERY_S):
            # The folder is known as soon as the first module with kernels is imported.
            before = _count() if before is None else before
            if new := (_count() or 0) - (before or 0):
                report(new, max(FILES_OF_A_RUN, new) if is_first else 0)

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        ended.set()
        watcher.join()


def _count() -> int | None:
    """Return the number of files in the kernel folder; None: there is no folder yet."""
    named = os.environ.get("NUMBA_CACHE_DIR")
    return sum(1 for _ in Path(named).glob("*/*.nbi")) if named else None


def _start() -> Popen[bytes] | None:
    command = [sys.executable, "-m", "epipole.io.caches.kernel_warm_up"]
    quiet = DEVNULL
    try:
        return Popen(command, stdin=PIPE, stdout=quiet, stderr=quiet)
    except OSError as error:
        LOGGER.info(
            "kernels are compiled by the run alone: no second process (%s)", error.strerror or error
        )
        return None


def compile_kernels() -> None:
    """Compile the listed kernels that are not in the cache yet, the last one first."""
    # Imports numba, which the starting process does not need yet.
    from epipole.io.caches.kernel_list import kernel, read_kernels, signature

    for name, arguments in reversed(read_kernels()):
        try:
            kernel(name).compile(signature(arguments))
        except Exception as error:
            LOGGER.info("%s could not be compiled beforehand: %r", name, error)


def main() -> None:
    """Compile all kernels, or until the process that started this one has ended."""
    folder = new_kernel_folder()
    if folder is None:
        return
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with only_one(folder) as first:
        if first:
            compile_kernels()


def _end_with_parent() -> None:
    sys.stdin.buffer.read()
    os._exit(0)


if __name__ == "__main__":
    main()
