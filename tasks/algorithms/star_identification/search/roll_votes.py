"""Coarse votes for the roll: of each star that a pivot may be, how many neighbours agree.

The companions of a pivot are entered once in a table. Its rows are bins of separation, its bits
bins of roll: bit b is set if some companion with that separation falls, at roll b, on a neighbour
at position angle 0. A neighbour at another angle has the same bits, rotated by its bin of position
angle. Within the bin, its angle still matters: the table has a row for each of `PARTS` parts of a
bin. Each neighbour of a star votes with its row, rotated. Adding up these rows bit by bit gives the
number of votes for each roll. So a neighbour takes a few nanoseconds, however many companions there
are.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel
from epipole.tasks.algorithms.star_identification.star_pairs import TURN

MAX_COUNTED = 6  # votes for a roll; further ones are not counted
MAX_ROWS = 1024  # of separation, where tolerances are small
ROLL_BINS = 128  # of a full turn: the bits of two words
BIN_WIDTH = TURN // ROLL_BINS
PARTS = 4  # of a bin of position angle


class RollTable(NamedTuple):
    """Companions of a pivot by separation and position angle.

    word : (rows, PARTS, 2) uint64, the bits, 64 in each word. Row k is for chords from k / scale
        to (k + 1) / scale, part h for neighbours whose position angle is in part h of its bin
    scale : float, rows per unit of chord
    """

    word: npt.NDArray[np.uint64]
    scale: float


@kernel
def make_roll_table(chord, tolerance, angle, wide, reach):
    """Return the `RollTable` of a pivot's companions (compiled).

    Parameters
    ----------
    chord, tolerance : (n,) float
        Separations from the pivot, as chords, and their tolerances.
    angle, wide : (n,) int64
        Position angles about the pivot and their tolerances, in parts of `TURN`.
    reach : float
        Largest chord that is looked up.
    """
    widest = reach / MAX_ROWS
    for q in range(len(chord)):
        widest = max(widest, 0.5 * tolerance[q])
    word = np.zeros((int(reach / widest) + 1, PARTS, 2), np.uint64)
    for q in range(len(chord)):
        low = max(int((chord[q] - tolerance[q]) / widest), 0)
        high = min(int((chord[q] + tolerance[q]) / widest), len(word) - 1)
        for h in range(PARTS):
            # Rolls: position angle of the neighbour less that of the companion.
            start = h * BIN_WIDTH // PARTS - angle[q] - wide[q]
            stop = (h + 1) * BIN_WIDTH // PARTS - angle[q] + wide[q]
            first = start // BIN_WIDTH
            for b in range(first, min(stop // BIN_WIDTH, first + ROLL_BINS - 1) + 1):
                bit = np.uint64(1) << np.uint64(b & 63)
                for k in range(low, high + 1):
                    word[k, h, (b >> 6) & 1] |= bit
    return RollTable(word, 1.0 / widest)


@borrowing_kernel
def _n_agreeing(near, s, roll_table):
    """Return how many neighbours of star s agree on a roll, at most `MAX_COUNTED`.

    Bit b of a1 .. a6 is set when roll b has 1 .. 6 votes or more, for the first word of rolls;
    b1 .. b6 are those of the second word.
    """
    none = np.uint64(0)
    a1, a2, a3, a4, a5, a6 = none, none, none, none, none, none
    b1, b2, b3, b4, b5, b6 = none, none, none, none, none, none
    for entry in range(near.first[s], near.first[s + 1]):
        k, turn = int(near.chord[entry] * roll_table.scale), int(near.turn[entry])
        h = (turn * PARTS // BIN_WIDTH) & (PARTS - 1)
        swapped = (turn // BIN_WIDTH) >> 6
        left = np.uint64((turn // BIN_WIDTH) & 63)
        right = np.uint64(63) - left
        low, high = roll_table.word[k, h, swapped], roll_table.word[k, h, 1 - swapped]
        # Rotate both words by `left`: bits that leave one enter the other. Without branches,
        # which could not be predicted.
        a = (low << left) | ((high >> np.uint64(1)) >> right)
        b = (high << left) | ((low >> np.uint64(1)) >> right)
        a6, a5, a4 = a6 | (a5 & a), a5 | (a4 & a), a4 | (a3 & a)
        a3, a2, a1 = a3 | (a2 & a), a2 | (a1 & a), a1 | a
        b6, b5, b4 = b6 | (b5 & b), b5 | (b4 & b), b4 | (b3 & b)
        b3, b2, b1 = b3 | (b2 & b), b2 | (b1 & b), b1 | b
    count = int(a1 | b1 != none) + int(a2 | b2 != none) + int(a3 | b3 != none)
    return count + int(a4 | b4 != none) + int(a5 | b5 != none) + int(a6 | b6 != none)


@kernel
def count_roll_votes(near, start, stop, roll_table, share, min_votes, max_stars, n_agreeing):
    """Count the neighbours that agree on a roll, for the stars start .. stop - 1 (compiled).

    Parameters
    ----------
    near : NearStars
        The neighbours of each star.
    share : float
        Stars of which a smaller share of the neighbours agrees count as 0.
    min_votes, max_stars : int
        Bounds of the result.
    n_agreeing : (stars,) uint8, out
        Number of neighbours that agree, for each star.

    Returns
    -------
    int
        The smallest number of votes, at least `min_votes`, that `max_stars` stars or fewer reach;
        `MAX_COUNTED` + 1 if more stars reach every number.
    """
    stars = np.zeros(MAX_COUNTED + 1, np.int64)  # how many have each number of votes
    for s in range(start, stop):
        agreed = _n_agreeing(near, s, roll_table)
        # Of many neighbours, many agree accidentally.
        enough = agreed == MAX_COUNTED or agreed >= share * (near.first[s + 1] - near.first[s])
        n_agreeing[s] = agreed if enough else 0
        stars[n_agreeing[s]] += 1
    votes, total = MAX_COUNTED + 1, 0
    while votes > min_votes and total + stars[votes - 1] <= max_stars:
        votes -= 1
        total += stars[votes]
    return votes
