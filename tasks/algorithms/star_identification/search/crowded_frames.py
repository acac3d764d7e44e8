"""Lost in space in a crowd: few stars among hundreds of other centroids.

Of hundreds of centroids hardly any pivot is a star, so that many have to be asked, each quickly.
The companions of a pivot are its near ones only: of these, nearly as large a share are stars, and
the sky has fewer pairs that are so close.

1. Pivots in the middle of the image come first: there, all neighbours of a star are in the image.
2. Star after star is taken for the pivot. Where a companion has the separation of one of the star's
   neighbours, it says how the image is turned. `roll_votes` counts coarsely how many agree; where
   a star has many neighbours, a share of them must.
3. Of stars with enough votes these are counted to their own tolerance.
4. Where enough agree, the farthest of them gives the attitude, with which the other stars of the
   field are looked up among the centroids (`verify_field`): some twenty look-ups, where all
   centroids would be a thousand.
5. What is left is tried on all centroids, as in `lost_in_space`.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel
from epipole.tasks.algorithms.star_identification.search.lost_in_space import (
    matches_needed,
    mixed_order,
)
from epipole.tasks.algorithms.star_identification.search.pair_hypotheses import (
    FLOOR,
    WORTH,
    is_clear,
    judge_pair,
    keep,
    make_scratch,
    no_attitude,
    prepare_pair,
    try_pair,
)
from epipole.tasks.algorithms.star_identification.search.roll_votes import (
    LEVELS,
    count_turns,
    make_sieve,
)
from epipole.tasks.algorithms.star_identification.search.verify_field import (
    SHOWN,
    make_places,
    odds_of_field,
)
from epipole.tasks.algorithms.star_identification.search.votes import (
    MAG_GATE,
    companion,
    shown_magnitudes,
)
from epipole.tasks.algorithms.star_identification.star_pairs import TURN

# Rounds: least votes that agree, and most stars of a pivot whose votes are counted closely.
ROUNDS = ((4, 600), (3, 4000), (2, 4000))
WORTH_ALL = 8.0  # log odds of a field with which an attitude is tried on all centroids
SAMPLES, TIERS = 64, 4  # of a pivot's surroundings, and how finely pivots are put in order by them
MAX_TURNS = 512  # of one star
BIN_SHIFT = 8  # of a turn: 256 bins
MAX_BINS = 4096  # of separation
# In the time of a unit of work: neighbours in the sieve, votes, pairs of votes. A star takes more.
NEIGHBOURS_PER_WORK, VOTES_PER_WORK, AGREED_PER_WORK, STAR_WORK = 3, 2, 20, 10


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
    """What one star's neighbours say of the turn: companion, neighbour's row, turn, tolerance; and
    the votes of each bin."""

    row: npt.NDArray[np.int64]
    entry: npt.NDArray[np.int64]
    turn: npt.NDArray[np.int64]
    wide: npt.NDArray[np.int64]
    votes: npt.NDArray[np.uint16]


@kernel
def _near_companions(problem, i):
    """Return the companions of pivot i within the reach of the near neighbours."""
    centroids, reach = problem.centroids, problem.pairs.near.reach
    n, widest, kept = len(centroids.u), reach / MAX_BINS, 0
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


@kernel
def _shares_inside(u, box, reach):
    """Return for each pivot which share of its surroundings is in the image."""
    inside = np.zeros(len(u))
    for k in range(SAMPLES):
        # Evenly over the disc: Vogel's spiral (1979).
        r, turn = reach * math.sqrt((k + 0.5) / SAMPLES), 2.399963 * k
        dx, dy = r * math.cos(turn), r * math.sin(turn)
        for i in range(len(u)):
            x, y = u[i, 0] / u[i, 2] + dx, u[i, 1] / u[i, 2] + dy
            inside[i] += (box[0] < x < box[1]) & (box[2] < y < box[3])
    return inside / SAMPLES


@kernel
def _pivots(inside):
    """Return the pivots, those in the middle of the image first: there, all neighbours are seen."""
    order = mixed_order(len(inside))
    return order[np.argsort(-np.floor(TIERS * inside[order]), kind="mergesort")]


@borrowing_kernel
def _is_odd(m_s, m_other, q, companions, mag_gate):
    """Tell whether the brightness of companion q contradicts a pivot and a neighbour of these
    magnitudes. Comparisons with NaN are false."""
    odd = abs(m_s - m_other - companions.difference[q]) > 1.414 * mag_gate
    return odd | (abs(m_other - companions.magnitude[q]) > mag_gate)


@borrowing_kernel
def _turns_of(s, near, magnitude, mag_gate, companions, turns):
    """Write what the neighbours of star s say of the turn; return how many, the bin with most
    votes, and these."""
    n, best, most = 0, 0, 0
    turns.votes[:] = 0
    for entry in range(near.first[s], near.first[s + 1]):
        c, m_other = near.chord[entry], magnitude[near.other[entry]]
        at = int(c * companions.scale)
        for q in range(companions.first[at], companions.first[at + 3]):
            if abs(companions.chord[q] - c) > companions.tolerance[q] or n == MAX_TURNS:
                continue
            if _is_odd(magnitude[s], m_other, q, companions, mag_gate):
                continue
            turn, wide = int(near.turn[entry]) - companions.angle[q], companions.wide[q]
            turns.row[n], turns.entry[n] = companions.row[q], entry
            turns.turn[n], turns.wide[n] = turn, wide
            n += 1
            for k in range((turn - wide) >> BIN_SHIFT, ((turn + wide) >> BIN_SHIFT) + 1):
                at_bin = k & (len(turns.votes) - 1)
                turns.votes[at_bin] += np.uint16(1)
                if turns.votes[at_bin] > most:
                    best, most = at_bin, int(turns.votes[at_bin])
    return n, best, most


@borrowing_kernel
def _touches(k, at_bin, turns):
    """Tell whether turn k touches a bin."""
    first = (turns.turn[k] - turns.wide[k]) >> BIN_SHIFT
    last = (turns.turn[k] + turns.wide[k]) >> BIN_SHIFT
    return ((at_bin - first) & (len(turns.votes) - 1)) <= last - first


@borrowing_kernel
def _agree(k, m, turns):
    """Tell whether two turns agree."""
    off = (turns.turn[k] - turns.turn[m]) & (TURN - 1)
    return min(off, TURN - off) <= turns.wide[k] + turns.wide[m]


@borrowing_kernel
def _most_agreed(n, at_bin, turns):
    """Return which of the first n turns that touch a bin agrees with most others, and with how many
    and itself."""
    best, most = 0, 0
    for k in range(n):
        if not _touches(k, at_bin, turns):
            continue
        agreed = 0
        for m in range(n):
            agreed += _agree(k, m, turns)
        if agreed > most:
            best, most = k, agreed
    return best, most


@borrowing_kernel
def _widest_agreed(n, k, near, turns):
    """Return the turn with the farthest neighbour of those of the first n that agree with turn k,
    and with how many it agrees: it says best how the image is turned."""
    best, agreed = k, 0
    for m in range(n):
        if _agree(k, m, turns) and near.chord[turns.entry[m]] > near.chord[turns.entry[best]]:
            best = m
    for m in range(n):
        agreed += _agree(best, m, turns)
    return best, agreed


@kernel
def _stars_like(m_i, magnitude, n_stars, mag_gate):
    """Return the range of stars, brightest first, that a centroid of this magnitude may be."""
    if math.isnan(m_i):
        return 0, n_stars
    low = np.searchsorted(magnitude[:n_stars], m_i - mag_gate)
    return low, np.searchsorted(magnitude[:n_stars], m_i + mag_gate)


@kernel
def _try_star(problem, i, s, j, other, c, room, best):
    """Try star s for pivot i, and another star for centroid j; return the work."""
    n, n_checked = len(problem.centroids.u), len(room.gain)
    order = prepare_pair(problem, i, j, c, room)
    log_miss = math.log(1.0 - problem.limits.star_share)
    odds = try_pair(problem.stars, s, other, c, order, log_miss, FLOOR, room)
    if odds < WORTH:
        return 2 * n_checked
    keep(judge_pair(problem, i, s, j, other, best.evidence[1], room), problem, room, best)
    return 2 * n_checked + 20 * n


@kernel
def _try_pivot(problem, i, inside, step, stars, places, level, turns, room, best):
    """Try the stars that most turns agree on for pivot i, of whose surroundings this share is in
    the image; return the work done."""
    near, magnitude = problem.pairs.near, problem.stars.magnitude
    mag_gate = MAG_GATE * problem.rule.spread
    companions = _near_companions(problem, i)
    m_i = problem.centroids.instrumental[i] + problem.rule.zero_point
    start, stop = _stars_like(m_i, magnitude, problem.pairs.n_stars, mag_gate)
    sieve = make_sieve(
        companions.chord, companions.tolerance, companions.angle, companions.wide, near.reach
    )
    least = count_turns(near, start, stop, sieve, SHOWN * inside, *ROUNDS[step], level)
    work = 5 * len(problem.centroids.u)
    work += (near.first[stop] - near.first[start]) // NEIGHBOURS_PER_WORK
    for s in range(start, stop if least <= LEVELS else start):
        if level[s] < least:
            continue
        n, at_bin, most = _turns_of(s, near, magnitude, mag_gate, companions, turns)
        work += STAR_WORK + n // VOTES_PER_WORK
        if most < least:
            continue
        work += most * n // AGREED_PER_WORK
        k, agreed = _most_agreed(n, at_bin, turns)
        if agreed < least:
            continue
        k, agreed = _widest_agreed(n, k, near, turns)
        if agreed < least:
            continue
        j, other, c = turns.row[k], near.other[turns.entry[k]], near.chord[turns.entry[k]]
        odds, looked = odds_of_field(problem, i, s, j, other, c, stars, places, room)
        work += looked
        if odds > WORTH_ALL:
            work += _try_star(problem, i, s, j, other, c, room, best)
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
    inside = _shares_inside(problem.centroids.u, problem.image.box, problem.pairs.near.reach)
    order, level = _pivots(inside), np.zeros(problem.pairs.n_stars, np.uint8)
    stars, places = problem.stars.bands, make_places(problem.centroids.u, problem.image.box)
    turns = Turns(
        np.empty(MAX_TURNS, np.int64), np.empty(MAX_TURNS, np.int64),
        np.empty(MAX_TURNS, np.int64), np.empty(MAX_TURNS, np.int64),
        np.empty(TURN >> BIN_SHIFT, np.uint16),
    )  # fmt: skip
    for step in range(len(ROUNDS)):
        # With so many pivots, one is among the matches of any attitude that has enough.
        for p in range(n - needed + 1):
            i = order[p]
            work += _try_pivot(problem, i, inside[i], step, stars, places, level, turns, room, best)
            if work > problem.limits.budget or is_clear(best, problem.rule):
                return top[0], top[1], work
    return top[0], top[1], work
