"""K-vector: range search in a sorted vector in constant time, whatever its length."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.kernels import borrowing_kernel

Array = npt.NDArray[np.float64]


class KVector(NamedTuple):
    """A sorted vector with its index.

    s : (n,) float, ascending
    below : (n + 1,) int32, how many s lie at or below the index line at k; below[n] = n
    slope, intercept : of the index line z(k) = intercept + slope k, k = 0 .. n
    """

    s: Array
    below: npt.NDArray[np.int32]
    slope: float
    intercept: float


def build_kvector(s: Array) -> KVector:
    """Return the index of an ascending vector.

    The line runs from just under the first to just over the last element, so that every
    element lies strictly between its ends and equal elements are no special case.

    Raises
    ------
    ValueError
        If the vector does not ascend.

    References
    ----------
    Mortari and Neta (2000), K-vector range searching techniques. Yuan, Zhang, Shi (2017), A
    modified star map identification algorithm based on K vector, have the same with the line
    (1, s(1) - d/2) .. (n, s(n) + d/2), d = (s(n) - s(1)) / (n - 1).
    """
    s = np.ascontiguousarray(s, np.float64)
    n = len(s)
    if n and not np.all(s[1:] >= s[:-1]):
        raise ValueError("a K-vector needs an ascending vector")
    if n == 0:
        return KVector(s, np.zeros(1, np.int32), 1.0, 0.0)
    half_step = 0.5 * (s[-1] - s[0]) / max(n - 1, 1)
    half_step = max(half_step, 1e-15 * max(abs(s[0]), abs(s[-1]), 1e-300))
    intercept = float(s[0] - half_step)
    slope = float((s[-1] + half_step - intercept) / n)
    line = intercept + slope * np.arange(n + 1)
    below = np.searchsorted(s, line, side="right").astype(np.int32)
    below[0], below[-1] = 0, n
    return KVector(s, below, slope, intercept)


@borrowing_kernel
def range_of(index, low, high):
    """Return first and last + 1 of a `KVector`'s elements with low <= s <= high (compiled)."""
    s, below = index.s, index.below
    n = len(s)
    if n == 0 or low > high or high < s[0] or low > s[n - 1]:
        return 0, 0
    # Clamped as floats: far ends would overflow the integers.
    k = int(min(max(np.floor((low - index.intercept) / index.slope), 0.0), float(n)))
    first = below[k]
    # Rounding of the line may be off by an element either way.
    while first > 0 and s[first - 1] >= low:
        first -= 1
    while first < n and s[first] < low:
        first += 1
    k = int(min(max(np.ceil((high - index.intercept) / index.slope), 0.0), float(n)))
    last = below[k]
    while last < n and s[last] <= high:
        last += 1
    while last > first and s[last - 1] > high:
        last -= 1
    return first, last
