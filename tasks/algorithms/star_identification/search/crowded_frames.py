"""Lost in space in a crowd: few stars among hundreds of other centroids.

As in `votes`, one centroid, the pivot, is taken for one star after the other, and the centroids
about it, its companions, vote for the roll of the image. Few centroids of a crowd are stars.
Therefore many pivots are tried, each quickly. Only the near companions of a pivot vote: their share
of stars is that of all, and the sky has fewer pairs with such a small separation. For each pivot:

1. Each star that the pivot may be has near neighbours on the sky. A companion as far from the pivot
   as a neighbour is from the star votes for the roll that turns the one upon the other.
   `roll_votes` counts coarsely how many votes agree on a roll. Two to four must; of a star with
   many neighbours, a share of them.
2. The votes for the stars that reach enough are counted again, each to its tolerance.
3. If enough agree, the one with the farthest neighbour gives the attitude. The stars of its field
   are looked up among the centroids (`verify_field`): some twenty look-ups, not a thousand.
4. What passes is tried on all centroids, as in `lost_in_space`.

Pivots in the middle of the image come first: all neighbours of a star there are in the image.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.schemas.arrays import Array, Integers
from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel
from epipole.tasks.algorithms.star_identification.search.lost_in_space import (
    matches_needed,
    mixed_order,
)
from epipole.tasks.algorithms.star_identification.search.pair_hypotheses import (
    DROP_LOG_ODDS,
    REFINE_LOG_ODDS,
    is_clear,
    judge_pair,
    keep,
    make_scratch,
    no_attitude,
    prepare_pair,
    try_pair,
)
from epipole.tasks.algorithms.star_identification.search.roll_votes import (
    MAX_COUNTED,
    count_roll_votes,
    make_roll_table,
)
from epipole.tasks.algorithms.star_identification.search.verify_field import (
    DETECTED_SHARE,
    field_log_odds,
    make_centroid_cells,
)
from epipole.tasks.algorithms.star_identification.search.votes import (
    MAG_GATE,
    companion,
    implied_magnitudes,
)
from epipole.tasks.algorithms.star_identification.star_pairs import TURN

# Rounds: minimum of votes that agree; maximum of a pivot's stars whose votes are counted closely.
ROUNDS = ((4, 600), (3, 4000), (2, 4000))
MIN_FIELD_LOG_ODDS = 8.0  # from `field_log_odds`, to try an attitude on all centroids
DISC_SAMPLES = 64  # points at which a pivot's surroundings are sampled
PIVOT_TIERS = 4  # pivots are put in order by quarters of their surroundings in the image
MAX_VOTES = 512  # for one star; further ones are left out
BIN_SHIFT = 8  # of the bins of roll, 256 in a full turn; see `votes`
MAX_BINS = 4096  # of separation, where tolerances are small
# Work (see `SearchLimits`): in one unit, this number of neighbours is looked up in the roll table,
# of votes counted, or of pairs of votes compared. Each star takes some units more.
NEIGHBOURS_PER_WORK, VOTES_PER_WORK, AGREED_PER_WORK, STAR_WORK = 3, 2, 20, 10


class Companions(NamedTuple):
    """The near companions of a pivot, by separation.

    row : (n,) int64, centroids
    chord, tolerance : (n,) float, separation from the pivot, as a chord, and its tolerance [rad]
    angle, wide : (n,) int64, position angle about the pivot and its tolerance, in parts of `TURN`
    magnitude, difference : (n,) float [mag], of the companion, and of the pivot less that of the
        companion; see `votes.implied_magnitudes`
    first : (bins + 4,) int64; the companions within a tolerance of the chord c are in the rows
        first[k]:first[k + 3], k = floor(c scale)
    scale : float, bins per unit of chord; a bin is as wide as the largest tolerance
    """

    row: Integers
    chord: Array
    tolerance: Array
    angle: Integers
    wide: Integers
    magnitude: Array
    difference: Array
    first: Integers
    scale: float


class RollVotes(NamedTuple):
    """Votes for the roll of the image, if the pivot is one star.

    row : (MAX_VOTES,) int64, the companion
    entry : (MAX_VOTES,) int64, the neighbour, a row of `NearStars`
    roll, wide : (MAX_VOTES,) int64, the roll and its tolerance, in parts of `TURN`
    in_bin : (bins,) uint16, number of votes in each bin of roll
    """

    row: Integers
    entry: Integers
    roll: Integers
    wide: Integers
    in_bin: npt.NDArray[np.uint16]


@kernel
def _near_companions(problem, i):
    """Return the `Companions` of pivot i within the reach of the near neighbours."""
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
        _, magnitude[kept], difference[kept] = implied_magnitudes(problem, i, j)
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
    """Return (n,) the share of each pivot's surroundings that is in the image.

    u : (n, 3), directions. box : (4,), x0, x1, y0, y1 of the image in normalised coordinates.
    reach : radius of the surroundings [rad].
    """
    inside = np.zeros(len(u))
    for k in range(DISC_SAMPLES):
        # Evenly over the disc: Vogel's spiral (1979).
        r, turn = reach * math.sqrt((k + 0.5) / DISC_SAMPLES), 2.399963 * k
        dx, dy = r * math.cos(turn), r * math.sin(turn)
        for i in range(len(u)):
            x, y = u[i, 0] / u[i, 2] + dx, u[i, 1] / u[i, 2] + dy
            inside[i] += (box[0] < x < box[1]) & (box[2] < y < box[3])
    return inside / DISC_SAMPLES


@kernel
def _pivots(inside):
    """Return the order of the pivots, those with most of their surroundings in the image first.

    `inside` (n,) is from `_shares_inside`; the order (n,) int64 has rows of the centroids.
    """
    order = mixed_order(len(inside))
    return order[np.argsort(-np.floor(PIVOT_TIERS * inside[order]), kind="mergesort")]


@borrowing_kernel
def _contradicts(m_s, m_other, q, companions, mag_gate):
    """Return whether companion q is too bright or too faint for the neighbour of a star.

    m_s and m_other [mag] are of the star and of the neighbour. mag_gate [mag] is the gate of one
    magnitude; that of a difference is wider by the root of two. What is unknown (NaN) contradicts
    nothing.
    """
    differs = abs(m_s - m_other - companions.difference[q]) > 1.414 * mag_gate
    return differs | (abs(m_other - companions.magnitude[q]) > mag_gate)


@borrowing_kernel
def _roll_votes_of(s, near, magnitude, mag_gate, companions, votes):
    """Write the votes of star s to `votes`; return how many, the fullest bin, and how many it has.

    `near` are the `NearStars`, `magnitude` (m,) [mag] those of the catalogue; mag_gate as in
    `_contradicts`.
    """
    n, best, most = 0, 0, 0
    votes.in_bin[:] = 0
    for entry in range(near.first[s], near.first[s + 1]):
        c, m_other = near.chord[entry], magnitude[near.other[entry]]
        at = int(c * companions.scale)
        for q in range(companions.first[at], companions.first[at + 3]):
            if abs(companions.chord[q] - c) > companions.tolerance[q] or n == MAX_VOTES:
                continue
            if _contradicts(magnitude[s], m_other, q, companions, mag_gate):
                continue
            roll, wide = int(near.turn[entry]) - companions.angle[q], companions.wide[q]
            votes.row[n], votes.entry[n] = companions.row[q], entry
            votes.roll[n], votes.wide[n] = roll, wide
            n += 1
            for k in range((roll - wide) >> BIN_SHIFT, ((roll + wide) >> BIN_SHIFT) + 1):
                at_bin = k & (len(votes.in_bin) - 1)
                votes.in_bin[at_bin] += np.uint16(1)
                if votes.in_bin[at_bin] > most:
                    best, most = at_bin, int(votes.in_bin[at_bin])
    return n, best, most


@borrowing_kernel
def _touches(k, at_bin, votes):
    """Return whether the tolerance of vote k touches a bin."""
    first = (votes.roll[k] - votes.wide[k]) >> BIN_SHIFT
    last = (votes.roll[k] + votes.wide[k]) >> BIN_SHIFT
    return ((at_bin - first) & (len(votes.in_bin) - 1)) <= last - first


@borrowing_kernel
def _agree(k, m, votes):
    """Return whether two votes agree on the roll within their tolerances."""
    off = (votes.roll[k] - votes.roll[m]) & (TURN - 1)
    return min(off, TURN - off) <= votes.wide[k] + votes.wide[m]


@borrowing_kernel
def _vote_with_most_agreeing(n, at_bin, votes):
    """Return which of the votes that touch a bin agrees with most of the first n votes, and with
    how many, itself included."""
    best, most = 0, 0
    for k in range(n):
        if not _touches(k, at_bin, votes):
            continue
        agreed = 0
        for m in range(n):
            agreed += _agree(k, m, votes)
        if agreed > most:
            best, most = k, agreed
    return best, most


@borrowing_kernel
def _farthest_agreeing_vote(n, k, near, votes):
    """Return the vote with the farthest neighbour, which determines the roll best, of those of the
    first n that agree with vote k; and how many votes agree with it."""
    best, agreed = k, 0
    for m in range(n):
        if _agree(k, m, votes) and near.chord[votes.entry[m]] > near.chord[votes.entry[best]]:
            best = m
    for m in range(n):
        agreed += _agree(best, m, votes)
    return best, agreed


@kernel
def _stars_like(m_i, magnitude, n_stars, mag_gate):
    """Return the range of stars, brightest first, that a centroid of this magnitude may be.

    The range is first and last + 1, of the first n_stars of `magnitude` (m,) [mag], ascending; all
    of these where m_i is NaN. mag_gate [mag] is the largest difference.
    """
    if math.isnan(m_i):
        return 0, n_stars
    low = np.searchsorted(magnitude[:n_stars], m_i - mag_gate)
    return low, np.searchsorted(magnitude[:n_stars], m_i + mag_gate)


@kernel
def _try_star(problem, i, s, j, other, c, scratch, best):
    """Try star s for pivot i and star `other` for centroid j; return the work done.

    c [rad] is the chord between the stars. `scratch`, a `PairScratch`, and `best`, a `Best`, are
    written.
    """
    n, n_checked = len(problem.centroids.u), len(scratch.gain)
    order = prepare_pair(problem, i, j, c, scratch)
    log_miss = math.log(1.0 - problem.limits.star_share)
    odds = try_pair(problem.stars, s, other, c, order, log_miss, DROP_LOG_ODDS, scratch)
    if odds < REFINE_LOG_ODDS:
        return 2 * n_checked
    keep(judge_pair(problem, i, s, j, other, best.evidence[1], scratch), problem, scratch, best)
    return 2 * n_checked + 20 * n


@kernel
def _try_pivot(problem, i, inside, step, stars, cells, n_agreeing, votes, scratch, best):
    """Try the stars with most agreeing votes for pivot i; return the work done.

    `inside` is the share of the pivot's surroundings that is in the image, `step` a row of
    `ROUNDS`; `stars` and `cells` are as in `field_log_odds`. n_agreeing (n_stars,) uint8, `votes`
    and `scratch` are work space; `best`, a `Best`, is updated.
    """
    near, magnitude = problem.pairs.near, problem.stars.magnitude
    mag_gate = MAG_GATE * problem.rule.scatter
    companions = _near_companions(problem, i)
    m_i = problem.centroids.instrumental[i] + problem.rule.zero_point
    start, stop = _stars_like(m_i, magnitude, problem.pairs.n_stars, mag_gate)
    roll_table = make_roll_table(
        companions.chord, companions.tolerance, companions.angle, companions.wide, near.reach
    )
    min_votes = count_roll_votes(
        near, start, stop, roll_table, DETECTED_SHARE * inside, *ROUNDS[step], n_agreeing
    )
    work = 5 * len(problem.centroids.u)
    work += (near.first[stop] - near.first[start]) // NEIGHBOURS_PER_WORK
    for s in range(start, stop if min_votes <= MAX_COUNTED else start):
        if n_agreeing[s] < min_votes:
            continue
        n, at_bin, n_in_bin = _roll_votes_of(s, near, magnitude, mag_gate, companions, votes)
        work += STAR_WORK + n // VOTES_PER_WORK
        if n_in_bin < min_votes:
            continue
        work += n_in_bin * n // AGREED_PER_WORK
        k, agreed = _vote_with_most_agreeing(n, at_bin, votes)
        if agreed < min_votes:
            continue
        k, agreed = _farthest_agreeing_vote(n, k, near, votes)
        if agreed < min_votes:
            continue
        j, other, c = votes.row[k], near.other[votes.entry[k]], near.chord[votes.entry[k]]
        odds, looked = field_log_odds(problem, i, s, j, other, c, stars, cells, scratch)
        work += looked
        if odds > MIN_FIELD_LOG_ODDS:
            work += _try_star(problem, i, s, j, other, c, scratch, best)
            if is_clear(best, problem.rule):
                break
    return work


@kernel
def search_crowded(problem, R_best):
    """Return evidence, runner-up's evidence and work done; write the best attitude (compiled).

    Parameters and result are those of `lost_in_space.search`.
    """
    n = len(problem.centroids.u)
    scratch = make_scratch(n, n)
    best = no_attitude(R_best)
    top, work = best.evidence, 0
    needed = matches_needed(problem)
    if needed > n:
        return top[0], top[1], work
    inside = _shares_inside(problem.centroids.u, problem.image.box, problem.pairs.near.reach)
    order, n_agreeing = _pivots(inside), np.zeros(problem.pairs.n_stars, np.uint8)
    stars, cells = problem.stars.bands, make_centroid_cells(problem.centroids.u, problem.image.box)
    votes = RollVotes(
        np.empty(MAX_VOTES, np.int64), np.empty(MAX_VOTES, np.int64),
        np.empty(MAX_VOTES, np.int64), np.empty(MAX_VOTES, np.int64),
        np.empty(TURN >> BIN_SHIFT, np.uint16),
    )  # fmt: skip
    for step in range(len(ROUNDS)):
        # With this number of pivots, one is among the matches of any attitude that has enough.
        for p in range(n - needed + 1):
            i = order[p]
            work += _try_pivot(
                problem, i, inside[i], step, stars, cells, n_agreeing, votes, scratch, best
            )
            if work > problem.limits.budget or is_clear(best, problem.rule):
                return top[0], top[1], work
    return top[0], top[1], work
