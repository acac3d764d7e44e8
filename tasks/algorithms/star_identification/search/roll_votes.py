"""Coarse votes: for each star that a pivot may be, how many neighbours agree on the image's turn.

The companions of a pivot are entered once in a table by separation: bit b of a row tells that one
of them stands at bin b of the position angle. A neighbour of a star, at some separation and angle,
says with all these companions at once how the image may be turned: the row of its separation,
rotated by its angle. So a neighbour takes a few nanoseconds, however many companions there are.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel
from epipole.tasks.algorithms.star_identification.star_pairs import TURN

LEVELS = 6  # so many votes are counted
MAX_ROWS = 1024  # of separation
BINS = 128  # of a turn, in two words
BIN = TURN // BINS
PARTS = 4  # a neighbour's angle is known to so many parts of a bin


class Sieve(NamedTuple):
    """Companions of a pivot by separation and position angle.

    word : (rows, PARTS, 2) uint64; row k is for separations of k / scale to (k + 1) / scale, and
        part h for angles that end h / PARTS of a bin after its start
    scale : float
    """

    word: npt.NDArray[np.uint64]
    scale: float


@kernel
def make_sieve(chord, tolerance, angle, wide, reach):
    """Return the companions of these separations and position angles (n,), both with tolerances,
    for separations up to `reach`; angles in parts of `TURN` (compiled)."""
    widest = reach / MAX_ROWS
    for q in range(len(chord)):
        widest = max(widest, 0.5 * tolerance[q])
    word = np.zeros((int(reach / widest) + 1, PARTS, 2), np.uint64)
    for q in range(len(chord)):
        low = max(int((chord[q] - tolerance[q]) / widest), 0)
        high = min(int((chord[q] + tolerance[q]) / widest), len(word) - 1)
        for h in range(PARTS):
            start = h * BIN // PARTS - angle[q] - wide[q]
            stop = (h + 1) * BIN // PARTS - angle[q] + wide[q]
            for b in range(start // BIN, min(stop // BIN, start // BIN + BINS - 1) + 1):
                bit = np.uint64(1) << np.uint64(b & 63)
                for k in range(low, high + 1):
                    word[k, h, (b >> 6) & 1] |= bit
    return Sieve(word, 1.0 / widest)


@borrowing_kernel
def _level(near, s, sieve):
    """Return how many neighbours of star s agree on a turn, at most `LEVELS`."""
    none = np.uint64(0)
    a1, a2, a3, a4, a5, a6 = none, none, none, none, none, none
    b1, b2, b3, b4, b5, b6 = none, none, none, none, none, none
    for entry in range(near.first[s], near.first[s + 1]):
        k, turn = int(near.chord[entry] * sieve.scale), int(near.turn[entry])
        h = (turn * PARTS // BIN) & (PARTS - 1)
        swapped = (turn // BIN) >> 6
        left = np.uint64((turn // BIN) & 63)
        right = np.uint64(63) - left
        low, high = sieve.word[k, h, swapped], sieve.word[k, h, 1 - swapped]
        # Bits that leave one word enter the other. No branches: they could not be predicted.
        a = (low << left) | ((high >> np.uint64(1)) >> right)
        b = (high << left) | ((low >> np.uint64(1)) >> right)
        a6, a5, a4 = a6 | (a5 & a), a5 | (a4 & a), a4 | (a3 & a)
        a3, a2, a1 = a3 | (a2 & a), a2 | (a1 & a), a1 | a
        b6, b5, b4 = b6 | (b5 & b), b5 | (b4 & b), b4 | (b3 & b)
        b3, b2, b1 = b3 | (b2 & b), b2 | (b1 & b), b1 | b
    level = int(a1 | b1 != none) + int(a2 | b2 != none) + int(a3 | b3 != none)
    return level + int(a4 | b4 != none) + int(a5 | b5 != none) + int(a6 | b6 != none)


@kernel
def count_turns(near, start, stop, sieve, share, least, most_stars, level):
    """Write how many neighbours agree on a turn, for the stars start .. stop - 1, and 0 where that
    is less than this share of them; return the least number, at least `least`, that no more than
    so many stars have (compiled).

    More than `LEVELS`: there is none.
    """
    stars = np.zeros(LEVELS + 1, np.int64)
    for s in range(start, stop):
        agreed = _level(near, s, sieve)
        # Where there are many neighbours, as many agree by chance.
        enough = agreed == LEVELS or agreed >= share * (near.first[s + 1] - near.first[s])
        level[s] = agreed if enough else 0
        stars[level[s]] += 1
    enough, total = LEVELS + 1, 0
    while enough > least and total + stars[enough - 1] <= most_stars:
        enough -= 1
        total += stars[enough]
    return enough
