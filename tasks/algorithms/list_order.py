"""Lists of unequal length put into another order, piece by piece."""

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt
from numba import njit

Integers = npt.NDArray[np.int64]


def take_lists(
    pieces: Iterable[tuple[npt.NDArray[np.float32], npt.NDArray[np.int32]]],
    lengths: Integers,
    rows: Integers,
) -> tuple[npt.NDArray[np.float32], Integers]:
    """Return the chosen rows' values behind each other, and where each row's begin.

    Parameters
    ----------
    pieces
        Values and (m + 1,) offsets of m rows each; one is asked for at a time, so that it
        can be given up before the next.
    lengths : (n,) int
        Values in each row of all pieces.
    rows : (k,) int
        The rows to take, each at most once, in their new order.

    Returns
    -------
    values : float32
    first : (k + 1,) int
    """
    first = np.zeros(len(rows) + 1, np.int64)
    np.cumsum(lengths[rows], out=first[1:])
    to = np.full(len(lengths), -1)
    to[rows] = first[:-1]
    values = np.empty(first[-1], np.float32)
    n = 0
    for piece, offsets in pieces:
        _scatter(piece, offsets, to[n : n + len(offsets) - 1], values)
        n += len(offsets) - 1
    return values, first


@njit(nogil=True, cache=True)
def _scatter(piece, offsets, to, values):
    for i in range(len(to)):
        if to[i] >= 0:
            shift = to[i] - offsets[i]
            for k in range(offsets[i], offsets[i + 1]):
                values[k + shift] = piece[k]
