"""Where numba looks for a kernel of this package: by its module, in one folder for all."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import CacheImpl, _CacheLocator

_PACKAGE = "epipole."
_Folder = Callable[[], Path | None]
_kernel_folder: _Folder = lambda: None  # noqa: E731  set by `locate_kernels`


class KernelLocator(_CacheLocator):
    """The folder of one kernel. numba asks for it when the kernel is declared."""

    def __init__(self, function: Callable[..., Any], folder: Path) -> None:
        """Take the folder of all kernels."""
        self._path = folder / function.__module__.rpartition(".")[0]
        self._line = function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> "KernelLocator | None":
        """Return the locator of a kernel of this package; None: numba goes on to its others."""
        folder = _kernel_folder()
        if folder is None or not py_func.__module__.startswith(_PACKAGE):
            return None
        return cls(py_func, folder)

    def get_cache_path(self) -> str:
        """Return the folder of the kernel's package."""
        return str(self._path)

    def get_source_stamp(self) -> str:
        """Return the same for all: the name of the whole folder changes with the code."""
        return _PACKAGE

    def get_disambiguator(self) -> str:
        """Return what tells functions of one name in a module apart."""
        return str(self._line)


def locate_kernels(folder: _Folder) -> None:
    """Have numba look for the kernels of this package in a folder, from now on."""
    global _kernel_folder
    _kernel_folder = folder
    if KernelLocator not in CacheImpl._locator_classes:
        CacheImpl._locator_classes.insert(0, KernelLocator)


def use_target(name: str) -> None:
    """Compile for this processor, by LLVM's name, without anything beyond it.

    For all functions that numba compiles in this process from now on: it has one target.
    """
    numba.config.CPU_NAME = name  # type: ignore[attr-defined]
    numba.config.CPU_FEATURES = ""  # type: ignore[attr-defined]
