"""Compiling the kernels of the list: as a wheel is built, or in a first run without such a wheel.

numba compiles one kernel at a time in a process. So two processes share the list: one from the
first kernel on, the other from the last one back. Where they meet, each finds the rest compiled.
"""

import argparse
import contextlib
import logging
import os
import shutil
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen

from epipole.io.caches.kernels import folder_of, imported_by, kernel_folder

LOGGER = logging.getLogger(__name__)

# Files in the kernel folder, one per function, once all of the list is compiled; for a bar only.
FILES_OF_THE_LIST = 350
LOOKED_EVERY_S = 2.0  # a bar needs no more; a look lists all folders


def compile_kernels(backwards: bool = False) -> None:
    """Load each kernel of the list, and compile those that are not in the folder yet.

    A kernel that cannot be compiled is left to the run that needs it.
    """
    # Imports numba, which the command line does not need before.
    from epipole.io.caches.kernel_list import kernel, read_kernels, signature

    listed = read_kernels()
    for name, arguments in reversed(listed) if backwards else listed:
        try:
            kernel(name).compile(signature(arguments))
        except Exception as error:
            LOGGER.info("%s could not be compiled beforehand: %r", name, error)


def compiled_share() -> float:
    """Return the share of the list's kernels that are in the folder."""
    from epipole.io.caches.kernel_list import read_kernels

    names = [name.partition(":") for name, _ in read_kernels()]
    kept = sum(_is_kept(module, function) for module, _, function in names)
    return kept / len(names) if names else 1.0


def _is_kept(module: str, function: str) -> bool:
    folder = folder_of(module)
    name = f"{module.rpartition('.')[2]}.{function}-*.nbi"
    return folder is not None and any(folder.glob(name))


@contextlib.contextmanager
def second_process() -> Iterator[None]:
    """Have another process compile the list backwards, where there is a second processor."""
    helper = _start() if (os.cpu_count() or 1) > 1 else None
    try:
        yield
    finally:
        if helper is not None:
            helper.kill()
            helper.communicate()


def _start() -> Popen[bytes] | None:
    command = [sys.executable, "-m", "epipole.io.caches.kernel_compiler", "--backwards"]
    try:
        return Popen(command, stdin=PIPE, stdout=DEVNULL, stderr=DEVNULL)
    except OSError as error:
        LOGGER.info("kernels are compiled by one process: %s", error.strerror or error)
        return None


@contextlib.contextmanager
def report_compiling(report: Callable[[int, int], None], total: int = 0) -> Iterator[None]:
    """Report how many functions are compiled, as long as this lasts.

    Parameters
    ----------
    report
        Called with the number of new files in the kernel folder, and with `total`.
    total
        How many there will be, about. 0: nobody knows.
    """
    ended = threading.Event()
    before = _count()

    def watch() -> None:
        nonlocal before
        while not ended.wait(LOOKED_EVERY_S):
            # The folder is known as soon as the first module with kernels is imported.
            before = _count() if before is None else before
            if new := (_count() or 0) - (before or 0):
                report(new, total and max(total, new))

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        ended.set()
        watcher.join()


def _count() -> int | None:
    """Return the number of files in the kernel folder; None: there is no folder yet."""
    folder, count = kernel_folder(), 0
    if folder is None:
        return None
    for module in os.listdir(folder) if folder.is_dir() else ():
        # Another run may just have removed it, or it is a file that is not of this program.
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            count += sum(name.endswith(".nbi") for name in os.listdir(folder / module))
    return count


def compile_into(folder: Path) -> None:
    """Compile all kernels of the list, and put them into a folder that a wheel can carry."""
    from epipole.io.caches.kernel_list import read_kernels

    with report_compiling(_printer(), FILES_OF_THE_LIST), second_process():
        compile_kernels()
    modules = set().union(*(imported_by(name.partition(":")[0]) for name, _ in read_kernels()))
    made = [kept for module in modules if (kept := folder_of(module)) is not None and kept.is_dir()]
    ignored = shutil.ignore_patterns("*.tmp.*")
    for kept in made:
        shutil.copytree(kept, folder / kept.name, dirs_exist_ok=True, ignore=ignored)


def _printer() -> Callable[[int, int], None]:
    """Return what prints a line for each further tenth that is compiled."""
    printed = 0

    def show(new: int, total: int) -> None:
        nonlocal printed
        if total and 10 * new // total > printed:
            printed = 10 * new // total
            print(f"compiled {new} of {total} functions", flush=True)

    return show


def main() -> None:
    """Compile all kernels: `python -m epipole.io.caches.kernel_compiler [--into FOLDER]`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--into", type=Path, help="put them into this folder too")
    # The second process: until the one that started it has ended, which closes standard input.
    parser.add_argument("--backwards", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.backwards:
        threading.Thread(target=_end_with_parent, daemon=True).start()
        compile_kernels(backwards=True)
    elif options.into is not None:
        compile_into(options.into)
    else:
        with second_process():
            compile_kernels()


def _end_with_parent() -> None:
    sys.stdin.buffer.read()
    os._exit(0)


if __name__ == "__main__":
    main()
