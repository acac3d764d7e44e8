"""Kernels compiled beside a first run, in a process of their own: numba compiles one at a time.

From the last that a run needs to the first, while the run works from the first to the last;
where the two meet, the rest is in the cache. Started by `compile_beside` with a pipe as standard
input, and gone with the process that holds its other end.
"""

import contextlib
import logging
import os
import sys
import threading
from collections.abc import Iterator
from subprocess import DEVNULL, PIPE, Popen

from epipole.io.caches.kernels import mark_used, new_kernel_folder, only_one

LOGGER = logging.getLogger(__name__)


@contextlib.contextmanager
def compile_beside() -> Iterator[bool]:
    """Have a second process compile, where kernels of this code were never used before.

    Gives whether they were not. What goes wrong there only makes the run slower.
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


def _start() -> Popen[bytes] | None:
    command = [sys.executable, "-m", "epipole.io.caches.kernel_warm_up"]
    quiet = DEVNULL
    try:
        return Popen(command, stdin=PIPE, stdout=quiet, stderr=quiet)
    except OSError as error:
        LOGGER.info("no second process compiles kernels (%s)", error.strerror or error)
        return None


def compile_kernels() -> None:
    """Compile what is listed and not yet in the cache, the last one first."""
    # Numba, which the process that starts this one does not need yet.
    from epipole.io.caches.kernel_list import kernel, read_kernels, signature

    for name, arguments in reversed(read_kernels()):
        try:
            kernel(name).compile(signature(arguments))
        except Exception as error:
            LOGGER.info("%s is left to the run: %r", name, error)


def main() -> None:
    """Compile until it is done, or until the process that started this one is gone."""
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
