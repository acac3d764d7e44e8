"""Memory: what a task no longer needs goes back to the system."""

import ctypes
import sys

import pyarrow as pa


def give_back_memory() -> None:
    """Return freed memory to the system.

    Allocators keep it for later. The tasks of a night would add up: each keeps what the largest
    one needed.
    """
    pa.default_memory_pool().release_unused()
    if sys.platform == "linux":
        try:
            ctypes.CDLL(None).malloc_trim(0)
        except AttributeError:  # a C library other than glibc
            return
