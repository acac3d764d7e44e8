"""All pairs of bright catalogue stars below a separation, sorted by it."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from epipole.tasks.algorithms.kvector import KVector, build_kvector


class PairTable(NamedTuple):
    """Pairs of stars by separation.

    chord : K-vector over 2 sin(separation / 2), ascending. The cosine, which papers sort
        by, is flat at small separations and loses half of the digits there.
    first, second : (n,) int32, rows of the catalogue, first the brighter
    """

    chord: KVector
    first: npt.NDArray[np.int32]
    second: npt.NDArray[np.int32]


def build_pair_table(u_icrs: npt.NDArray[np.float64], max_separation_rad: float) -> PairTable:
    """Return all pairs of (n, 3) stars, brightest first, within `max_separation_rad`."""
    reach = 2.0 * np.sin(min(max_separation_rad, np.pi) / 2)
    pairs = cKDTree(u_icrs).query_pairs(reach, output_type="ndarray").astype(np.int32)
    pairs.sort(axis=1)
    chord = np.linalg.norm(u_icrs[pairs[:, 0]] - u_icrs[pairs[:, 1]], axis=1)
    order = np.lexsort((pairs[:, 1], pairs[:, 0], chord))
    pairs = np.ascontiguousarray(pairs[order].T)
    return PairTable(build_kvector(chord[order]), pairs[0], pairs[1])
