"""All pairs of bright catalogue stars below a separation, sorted by it."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from epipole.tasks.algorithms.star_identification.sky.kvector import KVector, build_kvector

# A position angle is stored in this many parts of a turn, so that differences wrap by themselves.
TURN = 1 << 16


NEAR_SHARE = 0.24  # of the longest separation: a third of a square field's stars are so near


class NearStars(NamedTuple):
    """The near neighbours of each star, star by star.

    Star k has the rows first[k]:first[k + 1].

    first : (n_stars + 1,) int64
    other : (m,) int32, the neighbour, a row of the catalogue
    chord : (m,) float, as in `PairTable`
    turn : (m,) uint16, position angle of the neighbour as seen from the star, in parts of `TURN`
    reach : float, the longest of these chords
    """

    first: npt.NDArray[np.int64]
    other: npt.NDArray[np.int32]
    chord: npt.NDArray[np.float64]
    turn: npt.NDArray[np.uint16]
    reach: float


class PairTable(NamedTuple):
    """Pairs of stars by separation.

    chord : K-vector over 2 sin(separation / 2), ascending. Papers sort by the cosine, which is
        flat at small separations and loses half of the digits there.
    first, second : (n,) int32, rows of the catalogue, first the brighter
    at_first, at_second : (n,) uint16, position angle of the other star as seen from each,
        in parts of `TURN`, from `tangent_axes`
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


def build_pair_table(u_icrs: npt.NDArray[np.float64], max_separation_rad: float) -> PairTable:
    """Return all pairs of (n, 3) stars, brightest first, within `max_separation_rad`."""
    reach = 2.0 * np.sin(min(max_separation_rad, np.pi) / 2)
    pairs = cKDTree(u_icrs).query_pairs(reach, output_type="ndarray").astype(np.int32)
    pairs.sort(axis=1)
    chord = np.linalg.norm(u_icrs[pairs[:, 0]] - u_icrs[pairs[:, 1]], axis=1)
    order = np.lexsort((pairs[:, 1], pairs[:, 0], chord))
    a, b = np.ascontiguousarray(pairs[order].T)
    along, across = tangent_axes(u_icrs)
    at_a = position_angle(along[a], across[a], u_icrs[b])
    at_b = position_angle(along[b], across[b], u_icrs[a])
    near = _near_stars(a, b, chord[order], at_a, at_b, len(u_icrs), NEAR_SHARE * reach)
    return PairTable(build_kvector(chord[order]), a, b, at_a, at_b, len(u_icrs), near)


def _near_stars(
    a: npt.NDArray[np.int32],
    b: npt.NDArray[np.int32],
    chord: npt.NDArray[np.float64],
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


def tangent_axes(
    u: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return two (n, 3) unit vectors that complete each direction to a right-handed frame."""
    # Any two will do. The axis crossed with the direction is never parallel to it.
    near_z = np.abs(u[:, 2:]) > 0.9
    along = np.cross(np.where(near_z, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]), u)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return along, np.cross(u, along)


def position_angle(
    along: npt.NDArray[np.float64], across: npt.NDArray[np.float64], other: npt.NDArray[np.float64]
) -> npt.NDArray[np.uint16]:
    """Return the angle of the (n, 3) others about the directions with these axes, in `TURN`."""
    angle = np.arctan2(np.einsum("ni,ni->n", across, other), np.einsum("ni,ni->n", along, other))
    return (np.floor(angle * (TURN / (2 * np.pi))).astype(np.int64) % TURN).astype(np.uint16)
