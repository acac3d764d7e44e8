"""Small symmetric matrices, for kernels: normal equations of any size, and the inverse of a 3x3.

All read a matrix in place and make no arrays. `factor` solves by Cholesky's factor. A 3x3 matrix is
inverted by its cofactors, which takes a third of the time.
"""

import numpy as np

from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel


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
    """Solve L L^T x = b in place, with the lower factor L (n, n) of `factor`; b (n,) becomes x."""
    substitute_forward(L, b)
    _substitute_back(L, b)


@kernel
def substitute_forward(L, b):
    """Solve L x = b in place, with the lower factor L (n, n) of `factor`; b (n,) becomes x.

    The square of x is b^T N^-1 b: of a covariance N^-1, the variance along b.
    """
    for k in range(len(b)):
        for j in range(k):
            b[k] -= L[k, j] * b[j]
        b[k] /= L[k, k]


@kernel
def _substitute_back(L, b):
    """Solve L^T x = b in place; L (n, n) is a lower factor."""
    n = len(b)
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            b[k] -= L[j, k] * b[j]
        b[k] /= L[k, k]


@borrowing_kernel
def invert_symmetric(A, out):
    """Write the inverse of a symmetric matrix A (3, 3) to out (3, 3); return its determinant.

    Only the upper half of A is read; out may be A. Returns 0 and leaves out as it is if the
    determinant is not positive.
    """
    a, b, c = A[0, 0], A[0, 1], A[0, 2]
    d, e, f = A[1, 1], A[1, 2], A[2, 2]
    m00, m01, m02 = d * f - e * e, c * e - b * f, b * e - c * d
    m11, m12, m22 = a * f - c * c, b * c - a * e, a * d - b * b
    det = a * m00 + b * m01 + c * m02
    if not det > 0.0:  # true for NaN
        return 0.0
    out[0, 0], out[1, 1], out[2, 2] = m00 / det, m11 / det, m22 / det
    out[0, 1] = out[1, 0] = m01 / det
    out[0, 2] = out[2, 0] = m02 / det
    out[1, 2] = out[2, 1] = m12 / det
    return det


@borrowing_kernel
def determinant3(A):
    """Return the determinant of a matrix A (3, 3)."""
    return (
        A[0, 0] * (A[1, 1] * A[2, 2] - A[1, 2] * A[2, 1])
        - A[0, 1] * (A[1, 0] * A[2, 2] - A[1, 2] * A[2, 0])
        + A[0, 2] * (A[1, 0] * A[2, 1] - A[1, 1] * A[2, 0])
    )
