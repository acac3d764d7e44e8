"""Where numba looks for a kernel of this package, and what it compiles for and names it.

A kernel is in the folder of its module.
"""

import contextlib
import functools
import itertools
import os
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core.bytecode import FunctionIdentity
from numba.core.caching import CacheImpl, _CacheLocator

_FolderOf = Callable[[str], Path | None]
_folder_of: _FolderOf = lambda _: None  # noqa: E731  set by `locate_kernels`


class KernelLocator(_CacheLocator):
    """The folder of one kernel. numba asks for it when the kernel is declared."""

    def __init__(self, function: Callable[..., Any], folder: Path) -> None:
        """Take the folder of the kernel's module."""
        code = function.__code__
        self._path, self._line = folder, code.co_firstlineno
        self._py_file = code.co_filename  # numba names it where it cannot keep a kernel
        with contextlib.suppress(OSError):  # the folder may not exist yet
            os.utime(folder)  # shows that it is in use

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> "KernelLocator | None":
        """Return the locator of a kernel of this package, None for others: numba tries its next."""
        folder = _folder_of(py_func.__module__)
        return None if folder is None else cls(py_func, folder)

    def get_cache_path(self) -> str:
        """Return the folder of the kernel's module."""
        return str(self._path)

    def get_source_stamp(self) -> str:
        """Return the folder's name: it changes with the code of the module."""
        return self._path.name

    def get_disambiguator(self) -> str:
        """Return the line: it distinguishes functions of one name in a module."""
        return str(self._line)


def locate_kernels(folder_of: _FolderOf) -> None:
    """Let numba look for the kernels of a module in the folder `folder_of(module)`, from now on."""
    global _folder_of
    _folder_of = folder_of
    if KernelLocator not in CacheImpl._locator_classes:
        CacheImpl._locator_classes.insert(0, KernelLocator)


def use_target(name: str) -> None:
    """Compile for a processor, by LLVM's name, and use none of this machine's other features.

    Holds for all that numba compiles in this process from now on: it has a single target.
    """
    numba.config.CPU_NAME = name  # type: ignore[attr-defined]
    numba.config.CPU_FEATURES = ""  # type: ignore[attr-defined]


@functools.cache
def name_uniquely() -> None:
    """Give the functions that this process compiles names that no other process gives.

    numba numbers functions from 1 in each process. The number is all that distinguishes inner
    functions of one name and type, such as those of `np.sort` and `np.argsort`. But kernels that
    several processes have compiled are loaded into one, and of two functions of one name the linker
    takes the first for both: a kernel's `np.argsort` returned sorted values (numba issue 10486).
    """
    _number_from_anywhere()
    os.register_at_fork(after_in_child=_number_from_anywhere)


def _number_from_anywhere() -> None:
    FunctionIdentity._unique_ids = itertools.count(2**32 + secrets.randbits(60))
