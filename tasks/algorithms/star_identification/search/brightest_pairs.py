"""Lost in space, the short way: the brightest centroids are pairs of bright stars.

In most frames the brightest centroids are stars, and bright stars are few: a pair of them has some
hundred pairs of the sky as its like, not ten thousand. These are tried one by one. Where none is
beyond doubt, little time was lost, and `lost_in_space` counts votes.
"""

import math

from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.star_identification.search.best_attitude import (
    WORTH,
    is_clear,
    keep,
)
from epipole.tasks.algorithms.star_identification.search.companion_votes import (
    MAG_GATE,
    companion,
    is_odd,
    shown_magnitudes,
)
from epipole.tasks.algorithms.star_identification.search.pair_hypotheses import (
    judge_pair,
    prepare_pair,
    try_pair,
)
from epipole.tasks.algorithms.star_identification.sky.kvector import range_of

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
