"""How kernels are compiled: the decorators of all compiled functions.

`nogil`: tasks run in threads, and a kernel does not block the others. `cache`: compiled code is
kept between runs. `error_model`: a division by zero gives inf or NaN as in NumPy, and no exception
is prepared for it in the innermost loop.

A `borrowing_kernel` uses only arrays of its caller, without reference counts. numba otherwise
counts, at each call, the references to every array of every named tuple that is passed: in the
innermost loops that took longer than the computation. So a borrowing kernel must not make arrays
(numba refuses to compile it), must not return one, and must not call a kernel that returns one:
that array would never be freed. Slices and rows of the caller's arrays are allowed.

An `inlined_kernel` is a borrowing kernel that becomes part of its callers. It is for kernels that
take many arrays and have one or two callers, which call them for each frame or seed: a call copies
each array's address, shape and strides.

If a compiled kernel cannot be cached, because the disk is full, it is still used.
"""

import functools
import logging
from collections.abc import Callable
from typing import Any

from numba import njit
from numba.core.caching import Cache

LOGGER = logging.getLogger(__name__)


def _warn_if_it_fails(save: Callable[..., None]) -> Callable[..., None]:
    """Wrap numba's function that saves compiled code: an error of the disk becomes one warning."""
    warned: set[str] = set()

    @functools.wraps(save)
    def saved(cache: Any, *args: Any) -> None:
        try:
            save(cache, *args)
        except OSError as error:
            reason = error.strerror or str(error)
            if reason not in warned:
                warned.add(reason)
                LOGGER.warning(
                    "%s: kernels cannot be kept (%s); each run compiles them until there is space",
                    cache.cache_path,
                    reason,
                )

    return saved


Cache.save_overload = _warn_if_it_fails(Cache.save_overload)  # type: ignore[method-assign]

_COUNTING: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "_nrt": True}
_BORROWING: dict[str, Any] = {**_COUNTING, "_nrt": False}

kernel = njit(**_COUNTING)
borrowing_kernel = njit(**_BORROWING)
inlined_kernel = njit(**{**_BORROWING, "forceinline": True})
