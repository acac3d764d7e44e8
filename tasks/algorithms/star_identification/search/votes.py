"""Which star a centroid may be, by votes of its companions.

One centroid is the pivot. Each pair of catalogue stars whose separation is that of the pivot
and another centroid says which star the pivot is and how the image is turned about it. Votes
for one star and one turn add up; a right hypothesis gets one from nearly every true star in
the frame, and counting costs a few nanoseconds a vote, so that all hypotheses of a pivot are
sifted before any is tried. (A Hough transform over star and turn; identifier counters with
the turn added.)
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel
from epipole.tasks.algorithms.star_identification.search.pair_hypotheses import MAX_BETA
from epipole.tasks.algorithms.star_identification.star_pairs import TURN, range_of

# -- Which star a centroid may be, by votes of its companions.
#
# One centroid is the pivot. Each pair of catalogue stars whose separation is that of the pivot
# and another centroid says which star the pivot is and how the image is turned about it. Votes
# for one star and one turn add up; a right hypothesis gets one from nearly every true star in
# the frame, and counting costs a few nanoseconds a vote, so that all hypotheses of a pivot are
# sifted before any is tried. (A Hough transform over star and turn; identifier counters with the
# turn added.)

GATE, MAG_GATE = 2.0, 2.0  # of a pair's separation [sigma] and brightness [spreads]
MIN_BINS_LOG2, MAX_BINS_LOG2 = 4, 8  # of a turn
# Most votes per cell, on average: so few that chance hardly adds up.
THIN = 0.1


class Votes(NamedTuple):
    """Votes of one pivot's companions.

    cast : (stars << MAX_BINS_LOG2,) uint8, votes for a star and a turn
    reached : (256,) how many of these cells have at least so many votes; from two on
    companion, low, high : (n,) the companions and their ranges of pairs
    angle, wide : (n,) their position angles about the pivot and the tolerances of these, in
        parts of `TURN`
    """

    cast: npt.NDArray[np.uint8]
    reached: npt.NDArray[np.int64]
    companion: npt.NDArray[np.int64]
    low: npt.NDArray[np.int64]
    high: npt.NDArray[np.int64]
    angle: npt.NDArray[np.int64]
    wide: npt.NDArray[np.int64]


@kernel
def make_votes(n_stars, n):
    """Return room for the votes of n companions (compiled)."""
    return Votes(
        np.empty(n_stars << MAX_BINS_LOG2, np.uint8),
        np.empty(256, np.int64),
        np.empty(n, np.int64),
        np.empty(n, np.int64),
        np.empty(n, np.int64),
        np.empty(n, np.int64),
        np.empty(n, np.int64),
    )


@kernel
def turn_bits(n_votes, n_stars, tolerance):
    """Return log2 of the number of bins of turn for so many votes with such a typical tolerance
    of turn, in parts of `TURN` (compiled)."""
    fine = math.log2(TURN / max(2.0 * tolerance, 1.0))
    sparse = math.log2(max(n_votes / (THIN * n_stars), 1.0)) + 1.0
    return int(min(max(min(fine, sparse), MIN_BINS_LOG2), MAX_BINS_LOG2))


@borrowing_kernel
def companion(centroids, i, j, min_chord):
    """Return separation (0: too close), its tolerance, position angle of j about i and its
    tolerance, both in parts of `TURN` (compiled)."""
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
def shown_magnitudes(problem, i, j):
    """Return the magnitudes that two centroids show, NaN where the zero point is not known, and
    their difference, NaN where a flux is not known (compiled)."""
    instrumental, zero_point = problem.centroids.instrumental, problem.rule.zero_point
    m_i, m_j = instrumental[i] + zero_point, instrumental[j] + zero_point
    return m_i, m_j, instrumental[i] - instrumental[j]


@borrowing_kernel
def is_odd(magnitude, a, b, m_i, m_j, m_ij, mag_gate):
    """Tell whether the brightness of two centroids contradicts two stars (compiled).

    m_i, m_j, m_ij as from `shown_magnitudes`.
    """
    m_a, m_b = magnitude[a], magnitude[b]
    # Comparisons with NaN are false.
    if abs(m_a - m_b - m_ij) > 1.414 * mag_gate:
        return True
    return abs(m_a - m_i) > mag_gate or abs(m_b - m_j) > mag_gate


@borrowing_kernel
def possible_ways(m_ij, mag_gate):
    """Return whether the pivot may be the first, brighter star of a pair, and the second, by the
    difference of magnitudes that `shown_magnitudes` returns (compiled)."""
    return not m_ij > 1.414 * mag_gate, not m_ij < -1.414 * mag_gate


@borrowing_kernel
def count_votes(problem, i, order, n_least, n_votes, votes):
    """Count the votes of pivot i's companions; return companions, votes cast and log2 of the
    bins of turn (compiled).

    Companions are taken in this order, at least n_least of them, and more until there are
    n_votes. Centroids too close to the pivot are skipped.
    """
    centroids, pairs = problem.centroids, problem.pairs
    n, cast, widest = 0, 0, 0
    for j in order:
        if j == i:
            continue
        c, tolerance, angle, wide = companion(centroids, i, j, problem.limits.min_chord)
        if c == 0.0:
            continue
        lo, hi = range_of(pairs.chord, c - tolerance, c + tolerance)
        votes.companion[n], votes.low[n], votes.high[n] = j, lo, hi
        votes.angle[n], votes.wide[n] = angle, wide
        n, cast, widest = n + 1, cast + 2 * (hi - lo), widest + wide
        if n >= n_least and cast > n_votes:
            break
    log2 = turn_bits(cast, pairs.n_stars, widest / max(n, 1))
    votes.cast[: pairs.n_stars << log2] = 0
    votes.reached[:] = 0
    for m in range(n):
        _vote(problem, i, m, log2, votes)
    return n, cast, log2


@borrowing_kernel
def _vote(problem, i, m, log2, votes):
    """Count the votes of the pivot's m-th companion."""
    pairs, magnitude = problem.pairs, problem.stars.magnitude
    m_i, m_j, m_ij = shown_magnitudes(problem, i, votes.companion[m])
    mag_gate = MAG_GATE * problem.rule.spread
    angle, wide = votes.angle[m], votes.wide[m]
    as_first, as_second = possible_ways(m_ij, mag_gate)
    for p in range(votes.low[m], votes.high[m]):
        a, b = pairs.first[p], pairs.second[p]
        if as_first and not is_odd(magnitude, a, b, m_i, m_j, m_ij, mag_gate):
            _cast(a, int(pairs.at_first[p]) - angle, wide, log2, votes)
        if as_second and not is_odd(magnitude, b, a, m_i, m_j, m_ij, mag_gate):
            _cast(b, int(pairs.at_second[p]) - angle, wide, log2, votes)


@borrowing_kernel
def _cast(star, turn, wide, log2, votes):
    """Count one vote in every cell that its tolerance touches."""
    shift, mask = 16 - log2, (1 << log2) - 1
    for k in range((turn - wide) >> shift, ((turn + wide) >> shift) + 1):
        cell = (star << log2) + (k & mask)
        count = votes.cast[cell] + np.uint8(1)
        votes.cast[cell] = count
        if count > 1:  # one vote is never enough
            votes.reached[count] += 1


# -- Votes sifted: of those in cells that have enough, the ones that agree to their own tolerance.
#
# The cells of `companion_votes` are much wider than a turn is uncertain, so that there are few
# of them. Most of those that reach enough votes do so by chance. Here only the votes in such
# cells are counted again, in bins about as wide as their tolerance. What is left is worth a try.

MAX_SIFTED = 1 << 13  # votes that are counted again
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
    """Return room for `MAX_SIFTED` votes (compiled)."""
    return Sift(
        np.empty(MAX_SIFTED, np.int64),
        np.empty(MAX_SIFTED, np.int64),
        np.empty(MAX_SIFTED, np.int64),
        np.empty(MAX_SIFTED, np.int64),
        np.empty(MAX_SIFTED, np.int64),
        np.empty(MAX_SIFTED, np.int64),
        np.empty(1 << _BINS_LOG2, np.int16),
    )


@borrowing_kernel
def gather(problem, i, n_companions, log2, votes, least, sift):
    """Write the votes of pivot i in cells with at least so many; return how many, and the shift
    of a turn to its bin (compiled). More than `MAX_SIFTED`: there was no room for all."""
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
                if n == MAX_SIFTED:
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
