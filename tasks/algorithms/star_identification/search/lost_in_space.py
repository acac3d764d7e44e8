"""Lost in space: the attitude of one frame with no prior, by likelihood over all centroids.

Hypotheses are pairs of centroids taken for pairs of stars, from the table of catalogue pairs. Those
of the brightest centroids are tried first (`brightest_pairs`). Then one centroid after the other is
the pivot. Votes of its companions sift its hypotheses (`companion_votes`). Those with most votes
are compared with all other centroids and judged by their log evidence (`pair_hypotheses`).
The search ends as soon as an attitude is beyond doubt, or
when too few pivots are left for an attitude that would be. The amount of work is counted and
bounded, so that a search takes bounded time and gives the same answer on every machine.
"""

import math

import numpy as np

from epipole.tasks.algorithms.geometry.attitude import (
    attitude_information,
    invert_symmetric,
)
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.star_identification.evidence import (
    choice_lost,
    log_brightness_ratio,
    log_ways,
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
    separation,
    try_pair,
)
from epipole.tasks.algorithms.star_identification.search.votes import (
    MAG_GATE,
    MAX_SIFTED,
    add_vote,
    agreeing,
    companion,
    count_again,
    count_votes,
    gather,
    is_odd,
    make_sift,
    make_votes,
    shown_magnitudes,
)
from epipole.tasks.algorithms.star_identification.star_pairs import range_of

# -- Lost in space, the short way: the brightest centroids are pairs of bright stars.
#
# In most frames the brightest centroids are stars, and bright stars are few: a pair of them has
# some hundred pairs of the sky as its like, not ten thousand. These are tried one by one. Where
# none is beyond doubt, little time was lost, and `lost_in_space` counts votes.

# The brightest centroids that are paired, and how many stars of an image, on average, are as bright
# as they may be.
N_BRIGHTEST, BRIGHT_STARS = 5, 6.0
# Log odds at which a hypothesis is dropped: after three misses. The votes find what this loses.
GIVE_UP = -1.8


@kernel
def try_brightest(problem, room, best):
    """Try the pairs of the brightest centroids as pairs of bright stars; return the work done
    (compiled). Without brightness, nothing is tried."""
    instrumental = problem.centroids.instrumental
    n = min(len(instrumental), N_BRIGHTEST)
    n_bright = BRIGHT_STARS * 4.0 * math.pi / problem.image.area
    work = 0
    for ranks in range(1, 2 * n - 2):
        for i in range(max(ranks - n + 1, 0), (ranks + 1) // 2):
            j = ranks - i
            if math.isnan(instrumental[i] + instrumental[j]):
                continue
            work += _try_centroids(problem, i, j, n_bright, room, best)
            if is_clear(best, problem.rule):
                return work
    return work


@kernel
def _try_centroids(problem, i, j, n_bright, room, best):
    """Try two centroids as two of the brightest stars; return the work done."""
    stars, pairs, n = problem.stars, problem.pairs, len(problem.centroids.u)
    c, tolerance, _, _ = companion(problem.centroids, i, j, problem.limits.min_chord)
    if c == 0.0:
        return 0
    low, high = range_of(pairs.chord, c - tolerance, c + tolerance)
    work, n_checked = (high - low) // 4, len(room.gain)
    order, prepared = room.no_order, False
    m_i, m_j, m_ij = shown_magnitudes(problem, i, j)
    mag_gate = MAG_GATE * problem.rule.spread
    log_miss = math.log(1.0 - problem.limits.star_share)
    for p in range(low, high):
        if pairs.second[p] >= n_bright:  # the first is brighter
            continue
        for way in range(2):
            a, b = pairs.first[p], pairs.second[p]
            if way == 1:
                a, b = b, a
            if is_odd(stars.magnitude, a, b, m_i, m_j, m_ij, mag_gate):
                continue
            if not prepared:
                order, prepared = prepare_pair(problem, i, j, c, room), True
                work += 5 * n_checked
            work += 3 * n_checked
            if try_pair(stars, a, b, pairs.chord.s[p], order, log_miss, GIVE_UP, room) < WORTH:
                continue
            work += 20 * n
            evidence = judge_pair(problem, i, a, j, b, best.evidence[1], room)
            keep(evidence, problem, room, best)
            if is_clear(best, problem.rule):
                return work
    return work


# -- Lost in space: the attitude of one frame with no prior, by likelihood over all centroids.
#
# Hypotheses are pairs of centroids taken for pairs of stars, from the table of catalogue pairs.
# Those of the brightest centroids are tried first (`brightest_pairs`). Then one centroid after
# the other is the pivot. Votes of its companions sift its hypotheses (`companion_votes`). Those
# with most votes are compared with all other centroids and judged by their log evidence
# (`pair_hypotheses`). The search ends as soon as an attitude is beyond doubt, or when too few
# pivots are left for an attitude that would be. The amount of work is counted and bounded, so
# that a search takes bounded time and gives the same answer on every machine.

SLACK = 2  # a hypothesis may lack so many of the votes that are needed
# Rounds, each more thorough than the one before: pivots; least companions of each; least share of
# all centroids that are companions; votes after which no more companions are asked; how many of the
# cells (a star and a turn) with most votes are sifted.
ROUNDS = ((6, 8, 0.5, 10_000, 128), (99, 0, 1.0, 0, 2000))
# Hardly any field has fewer stars than this share of the mean.
SPARSE = 0.35
# About so many units of work take a second of CPU time.
WORK_PER_S = 4e7


@kernel
def matches_needed(problem):
    """Return how many matches an attitude needs at least for `rule.least`; more than there are
    centroids where no number is enough."""
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
            gain[k] += log_brightness_ratio(0.0, magnitude, rule.log_density, rule.spread)
        elif not math.isnan(instrumental[k]):
            gain[k] += 1.5  # of typical stars
    gain = np.sort(gain)[::-1]
    total = 0.0
    for k in range(n):
        total += gain[k]
        choice = choice_lost(P) + 1.5 * math.log(n / (k + 1.0))
        in_view = max(k + 1.0, SPARSE * image.in_view)
        if k >= 2 and total + choice - log_ways(n, k + 1, in_view) >= rule.least:
            return k + 1
    return n + 1


@kernel
def _try_counted(problem, i, n_votes, fine, n_tried, votes, sift, least_votes, room, best):
    """Try the sifted hypotheses of pivot i that have at least so many votes; return the work done.

    Only the votes of the first `n_tried` companions lead to a try.
    """
    centroids, stars, pairs = problem.centroids, problem.stars, problem.pairs
    n, n_checked = len(centroids.u), len(room.gain)
    work, order, prepared = 0, room.no_order, -1
    log_miss = math.log(1.0 - problem.limits.star_share)
    for k in range(n_votes):
        m, p = sift.companion[k], sift.pair[k]
        if m >= n_tried:
            break
        if agreeing(k, fine, sift) < least_votes:
            continue
        j = votes.companion[m]
        if prepared != m:
            order, prepared = prepare_pair(problem, i, j, separation(centroids.u, i, j), room), m
            work += 5 * n_checked
        if sift.way[k] == 0:
            a, b = pairs.first[p], pairs.second[p]
        else:
            a, b = pairs.second[p], pairs.first[p]
        work += 3 * n_checked
        odds = try_pair(stars, a, b, pairs.chord.s[p], order, log_miss, FLOOR, room)
        if odds < WORTH:
            add_vote(k, fine, -1, sift)  # this vote was given by chance
            continue
        work += 20 * n
        evidence = judge_pair(problem, i, a, j, b, best.evidence[1], room)
        keep(evidence, problem, room, best)
        if is_clear(best, problem.rule):
            break
    return work


@kernel
def _try_pivot(problem, i, order, least_companions, step, needed, votes, sift, room, best):
    """Try the hypotheses of pivot i with most votes; return the work done."""
    enough_votes, cells = ROUNDS[step][3], ROUNDS[step][4]
    n_companions, cast, log2 = count_votes(problem, i, order, least_companions, enough_votes, votes)
    work = cast + (problem.pairs.n_stars << log2) // 100
    least_votes = max(needed - SLACK, 2)
    while votes.reached[least_votes] > cells:
        least_votes += 1
    n_votes, fine = MAX_SIFTED + 1, 0
    while n_votes > MAX_SIFTED and votes.reached[least_votes] > 0:
        n_votes, fine = gather(problem, i, n_companions, log2, votes, least_votes, sift)
        work += cast
        least_votes += n_votes > MAX_SIFTED
    if n_votes > MAX_SIFTED:
        return work
    count_again(n_votes, fine, sift)
    # Of any hypothesis that has enough votes, one of these companions gave one.
    n_tried = n_companions - least_votes + 1
    return (
        work
        + n_votes
        + _try_counted(problem, i, n_votes, fine, n_tried, votes, sift, least_votes, room, best)
    )


@kernel
def mixed_order(n):
    """Return 0 .. n - 1, taken in turn from the bright end and from the middle.

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
    room = make_scratch(n, min(n, problem.limits.n_tried))
    best = no_attitude(R_best)
    top, work = best.evidence, 0
    needed = matches_needed(problem)
    if needed > n:
        return top[0], top[1], work
    work += try_brightest(problem, room, best)
    if is_clear(best, problem.rule):
        return top[0], top[1], work
    order = mixed_order(n_pattern)
    votes, sift = make_votes(problem.pairs.n_stars, n_pattern), make_sift()
    # With so many pivots, one is among the matches of any attitude that has enough.
    n_pivots = min(n_pattern, n - needed + 1)
    for step in range(len(ROUNDS)):
        pivots, companions, share = ROUNDS[step][:3]
        companions = max(companions, int(share * n_pattern))
        for i in order[: min(n_pivots, pivots)]:
            work += _try_pivot(problem, i, order, companions, step, needed, votes, sift, room, best)
            if work > problem.limits.budget or is_clear(best, problem.rule):
                return top[0], top[1], work
    return top[0], top[1], work
