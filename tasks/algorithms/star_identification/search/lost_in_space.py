"""Lost in space: the attitude of one frame without a prior, by likelihood over all centroids.

Hypotheses are pairs of centroids taken for pairs of stars, from the table of catalogue pairs.

1. Pairs of the brightest centroids are tried as pairs of bright stars (`try_brightest`). In most
   frames the brightest centroids are stars, and bright stars are few: a pair of them has some
   hundred pairs of the sky with its separation, not ten thousand.
2. One centroid after the other is the pivot. Votes of its companions say which star it may be
   (`votes`); the hypotheses with most votes are tried on all centroids (`pair_hypotheses`). A
   second round takes all pivots and companions, and tries more hypotheses.

The search ends as soon as an attitude is clear, or when too few pivots are left for a clear one.
The work is counted and bounded, so that a search takes bounded time and gives the same answer on
every machine.
"""

import math

import numpy as np

from epipole.tasks.algorithms.geometry.attitude import (
    attitude_information,
)
from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel
from epipole.tasks.algorithms.star_identification.evidence import (
    choice_lost,
    log_brightness_ratio,
    log_ways,
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
    separation,
    try_pair,
)
from epipole.tasks.algorithms.star_identification.search.votes import (
    MAG_GATE,
    MAX_REFINED,
    add_vote,
    agreeing,
    cell_of,
    companion,
    contradicts_brightness,
    count_refined,
    count_votes,
    gather_votes,
    implied_magnitudes,
    make_refined_votes,
    make_votes,
)
from epipole.tasks.algorithms.star_identification.star_pairs import range_of
from epipole.tasks.algorithms.symmetric_matrices import invert_symmetric

# The brightest pairs.

# Number of brightest centroids that are paired, and of the brightest stars of an average field that
# they may be.
N_BRIGHTEST, BRIGHT_STARS = 5, 6.0
# Log odds below which a hypothesis is dropped: three misses, ln 0.5 each. Votes may still find it.
DROP_EARLY_LOG_ODDS = -1.8


@kernel
def try_brightest(problem, scratch, best):
    """Try the pairs of the brightest centroids as pairs of bright stars; return the work done
    (compiled). Centroids without a flux are not tried."""
    instrumental = problem.centroids.instrumental
    n = min(len(instrumental), N_BRIGHTEST)
    n_bright = BRIGHT_STARS * 4.0 * math.pi / problem.image.area
    work = 0
    for ranks in range(1, 2 * n - 2):
        for i in range(max(ranks - n + 1, 0), (ranks + 1) // 2):
            j = ranks - i
            if math.isnan(instrumental[i] + instrumental[j]):
                continue
            work += _try_centroids(problem, i, j, n_bright, scratch, best)
            if is_clear(best, problem.rule):
                return work
    return work


@kernel
def _try_centroids(problem, i, j, n_bright, scratch, best):
    """Try centroids i and j as two of the n_bright brightest stars; return the work done.
    `scratch`, a `PairScratch`, and `best`, a `Best`, are written."""
    stars, pairs, n = problem.stars, problem.pairs, len(problem.centroids.u)
    c, tolerance, _, _ = companion(problem.centroids, i, j, problem.limits.min_chord)
    if c == 0.0:
        return 0
    low, high = range_of(pairs.chord, c - tolerance, c + tolerance)
    work, n_checked = (high - low) // 4, len(scratch.gain)
    order, prepared = scratch.no_order, False
    m_i, m_j, m_ij = implied_magnitudes(problem, i, j)
    mag_gate = MAG_GATE * problem.rule.scatter
    log_miss = math.log(1.0 - problem.limits.star_share)
    for p in range(low, high):
        if pairs.second[p] >= n_bright:  # the first is brighter
            continue
        for way in range(2):
            a, b = pairs.first[p], pairs.second[p]
            if way == 1:
                a, b = b, a
            if contradicts_brightness(stars.magnitude, a, b, m_i, m_j, m_ij, mag_gate):
                continue
            if not prepared:
                order, prepared = prepare_pair(problem, i, j, c, scratch), True
                work += 5 * n_checked
            work += 3 * n_checked
            if (
                try_pair(
                    stars, a, b, pairs.chord.s[p], order, log_miss, DROP_EARLY_LOG_ODDS, scratch
                )
                < REFINE_LOG_ODDS
            ):
                continue
            work += 20 * n
            evidence = judge_pair(problem, i, a, j, b, best.evidence[1], scratch)
            keep(evidence, problem, scratch, best)
            if is_clear(best, problem.rule):
                return work
    return work


# Pivots and votes.

SLACK = 2  # votes that a hypothesis may lack of the matches it needs
# Rounds, each more thorough than the one before: number of pivots; minimum of companions of each;
# minimum share of the centroids that are companions; votes after which no further companion votes;
# maximum of cells (a star and a roll) whose votes are refined, those with most votes.
ROUNDS = ((6, 8, 0.5, 10_000, 128), (99, 0, 1.0, 0, 2000))
SPARSE = 0.35  # stars in the emptiest fields, over the mean
WORK_PER_S = 4e7  # units of work in a second of CPU time, about


@kernel
def matches_needed(problem):
    """Return the minimum number of matches with which an attitude reaches `rule.min_evidence`
    (compiled); n + 1 where all n centroids are not enough."""
    centroids, rule, image = problem.centroids, problem.rule, problem.image
    sigma, instrumental = centroids.sigma, centroids.instrumental
    n = len(centroids.u)
    A, P = np.zeros((3, 3)), np.empty((3, 3))
    attitude_information(centroids.u, sigma, A)
    if invert_symmetric(A, P) <= 0.0:
        return n + 1
    gain = np.empty(n)
    for k in range(n):
        gain[k] = math.log(image.area / (2.0 * math.pi * sigma[k] * sigma[k]))
        if not math.isnan(instrumental[k] + rule.zero_point):
            magnitude = instrumental[k] + rule.zero_point
            gain[k] += log_brightness_ratio(0.0, magnitude, rule.log_density, rule.scatter)
        elif not math.isnan(instrumental[k]):
            gain[k] += 1.5  # of typical stars
    gain = np.sort(gain)[::-1]
    total = 0.0
    for k in range(n):
        total += gain[k]
        choice = choice_lost(P) + 1.5 * math.log(n / (k + 1.0))
        in_view = max(k + 1.0, SPARSE * image.in_view)
        if k >= 2 and total + choice - log_ways(n, k + 1, in_view) >= rule.min_evidence:
            return k + 1
    return n + 1


@kernel
def _try_counted(problem, i, n_votes, fine, n_tried, votes, refined, min_votes, scratch, best):
    """Try the hypotheses of pivot i with `min_votes` refined votes or more; return the work done.

    Only the votes of the first `n_tried` companions lead to a try. n_votes and the shift `fine` are
    from `gather_votes`. False votes are taken back from the bins of `refined`; `scratch`, a
    `PairScratch`, and `best`, a `Best`, are written.
    """
    centroids, stars, pairs = problem.centroids, problem.stars, problem.pairs
    n, n_checked = len(centroids.u), len(scratch.gain)
    work, order, prepared = 0, scratch.no_order, -1
    log_miss = math.log(1.0 - problem.limits.star_share)
    for k in range(n_votes):
        m, p = refined.companion[k], refined.pair[k]
        if m >= n_tried:
            break
        if agreeing(k, fine, refined) < min_votes:
            continue
        j = votes.companion[m]
        if prepared != m:
            order, prepared = prepare_pair(problem, i, j, separation(centroids.u, i, j), scratch), m
            work += 5 * n_checked
        if refined.way[k] == 0:
            a, b = pairs.first[p], pairs.second[p]
        else:
            a, b = pairs.second[p], pairs.first[p]
        work += 3 * n_checked
        odds = try_pair(stars, a, b, pairs.chord.s[p], order, log_miss, DROP_LOG_ODDS, scratch)
        if odds < REFINE_LOG_ODDS:
            add_vote(k, fine, -1, refined)  # a false vote
            continue
        work += 20 * n
        evidence = judge_pair(problem, i, a, j, b, best.evidence[1], scratch)
        keep(evidence, problem, scratch, best)
        if is_clear(best, problem.rule):
            break
    return work


@borrowing_kernel
def _gather_fullest(problem, i, n_companions, coarse, min_votes, max_cells, votes, refined):
    """Write the votes of pivot i's fullest cells to `refined`.

    The number of votes that a cell needs is `min_votes`, more where more than `max_cells` cells
    have that many, and more again until the votes in them fit into `refined`. n_companions and
    `coarse` are from `count_votes`.

    Returns
    -------
    n, fine : int
        As from `gather_votes`; no votes where no cell has enough.
    min_votes, n_times : int
        The number of votes that a cell needs, and how often the votes were gathered.
    """
    while votes.reached[min_votes] > max_cells:
        min_votes += 1
    n_times = 0
    while votes.reached[min_votes] > 0:
        n, fine = gather_votes(problem, i, n_companions, coarse, votes, min_votes, refined)
        n_times += 1
        if n <= MAX_REFINED:
            return n, fine, min_votes, n_times
        min_votes += 1
    return 0, 0, min_votes, n_times


@kernel
def _try_pivot(problem, i, order, min_companions, step, needed, votes, refined, scratch, best):
    """Try the hypotheses of pivot i with most votes; return the work done.

    `order` (k,) int64 are rows of the centroids, as in `count_votes`, `step` the number of a row
    of `ROUNDS`, and `needed` from `matches_needed`. `votes`, `refined` and `scratch` are work
    space; `best`, a `Best`, is updated.
    """
    enough_votes, max_cells = ROUNDS[step][3], ROUNDS[step][4]
    n_companions, n_cast, coarse = count_votes(
        problem, i, order, min_companions, enough_votes, votes
    )
    n_votes, fine, min_votes, n_times = _gather_fullest(
        problem, i, n_companions, coarse, max(needed - SLACK, 2), max_cells, votes, refined
    )
    n_cells = cell_of(problem.pairs.n_stars, 0, coarse)
    work = n_cast * (1 + n_times) + n_cells // 100 + n_votes
    if n_votes == 0:
        return work
    count_refined(n_votes, fine, refined)
    # Any hypothesis with enough votes has one from these companions.
    n_tried = n_companions - min_votes + 1
    return work + _try_counted(
        problem, i, n_votes, fine, n_tried, votes, refined, min_votes, scratch, best
    )


@kernel
def mixed_order(n):
    """Return 0 .. n - 1, (n,) int64, taken in turn from the bright end and from the middle.

    False centroids are often all bright, or all faint.
    """
    order = np.empty(n, np.int64)
    half = (n + 1) // 2
    for k in range(n):
        order[k] = k // 2 if k % 2 == 0 else half + k // 2
    return order


@kernel
def search(problem, R_best):
    """Return evidence, runner-up's evidence and work done; write the best attitude (compiled).

    Parameters
    ----------
    problem : Problem
        The frame's centroids, brightest first, and what is known.
    R_best : (3, 3), out
        The best attitude, sensor from ICRS.
    """
    n = len(problem.centroids.u)
    n_pattern = min(n, problem.limits.n_pattern)
    scratch = make_scratch(n, min(n, problem.limits.n_tried))
    best = no_attitude(R_best)
    top, work = best.evidence, 0
    needed = matches_needed(problem)
    if needed > n:
        return top[0], top[1], work
    work += try_brightest(problem, scratch, best)
    if is_clear(best, problem.rule):
        return top[0], top[1], work
    order = mixed_order(n_pattern)
    votes, refined = make_votes(problem.pairs.n_stars, n_pattern), make_refined_votes()
    # With this number of pivots, one is among the matches of any attitude that has enough.
    n_pivots = min(n_pattern, n - needed + 1)
    for step in range(len(ROUNDS)):
        pivots, companions, share = ROUNDS[step][:3]
        companions = max(companions, int(share * n_pattern))
        for i in order[: min(n_pivots, pivots)]:
            work += _try_pivot(
                problem, i, order, companions, step, needed, votes, refined, scratch, best
            )
            if work > problem.limits.budget or is_clear(best, problem.rule):
                return top[0], top[1], work
    return top[0], top[1], work
