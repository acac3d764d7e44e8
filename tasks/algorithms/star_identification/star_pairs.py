"""Pairs of bright catalogue stars by separation, and the index that finds a range of separations.

`build_pair_table` lists all pairs below a separation in ascending order. A `KVector` over the
separations finds those in a range in constant time, whatever the length of the table.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from epipole.schemas.arrays import Array, Integers
from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.algorithms.kernels import borrowing_kernel

# A full turn in units of a stored position angle: differences wrap by themselves.
TURN_BITS = 16
TURN = 1 << TURN_BITS
# The reach of `NearStars` over the longest separation. A square field's stars lie within this of a
# third of its other stars.
NEAR_SHARE = 0.24


# Ranges in a sorted vector.


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


# The pairs.


@borrowing_kernel
def chord(a, i, b, j):
    """Return the chord between row i of the unit vectors a (n, 3) and row j of b (m, 3)."""
    dx, dy, dz = a[i, 0] - b[j, 0], a[i, 1] - b[j, 1], a[i, 2] - b[j, 2]
    return np.sqrt(dx * dx + dy * dy + dz * dz)


class NearStars(NamedTuple):
    """The near neighbours of each star, star by star.

    Star k has the rows first[k]:first[k + 1].

    first : (n_stars + 1,) int64
    other : (m,) int32, the neighbour, a row of the catalogue
    chord : (m,) float, as in `PairTable`
    turn : (m,) uint16, position angle of the neighbour as seen from the star, in parts of `TURN`
    reach : float, the longest of these chords
    """

    first: Integers
    other: npt.NDArray[np.int32]
    chord: Array
    turn: npt.NDArray[np.uint16]
    reach: float


class PairTable(NamedTuple):
    """Pairs of stars by separation.

    chord : K-vector over 2 sin(separation / 2), ascending. Papers sort by the cosine, which is
        flat at small separations and loses half of the digits there.
    first, second : (n,) int32, rows of the catalogue, first the brighter
    at_first, at_second : (n,) uint16, position angle of the other star as seen from each,
        in parts of `TURN`, from `tangent_basis`
    n_stars : how many of the brightest stars of the catalogue may be in a pair
    near : the pairs that are closer than `NEAR_SHARE` of the longest, star by star
    """

    chord: KVector
    first: npt.NDArray[np.int32]
    second: npt.NDArray[np.int32]
    at_first: npt.NDArray[np.uint16]
    at_second: npt.NDArray[np.uint16]
    n_stars: int
    near: NearStars


def build_pair_table(u_icrs: Array, max_separation_rad: float) -> PairTable:
    """Return all pairs of (n, 3) stars, brightest first, within `max_separation_rad`."""
    reach = 2.0 * np.sin(min(max_separation_rad, np.pi) / 2)
    pairs = cKDTree(u_icrs).query_pairs(reach, output_type="ndarray").astype(np.int32)
    pairs.sort(axis=1)
    chord = np.linalg.norm(u_icrs[pairs[:, 0]] - u_icrs[pairs[:, 1]], axis=1)
    order = np.lexsort((pairs[:, 1], pairs[:, 0], chord))
    a, b = np.ascontiguousarray(pairs[order].T)
    along, across = np.moveaxis(tangent_basis(u_icrs), 1, 0)
    at_a = position_angle(along[a], across[a], u_icrs[b])
    at_b = position_angle(along[b], across[b], u_icrs[a])
    near = _near_stars(a, b, chord[order], at_a, at_b, len(u_icrs), NEAR_SHARE * reach)
    return PairTable(build_kvector(chord[order]), a, b, at_a, at_b, len(u_icrs), near)


def _near_stars(
    a: npt.NDArray[np.int32],
    b: npt.NDArray[np.int32],
    chord: Array,
    at_a: npt.NDArray[np.uint16],
    at_b: npt.NDArray[np.uint16],
    n_stars: int,
    reach: float,
) -> NearStars:
    """Return the pairs below a chord as seen from each of their stars; `chord` ascends."""
    n = int(np.searchsorted(chord, reach, side="right"))
    star = np.concatenate([a[:n], b[:n]])
    order = np.argsort(star, kind="stable")
    return NearStars(
        np.concatenate([[0], np.cumsum(np.bincount(star, minlength=n_stars))]).astype(np.int64),
        np.concatenate([b[:n], a[:n]])[order],
        np.concatenate([chord[:n], chord[:n]])[order],
        np.concatenate([at_a[:n], at_b[:n]])[order],
        reach,
    )


def position_angle(along: Array, across: Array, other: Array) -> npt.NDArray[np.uint16]:
    """Return the angle of the (n, 3) others about the directions with these axes, in `TURN`."""
    angle = np.arctan2(np.einsum("ni,ni->n", across, other), np.einsum("ni,ni->n", along, other))
    return (np.floor(angle * (TURN / (2 * np.pi))).astype(np.int64) % TURN).astype(np.uint16)
