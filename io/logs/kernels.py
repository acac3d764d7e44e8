"""How the loops over the bytes of a log are compiled.

The same as `epipole.tasks.algorithms.kernels`, which io may not import. A test compares the two.
"""

from typing import Any

from numba import njit

from epipole.io.caches.kernels import use_kernel_cache

use_kernel_cache()

_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "_nrt": True}

kernel = njit(**_OPTIONS)
