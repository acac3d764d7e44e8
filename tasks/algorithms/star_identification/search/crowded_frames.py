"""Lost in space in a crowd: few stars among hundreds of other centroids.

Of hundreds of centroids hardly any pivot is a star, so that many have to be asked, each quickly.
The companions of a pivot are its near ones only: of these, nearly as large a share are stars, and
the sky has fewer pairs that are so close. Each pair of stars of a companion's separation says which
star the pivot may be, and how the image is turned about it. Where enough of them agree, the
attitude is tried on all centroids, as in `lost_in_space`.

One star's turns are counted in the bits of a few words: bit k of word m tells that m + 1 or more of
its neighbours say a turn in bin k of 64.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.kernels import borrowing_kernel, inlined_kernel, kernel
from epipole.tasks.algorithms.star_identification.search.best_attitude import (
    FLOOR,
    WORTH,
    is_clear,
    keep,
    no_attitude,
)
from epipole.tasks.algorithms.star_identification.search.companion_votes import (
    MAG_GATE,
    companion,
    shown_magnitudes,
)
from epipole.tasks.algorithms.star_identification.search.lost_in_space import (
    matches_needed,
    mixed_order,
)
from epipole.tasks.algorithms.star_identification.search.pair_hypotheses import (
    judge_pair,
    make_scratch,
    prepare_pair,
    try_pair,
)
from epipole.tasks.algorithms.star_identification.sky.kvector import range_of
from epipole.tasks.algorithms.star_identification.sky.pair_table import TURN

LEAST_VOTES, LEVELS = 4, 6  # that agree; so many are counted
MOST_CANDIDATES = 40  # stars of a pivot that are looked at again
MOST_TURNS = 512  # of one star that are looked at again
BIN_SHIFT = 10  # of a turn: 64 bins
MOST_BINS = 4096  # of separation
STARS_PER_WORK = 2  # counts of stars that are looked through in the time of a pair


class Companions(NamedTuple):
    """The near companions of a pivot, by separation.

    row : (n,) int64, centroids
    chord, tolerance : (n,) float
    angle, wide : (n,) int64, position angle about the pivot and its tolerance, in parts of `TURN`
    magnitude, difference : (n,) float, see `companion_votes.shown_magnitudes`
    first : (bins + 4,) int64; whatever is within a tolerance of the separation c lies in the rows
        first[k]:first[k + 3], k = floor(c scale)
    scale : float
    """

    row: npt.NDArray[np.int64]
    chord: npt.NDArray[np.float64]
    tolerance: npt.NDArray[np.float64]
    angle: npt.NDArray[np.int64]
    wide: npt.NDArray[np.int64]
    magnitude: npt.NDArray[np.float64]
    difference: npt.NDArray[np.float64]
    first: npt.NDArray[np.int64]
    scale: float


class Turns(NamedTuple):
    """What one star's neighbours say of the turn: companion, neighbour's row, turn, tolerance."""

    row: npt.NDArray[np.int64]
    entry: npt.NDArray[np.int64]
    turn: npt.NDArray[np.int64]
    wide: npt.NDArray[np.int64]


@kernel
def _near_companions(problem, i):
    """Return the companions of pivot i within the reach of the near neighbours."""
    centroids, reach = problem.centroids, problem.pairs.near.reach
    n, widest, kept = len(centroids.u), reach / MOST_BINS, 0
    row, angle, wide = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.int64)
    chord, tolerance, magnitude, difference = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    for j in range(n):
        if j == i:
            continue
        c, t, a, w = companion(centroids, i, j, problem.limits.min_chord)
        if c == 0.0 or c > reach:
            continue
        row[kept], chord[kept], tolerance[kept], angle[kept], wide[kept] = j, c, t, a, w
        _, magnitude[kept], difference[kept] = shown_magnitudes(problem, i, j)
        widest, kept = max(widest, t), kept + 1
    order = np.argsort(chord[:kept])
    chord = chord[:kept][order]
    n_bins = int(reach / widest) + 1
    first = np.searchsorted(chord, widest * np.arange(-1, n_bins + 3))
    return Companions(
        row[:kept][order], chord, tolerance[:kept][order], angle[:kept][order],
        wide[:kept][order], magnitude[:kept][order], difference[:kept][order], first, 1.0 / widest,
    )  # fmt: skip


@borrowing_kernel
def _is_odd(m_s, m_other, q, companions, mag_gate):
    """Tell whether the brightness of companion q contradicts a pivot and a neighbour of these
    magnitudes. Comparisons with NaN are false."""
    odd = abs(m_s - m_other - companions.difference[q]) > 1.414 * mag_gate
    return odd | (abs(m_other - companions.magnitude[q]) > mag_gate)


@borrowing_kernel
def _bins(turn, wide):
    """Return the bins of a turn within its tolerance."""
    said = np.uint64(1) << np.uint64((turn >> BIN_SHIFT) & 63)
    said |= np.uint64(1) << np.uint64(((turn - wide) >> BIN_SHIFT) & 63)
    return said | np.uint64(1) << np.uint64(((turn + wide) >> BIN_SHIFT) & 63)


@borrowing_kernel
def _count(words, star, said):
    """Count what one more neighbour of a star says. No branches: they could not be predicted."""
    words[star, 5] |= words[star, 4] & said
    words[star, 4] |= words[star, 3] & said
    words[star, 3] |= words[star, 2] & said
    words[star, 2] |= words[star, 1] & said
    words[star, 1] |= words[star, 0] & said
    words[star, 0] |= said


@inlined_kernel
def _cast(pairs, magnitude, mag_gate, m_i, companions, words):
    """Count what the companions of a pivot say of its turn, for each star that it may be; return
    how many pairs were looked at."""
    nothing, cast = np.uint64(0), 0
    for q in range(len(companions.chord)):
        c, tolerance = companions.chord[q], companions.tolerance[q]
        angle, wide = companions.angle[q], companions.wide[q]
        low, high = range_of(pairs.chord, c - tolerance, c + tolerance)
        cast += high - low
        for p in range(low, high):
            a, b = pairs.first[p], pairs.second[p]
            m_a, m_b = magnitude[a], magnitude[b]
            # The first star of a pair is the brighter one.
            said = _bins(int(pairs.at_first[p]) - angle, wide)
            odd = _is_odd(m_a, m_b, q, companions, mag_gate) | (abs(m_a - m_i) > mag_gate)
            _count(words, a, nothing if odd else said)
            said = _bins(int(pairs.at_second[p]) - angle, wide)
            odd = _is_odd(m_b, m_a, q, companions, mag_gate) | (abs(m_b - m_i) > mag_gate)
            _count(words, b, nothing if odd else said)
    return cast


@borrowing_kernel
def _turns_of(s, said, near, magnitude, mag_gate, companions, turns):
    """Write what neighbours of star s say of turns in these bins; return how many."""
    n = 0
    for entry in range(near.first[s], near.first[s + 1]):
        c, m_other = near.chord[entry], magnitude[near.other[entry]]
        at = int(c * companions.scale)
        for q in range(companions.first[at], companions.first[at + 3]):
            if abs(companions.chord[q] - c) > companions.tolerance[q] or n == MOST_TURNS:
                continue
            if _is_odd(magnitude[s], m_other, q, companions, mag_gate):
                continue
            turn, wide = int(near.turn[entry]) - companions.angle[q], companions.wide[q]
            touched = False
            for k in range((turn - wide) >> BIN_SHIFT, ((turn + wide) >> BIN_SHIFT) + 1):
                touched |= (said >> np.uint64(k & 63)) & np.uint64(1) == np.uint64(1)
            if touched:
                turns.row[n], turns.entry[n] = companions.row[q], entry
                turns.turn[n], turns.wide[n] = turn, wide
                n += 1
    return n


@borrowing_kernel
def _most_agreed(n, turns):
    """Return which of the first n turns agrees with most others, and with how many and itself."""
    best, most = 0, 0
    for k in range(n):
        agreed = 0
        for m in range(n):
            off = (turns.turn[k] - turns.turn[m]) & (TURN - 1)
            off = min(off, TURN - off)
            agreed += off <= turns.wide[k] + turns.wide[m]
        if agreed > most:
            best, most = k, agreed
    return best, most


@kernel
def _count_pivot(problem, i, words):
    """Count what the near companions of pivot i say of its turn; return these, and the work."""
    m_i = problem.centroids.instrumental[i] + problem.rule.zero_point
    companions = _near_companions(problem, i)
    words[:] = 0
    cast = _cast(
        problem.pairs, problem.stars.magnitude, MAG_GATE * problem.rule.spread, m_i, companions,
        words,
    )  # fmt: skip
    return companions, len(words) // STARS_PER_WORK + cast


@borrowing_kernel
def _least_level(words):
    """Return the least number of votes that few enough stars have."""
    least = LEVELS + 1
    while least > LEAST_VOTES:
        stars = 0
        for s in range(len(words)):
            stars += words[s, least - 2] != 0
        if stars > MOST_CANDIDATES:
            break
        least -= 1
    return least


@kernel
def _try_star(problem, i, s, k, turns, room, best):
    """Try star s for pivot i, with the turn number k that others agree with; return the work."""
    n, n_checked = len(problem.centroids.u), len(room.gain)
    near, j = problem.pairs.near, turns.row[k]
    other, c = near.other[turns.entry[k]], near.chord[turns.entry[k]]
    order = prepare_pair(problem, i, j, c, room)
    log_miss = np.log(1.0 - problem.limits.star_share)
    odds = try_pair(problem.stars, s, other, c, order, log_miss, FLOOR, room)
    if odds < WORTH:
        return 8 * n_checked
    keep(judge_pair(problem, i, s, j, other, best.evidence[1], room), problem, room, best)
    return 8 * n_checked + 20 * n


@kernel
def _try_pivot(problem, i, words, turns, room, best):
    """Try the stars that most turns agree on for pivot i; return the work done."""
    near, magnitude = problem.pairs.near, problem.stars.magnitude
    mag_gate = MAG_GATE * problem.rule.spread
    companions, work = _count_pivot(problem, i, words)
    least = _least_level(words)
    for s in range(len(words) if least <= LEVELS else 0):
        if words[s, least - 1] == 0:
            continue
        n = _turns_of(s, words[s, least - 1], near, magnitude, mag_gate, companions, turns)
        work += 10 + n * n // 4
        k, agreed = _most_agreed(n, turns)
        if agreed >= LEAST_VOTES:
            work += _try_star(problem, i, s, k, turns, room, best)
        if is_clear(best, problem.rule):
            break
    return work


@kernel
def search_crowded(problem, R_best):
    """Return evidence, runner-up's evidence and work done; write the best attitude (compiled).

    Parameters and result are those of `lost_in_space.search`.
    """
    n = len(problem.centroids.u)
    room = make_scratch(n, n)
    best = no_attitude(R_best)
    top, work = best.evidence, 0
    needed = matches_needed(problem)
    if needed > n:
        return top[0], top[1], work
    order = mixed_order(n)
    words = np.empty((problem.pairs.n_stars, LEVELS), np.uint64)
    turns = Turns(
        np.empty(MOST_TURNS, np.int64), np.empty(MOST_TURNS, np.int64),
        np.empty(MOST_TURNS, np.int64), np.empty(MOST_TURNS, np.int64),
    )  # fmt: skip
    # With so many pivots, one is among the matches of any attitude that has enough.
    for p in range(n - needed + 1):
        work += _try_pivot(problem, order[p], words, turns, room, best)
        if work > problem.limits.budget or is_clear(best, problem.rule):
            break
    return top[0], top[1], work
