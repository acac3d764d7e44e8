"""Which star a centroid may be, by votes of its companions.

One centroid is the pivot, the others its companions. A companion has some separation from the
pivot. Each pair of catalogue stars with that separation gives two votes: either of its stars may be
the pivot, each with one roll of the image about it. A right hypothesis (a star and a roll) gets a
vote from nearly every true star of the frame. This is a Hough transform over star and roll.

1. Votes are counted in coarse cells of star and roll (`count_votes`): a few nanoseconds each.
2. The cells are much wider than a roll is uncertain, so most that reach enough votes are
   false. The votes in such cells are refined: counted again in bins about as wide as their
   tolerance (`gather_votes`, `count_refined`). What still has enough votes is worth a try.

A bin of roll is 2^shift parts of `TURN` wide: a roll, shifted right by that number of bits, is its
bin. `coarse` and `fine` are the shifts of the two counts.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.schemas.arrays import Integers
from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel
from epipole.tasks.algorithms.star_identification.search.pair_hypotheses import MAX_BETA
from epipole.tasks.algorithms.star_identification.star_pairs import TURN, TURN_BITS, range_of

GATE, MAG_GATE = 2.0, 2.0  # of a pair's separation [sigma], of brightness [1-sigma scatter]
MIN_BINS_LOG2, MAX_BINS_LOG2 = 4, 8  # of roll, in a full turn: of the coarse ones
MAX_MEAN_VOTES = 0.1  # per cell: false votes seldom agree then
MAX_CELL_VOTES = 255  # in one cell, which has a byte; further ones are not counted


class Votes(NamedTuple):
    """Votes of one pivot's companions.

    cast : (stars << MAX_BINS_LOG2,) uint8, the votes of each cell, see `cell_of`
    reached : (MAX_CELL_VOTES + 2,) int64, reached[v] cells have v votes or more; counted from v = 2
        on. The last one is 0: a search for a number that few cells reach ends there
    companion, low, high : (n,) int64, the companions, rows of the centroids, and the ranges of the
        pairs with their separation
    angle, wide : (n,) int64, their position angles about the pivot and the tolerances of these, in
        parts of `TURN`
    """

    cast: npt.NDArray[np.uint8]
    reached: Integers
    companion: Integers
    low: Integers
    high: Integers
    angle: Integers
    wide: Integers


@kernel
def make_votes(n_stars, n):
    """Return room for the votes of n companions (compiled)."""
    return Votes(
        np.empty(n_stars << MAX_BINS_LOG2, np.uint8),
        np.empty(MAX_CELL_VOTES + 2, np.int64),
        np.empty(n, np.int64),
        np.empty(n, np.int64),
        np.empty(n, np.int64),
        np.empty(n, np.int64),
        np.empty(n, np.int64),
    )


@kernel
def coarse_shift(n_votes, n_stars, tolerance):
    """Return the shift of the coarse bins of roll (compiled).

    `tolerance` is the typical one of the votes' rolls, in parts of `TURN`; a bin is at least twice
    as wide. There are not more bins than `MAX_MEAN_VOTES` needs.
    """
    by_tolerance = math.log2(TURN / max(2.0 * tolerance, 1.0))
    by_votes = math.log2(max(n_votes / (MAX_MEAN_VOTES * n_stars), 1.0)) + 1.0
    bins_log2 = min(max(min(by_tolerance, by_votes), MIN_BINS_LOG2), MAX_BINS_LOG2)
    return TURN_BITS - int(bins_log2)


@borrowing_kernel
def cell_of(star, roll, coarse):
    """Return the cell of a star and a roll, 0 <= roll < `TURN`: its row of `Votes.cast`.

    The cells of a star follow each other. After the last one those of the next star begin.
    """
    return ((star << TURN_BITS) + roll) >> coarse


@borrowing_kernel
def companion(centroids, i, j, min_chord):
    """Return how centroid j lies about centroid i (compiled).

    Returns
    -------
    chord, tolerance : float
        Chord between the two directions, 0 where it is below `min_chord`, and its tolerance [rad].
    angle, wide : int
        Position angle of j about i, and its tolerance, in parts of `TURN`.
    """
    u, sigma = centroids.u, centroids.sigma
    dx, dy, dz = u[j, 0] - u[i, 0], u[j, 1] - u[i, 1], u[j, 2] - u[i, 2]
    c = math.sqrt(dx * dx + dy * dy + dz * dz)
    if not c >= min_chord:
        return 0.0, 0.0, 0, 0
    x, y, z = u[i, 0], u[i, 1], u[i, 2]
    h = math.sqrt(x * x + z * z)  # axes: y cross u, and u cross that
    along = (z * dx - x * dz) / h
    across = (y * (-x * dx - z * dz) + h * h * dy) / h
    angle = math.floor(math.atan2(across, along) * (TURN / (2.0 * math.pi))) & (TURN - 1)
    noise = GATE * math.sqrt(sigma[i] * sigma[i] + sigma[j] * sigma[j])
    wide = min(noise / c + MAX_BETA, 0.5) * (TURN / (2.0 * math.pi))
    return c, noise + MAX_BETA * c, angle, int(wide) + 2


@borrowing_kernel
def implied_magnitudes(problem, i, j):
    """Return the magnitudes that the fluxes of two centroids imply, and i's less j's (compiled).

    What needs an unknown flux is NaN, and so are the magnitudes while the zero point is unknown.
    """
    instrumental, zero_point = problem.centroids.instrumental, problem.rule.zero_point
    m_i, m_j = instrumental[i] + zero_point, instrumental[j] + zero_point
    return m_i, m_j, instrumental[i] - instrumental[j]


@borrowing_kernel
def contradicts_brightness(magnitude, a, b, m_i, m_j, m_ij, mag_gate):
    """Return whether the brightness of two centroids contradicts two stars (compiled).

    magnitude : (stars,), of the catalogue [mag]. a, b : rows of the stars. m_i, m_j, m_ij : as from
    `implied_magnitudes`. mag_gate : [mag], of one magnitude; that of a difference is wider by the
    root of two. What is unknown (NaN) contradicts nothing.
    """
    m_a, m_b = magnitude[a], magnitude[b]
    if abs(m_a - m_b - m_ij) > 1.414 * mag_gate:
        return True
    return abs(m_a - m_i) > mag_gate or abs(m_b - m_j) > mag_gate


@borrowing_kernel
def possible_ways(m_ij, mag_gate):
    """Return whether the pivot may be the first, brighter star of a pair, and whether the second.

    m_ij [mag] is the pivot's magnitude less its companion's (compiled).
    """
    return not m_ij > 1.414 * mag_gate, not m_ij < -1.414 * mag_gate


@borrowing_kernel
def count_votes(problem, i, order, min_companions, enough_votes, votes):
    """Count the votes of pivot i's companions in `votes` (compiled).

    Companions are taken in `order` (k,) int64, rows of the centroids: at least `min_companions`,
    and more until there are more than `enough_votes`. Centroids too close to the pivot are skipped.

    Returns
    -------
    n, n_votes, coarse : int
        Numbers of companions and of votes, and the shift of the coarse bins.
    """
    centroids, pairs = problem.centroids, problem.pairs
    n, n_votes, sum_wide = 0, 0, 0
    for j in order:
        if j == i:
            continue
        c, tolerance, angle, wide = companion(centroids, i, j, problem.limits.min_chord)
        if c == 0.0:
            continue
        lo, hi = range_of(pairs.chord, c - tolerance, c + tolerance)
        votes.companion[n], votes.low[n], votes.high[n] = j, lo, hi
        votes.angle[n], votes.wide[n] = angle, wide
        n, n_votes, sum_wide = n + 1, n_votes + 2 * (hi - lo), sum_wide + wide
        if n >= min_companions and n_votes > enough_votes:
            break
    coarse = coarse_shift(n_votes, pairs.n_stars, sum_wide / max(n, 1))
    votes.cast[: cell_of(pairs.n_stars, 0, coarse)] = 0
    votes.reached[:] = 0
    for m in range(n):
        _vote(problem, i, m, coarse, votes)
    return n, n_votes, coarse


@borrowing_kernel
def _vote(problem, i, m, coarse, votes):
    """Count the votes of the pivot's m-th companion in the cells."""
    pairs, magnitude = problem.pairs, problem.stars.magnitude
    m_i, m_j, m_ij = implied_magnitudes(problem, i, votes.companion[m])
    mag_gate = MAG_GATE * problem.rule.scatter
    angle, wide = votes.angle[m], votes.wide[m]
    as_first, as_second = possible_ways(m_ij, mag_gate)
    for p in range(votes.low[m], votes.high[m]):
        a, b = pairs.first[p], pairs.second[p]
        if as_first and not contradicts_brightness(magnitude, a, b, m_i, m_j, m_ij, mag_gate):
            _cast(a, int(pairs.at_first[p]) - angle, wide, coarse, votes)
        if as_second and not contradicts_brightness(magnitude, b, a, m_i, m_j, m_ij, mag_gate):
            _cast(b, int(pairs.at_second[p]) - angle, wide, coarse, votes)


@borrowing_kernel
def _cast(star, roll, wide, coarse, votes):
    """Count one vote for a star in each cell of roll that its tolerance touches.

    `roll` and its tolerance `wide` are in parts of `TURN`. `cast` and `reached` of
    `votes` are written.
    """
    first, last_bin = cell_of(star, 0, coarse), (TURN >> coarse) - 1
    for k in range((roll - wide) >> coarse, ((roll + wide) >> coarse) + 1):
        cell = first + (k & last_bin)
        count = votes.cast[cell] + np.uint8(1)  # numba's sum has more than a byte
        if count > MAX_CELL_VOTES:
            continue
        votes.cast[cell] = count
        if count > 1:  # one vote is never enough
            votes.reached[count] += 1


# Refined votes.

MAX_REFINED = 1 << 13  # votes of a pivot that are counted again
_BINS_LOG2 = 14  # one bin for all stars and rolls with the same hash: collisions only cost time
MIN_FINE_SHIFT = 4  # of the finest bins of roll: 4096 in a full turn


class RefinedVotes(NamedTuple):
    """Votes that are counted again.

    star, roll, wide : (n,) int64, the pivot's star, the roll and its tolerance, in parts of `TURN`
    pair, way, companion : (n,) int64, row of the pair table, which of its stars is the pivot's
        (0: the first), and the row of the companion in `Votes`
    bins : (bins,) int16, the votes of each bin
    """

    star: Integers
    roll: Integers
    wide: Integers
    pair: Integers
    way: Integers
    companion: Integers
    bins: npt.NDArray[np.int16]


@kernel
def make_refined_votes():
    """Return room for `MAX_REFINED` votes (compiled)."""
    return RefinedVotes(
        np.empty(MAX_REFINED, np.int64),
        np.empty(MAX_REFINED, np.int64),
        np.empty(MAX_REFINED, np.int64),
        np.empty(MAX_REFINED, np.int64),
        np.empty(MAX_REFINED, np.int64),
        np.empty(MAX_REFINED, np.int64),
        np.empty(1 << _BINS_LOG2, np.int16),
    )


@borrowing_kernel
def gather_votes(problem, i, n_companions, coarse, votes, min_votes, refined):
    """Write pivot i's votes in cells with at least `min_votes` to `refined` (compiled).

    Only the cell in the middle of a vote's tolerance counts. With all cells that it touches, no
    more of 10,000 frames are identified, and a frame in a hundred takes a third longer.

    Returns
    -------
    n, fine : int
        Number of these votes, more than `MAX_REFINED` where they are too many to be written; and
        the shift of the fine bins, which are at least twice as wide as any tolerance.
    """
    pairs, magnitude = problem.pairs, problem.stars.magnitude
    mag_gate, n, widest = MAG_GATE * problem.rule.scatter, 0, 1
    for m in range(n_companions):
        m_i, m_j, m_ij = implied_magnitudes(problem, i, votes.companion[m])
        as_first, as_second = possible_ways(m_ij, mag_gate)
        for p in range(votes.low[m], votes.high[m]):
            for way in range(0 if as_first else 1, 2 if as_second else 1):
                if way == 0:
                    a, b, turn = pairs.first[p], pairs.second[p], int(pairs.at_first[p])
                else:
                    a, b, turn = pairs.second[p], pairs.first[p], int(pairs.at_second[p])
                roll = (turn - votes.angle[m]) & (TURN - 1)
                if votes.cast[cell_of(a, roll, coarse)] < min_votes:
                    continue
                if contradicts_brightness(magnitude, a, b, m_i, m_j, m_ij, mag_gate):
                    continue
                if n == MAX_REFINED:
                    return n + 1, 0
                refined.star[n], refined.roll[n], refined.wide[n] = a, roll, votes.wide[m]
                refined.pair[n], refined.way[n], refined.companion[n] = p, way, m
                widest = max(widest, votes.wide[m])
                n += 1
    fine = MIN_FINE_SHIFT
    while (1 << fine) < 2 * widest:
        fine += 1
    return n, fine


@borrowing_kernel
def _fine_bin(star, roll_bin, fine):
    """Return the bin of a star and a bin of roll: a hash, with two numbers that mix them well.

    `roll_bin`, a roll shifted by `fine`, may be beyond a full turn.
    """
    roll_bin &= (TURN >> fine) - 1
    return (star * 40_503 + roll_bin * 10_007) & ((1 << _BINS_LOG2) - 1)


@borrowing_kernel
def count_refined(n, fine, refined):
    """Count the first n votes anew, in the fine bins (compiled)."""
    refined.bins[:] = 0
    for k in range(n):
        add_vote(k, fine, 1, refined)


@borrowing_kernel
def add_vote(k, fine, times, refined):
    """Add `times` to each bin of vote k; -1 takes the vote back (compiled)."""
    low, high = refined.roll[k] - refined.wide[k], refined.roll[k] + refined.wide[k]
    for roll_bin in range(low >> fine, (high >> fine) + 1):
        refined.bins[_fine_bin(refined.star[k], roll_bin, fine)] += np.int16(times)


@borrowing_kernel
def agreeing(k, fine, refined):
    """Return the number of votes in the fullest bin of vote k (compiled)."""
    low, high, most = refined.roll[k] - refined.wide[k], refined.roll[k] + refined.wide[k], 0
    for roll_bin in range(low >> fine, (high >> fine) + 1):
        most = max(most, int(refined.bins[_fine_bin(refined.star[k], roll_bin, fine)]))
    return most
