"""Cholesky's factors of small normal equations, in place, for kernels."""

import numpy as np

from epipole.tasks.algorithms.kernels import kernel


@kernel
def factor(N, b):
    """Solve N x = b in place; return ln det N, NaN if N is not positive definite.

    N (n, n) becomes its lower factor; the upper half is neither read nor written. b (n,) becomes x.
    """
    n, log_det = len(b), 0.0
    for k in range(n):
        for j in range(k):
            N[k, k] -= N[k, j] * N[k, j]
        if not N[k, k] > 0.0:
            return np.nan
        N[k, k] = np.sqrt(N[k, k])
        log_det += 2.0 * np.log(N[k, k])
        for i in range(k + 1, n):
            for j in range(k):
                N[i, k] -= N[i, j] * N[k, j]
            N[i, k] /= N[k, k]
        for j in range(k):
            b[k] -= N[k, j] * b[j]
        b[k] /= N[k, k]
    _substitute_back(N, b)
    return log_det


@kernel
def solve_factored(L, b):
    """Solve L L^T x = b in place, with the factor of `factor`."""
    n = len(b)
    for k in range(n):
        for j in range(k):
            b[k] -= L[k, j] * b[j]
        b[k] /= L[k, k]
    _substitute_back(L, b)


@kernel
def _substitute_back(L, b):
    """Solve L^T x = b in place; L (n, n) is a lower factor."""
    n = len(b)
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            b[k] -= L[j, k] * b[j]
        b[k] /= L[k, k]
