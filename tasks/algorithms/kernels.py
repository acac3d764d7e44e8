"""How kernels are compiled: the decorators of all compiled loops of the mathematics.

`nogil`: tasks run on threads, and a kernel lets the others go on. `cache`: compiled code is kept
between runs. `error_model`: a division by zero gives inf or NaN as in NumPy, and no exception is
prepared for it in the innermost loop.

A `borrowing_kernel` uses only arrays that its caller holds, and counts no references to them.
numba otherwise counts up and down, at each call, every array of every named tuple that is passed:
in the innermost loops that took longer than the computation. So a borrowing kernel makes no arrays
(numba refuses to compile it), returns none, and calls no kernel that returns one: that array would
never be freed. Slices and rows of the caller's arrays are allowed.

An `inlined_kernel` is a borrowing kernel that becomes part of its caller. It is for kernels that
take many arrays, are called for each frame and from one place only: a call copies each array's
address, shape and strides.

Where a compiled kernel cannot be kept, because the disk is full, it is used all the same.
"""

import functools
import logging
from collections.abc import Callable
from typing import Any

from numba import njit
from numba.core.caching import Cache

LOGGER = logging.getLogger(__name__)


def _if_possible(save: Callable[..., None]) -> Callable[..., None]:
    """Return numba's function that keeps compiled code; an error of the disk is one warning."""
    told: set[str] = set()

    @functools.wraps(save)
    def saved(cache: Any, *args: Any) -> None:
        try:
            save(cache, *args)
        except OSError as error:
            reason = error.strerror or str(error)
            if reason not in told:
                told.add(reason)
                LOGGER.warning(
                    "%s: kernels cannot be kept (%s); each run compiles them until there is space",
                    cache.cache_path,
                    reason,
                )

    return saved


Cache.save_overload = _if_possible(Cache.save_overload)  # type: ignore[method-assign]

_COUNTING: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "_nrt": True}
_BORROWING: dict[str, Any] = {**_COUNTING, "_nrt": False}

kernel = njit(**_COUNTING)
borrowing_kernel = njit(**_BORROWING)
inlined_kernel = njit(**{**_BORROWING, "forceinline": True})
