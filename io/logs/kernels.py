"""How the compiled loops over a log's bytes are compiled.

The same as `epipole.tasks.algorithms.kernels`, which reading may not import; a test holds the
two against each other.
"""

from numba import njit

kernel = njit(cache=True, nogil=True, error_model="numpy")
