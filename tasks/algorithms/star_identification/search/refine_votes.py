"""Votes sifted: of those in cells that have enough, the ones that agree to their own tolerance.

The cells of `companion_votes` are much wider than a turn is uncertain, so that there are few of
them. Most of those that reach enough votes do so by chance. Here only the votes in such cells are
counted again, in bins about as wide as their tolerance. What is left is worth a try.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel
from epipole.tasks.algorithms.star_identification.search.companion_votes import (
    MAG_GATE,
    is_odd,
    possible_ways,
    shown_magnitudes,
)
from epipole.tasks.algorithms.star_identification.sky.pair_table import TURN

MOST_SIFTED = 1 << 13  # votes that are counted again
_BINS_LOG2 = 14  # a bin belongs to all stars and turns with one hash: collisions only cost time
_FINE_LOG2 = 12  # most bins of a turn


class Sift(NamedTuple):
    """Votes that are counted again.

    star, turn, wide : (n,) int64, the pivot's star, the turn and its tolerance, in parts of `TURN`
    pair, way, companion : (n,) int64, row of the pair table, which of its stars is the pivot's,
        and the number of the companion
    bins : (bins,) int16, the votes of each bin
    """

    star: npt.NDArray[np.int64]
    turn: npt.NDArray[np.int64]
    wide: npt.NDArray[np.int64]
    pair: npt.NDArray[np.int64]
    way: npt.NDArray[np.int64]
    companion: npt.NDArray[np.int64]
    bins: npt.NDArray[np.int16]


@kernel
def make_sift():
    """Return room for `MOST_SIFTED` votes (compiled)."""
    return Sift(
        np.empty(MOST_SIFTED, np.int64),
        np.empty(MOST_SIFTED, np.int64),
        np.empty(MOST_SIFTED, np.int64),
        np.empty(MOST_SIFTED, np.int64),
        np.empty(MOST_SIFTED, np.int64),
        np.empty(MOST_SIFTED, np.int64),
        np.empty(1 << _BINS_LOG2, np.int16),
    )


@borrowing_kernel
def gather(problem, i, n_companions, log2, votes, least, sift):
    """Write the votes of pivot i in cells with at least so many; return how many, and the shift
    of a turn to its bin (compiled). More than `MOST_SIFTED`: there was no room for all."""
    pairs, magnitude = problem.pairs, problem.stars.magnitude
    mag_gate, shift, n, widest = MAG_GATE * problem.rule.spread, 16 - log2, 0, 1
    for m in range(n_companions):
        m_i, m_j, m_ij = shown_magnitudes(problem, i, votes.companion[m])
        as_first, as_second = possible_ways(m_ij, mag_gate)
        for p in range(votes.low[m], votes.high[m]):
            for way in range(0 if as_first else 1, 2 if as_second else 1):
                if way == 0:
                    a, b, turn = pairs.first[p], pairs.second[p], int(pairs.at_first[p])
                else:
                    a, b, turn = pairs.second[p], pairs.first[p], int(pairs.at_second[p])
                turn = (turn - votes.angle[m]) & (TURN - 1)
                if votes.cast[(a << log2) + (turn >> shift)] < least:
                    continue
                if is_odd(magnitude, a, b, m_i, m_j, m_ij, mag_gate):
                    continue
                if n == MOST_SIFTED:
                    return n + 1, 0
                sift.star[n], sift.turn[n], sift.wide[n] = a, turn, votes.wide[m]
                sift.pair[n], sift.way[n], sift.companion[n] = p, way, m
                widest = max(widest, votes.wide[m])
                n += 1
    fine = 16 - _FINE_LOG2
    while (1 << fine) < 2 * widest:
        fine += 1
    return n, fine


@borrowing_kernel
def _bin_of(star, turn):
    return (star * 40_503 + turn * 10_007) & ((1 << _BINS_LOG2) - 1)


@borrowing_kernel
def count_again(n, fine, sift):
    """Count the first n votes in bins of so many bits of a turn (compiled)."""
    sift.bins[:] = 0
    for k in range(n):
        add_vote(k, fine, 1, sift)


@borrowing_kernel
def add_vote(k, fine, times, sift):
    """Count vote k so many times more; -1 takes it back (compiled)."""
    low, high = sift.turn[k] - sift.wide[k], sift.turn[k] + sift.wide[k]
    for turn in range(low >> fine, (high >> fine) + 1):
        sift.bins[_bin_of(sift.star[k], turn & ((TURN >> fine) - 1))] += np.int16(times)


@borrowing_kernel
def agreeing(k, fine, sift):
    """Return the most votes of a bin that vote k is in (compiled)."""
    low, high, most = sift.turn[k] - sift.wide[k], sift.turn[k] + sift.wide[k], 0
    for turn in range(low >> fine, (high >> fine) + 1):
        most = max(most, int(sift.bins[_bin_of(sift.star[k], turn & ((TURN >> fine) - 1))]))
    return most
