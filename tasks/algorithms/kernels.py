"""How kernels are compiled: the one decorator of all compiled loops of the mathematics.

`nogil`: tasks run on threads, and a kernel lets the others go on. `cache`: compiled code is kept
between runs. `error_model`: a division by zero gives inf or NaN as in NumPy, and no exception is
prepared for it in the innermost loop.
"""

from numba import njit

kernel = njit(cache=True, nogil=True, error_model="numpy")
