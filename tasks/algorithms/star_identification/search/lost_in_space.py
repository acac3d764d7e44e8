"""Lost in space: the attitude of one frame with no prior, by likelihood over all centroids.

Hypotheses are pairs of centroids taken for pairs of stars, from the table of catalogue
pairs. One centroid after the other is the pivot, whose hypotheses are sifted by the votes of
its companions (`companion_votes`); those with most votes are held against all other
centroids and judged by their log evidence (`pair_hypotheses`). The search ends as soon as
an attitude is beyond doubt, at the latest when too few pivots are left for one that would
be, and in any case after a counted amount of work, so that it takes bounded time and gives
the same answer on every machine.
"""

import math

import numpy as np

from epipole.tasks.algorithms.geometry.attitude import (
    attitude_information,
    copy_matrix,
    invert_symmetric,
)
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.star_identification.search.companion_votes import (
    Pairs,
    count_votes,
    is_odd,
    make_votes,
)
from epipole.tasks.algorithms.star_identification.search.evidence import (
    choice_lost,
    log_brightness_ratio,
    log_ways,
)
from epipole.tasks.algorithms.star_identification.search.pair_hypotheses import (
    Centroids,
    Rule,
    Stars,
    judge_pair,
    make_scratch,
    prepare_pair,
    separation,
    try_pair,
)
from epipole.tasks.algorithms.star_identification.sky.pair_table import TURN

# A wrong attitude closer than this to the best one is the best one [rad, about 0.3 degrees].
SAME_ATTITUDE = 5e-3
N_VERIFIED = 64  # brightest centroids that are looked up for each hypothesis
# Gates of a pair's separation [sigma] and brightness [spreads]; log odds at which a hypothesis
# is dropped and that are worth a refinement; how many votes fewer than needed are tried.
GATE, MAG_GATE, FLOOR, WORTH, SLACK = 2.0, 2.0, -6.0, 2.0, 2
# Rounds, ever more thorough: pivots, least companions of each and least share of all, votes with
# which no more of them are asked, and how many of the stars and turns with most votes are tried.
ROUNDS = ((6, 8, 0.5, 10_000, 32), (99, 0, 1.0, 0, 400))
# Hardly a field has fewer stars than this share of the mean.
SPARSE = 0.35
# Work is counted in about this many units a second of CPU time.
WORK_PER_S = 4e7


@kernel
def _keep(evidence, R, top, R_best):
    """Keep the best attitude and the evidence of the best that is another."""
    if evidence <= top[1]:
        return
    gap2 = 0.0
    for r in range(3):
        for m in range(3):
            gap2 += (R[r, m] - R_best[r, m]) ** 2
    same = gap2 < 2.0 * SAME_ATTITUDE * SAME_ATTITUDE
    if evidence > top[0]:
        if not same:
            top[1] = top[0]
        top[0] = evidence
        copy_matrix(R, R_best)
    elif not same:
        top[1] = evidence


@kernel
def matches_needed(seen, rule, least):
    """Return how many matches an attitude needs at least for a log evidence of `least`; more
    than there are centroids where no number is enough (compiled)."""
    n = len(seen.u)
    A, P = np.zeros((3, 3)), np.empty((3, 3))
    attitude_information(seen.u, seen.sigma, A)
    if invert_symmetric(A, P) <= 0.0:
        return n + 1
    gain = np.empty(n)
    for k in range(n):
        gain[k] = math.log(rule.area / (2.0 * math.pi * seen.sigma[k] * seen.sigma[k]))
        if not math.isnan(seen.instrumental[k] + rule.zero_point):
            magnitude = seen.instrumental[k] + rule.zero_point
            gain[k] += log_brightness_ratio(0.0, magnitude, rule.log_density, rule.spread)
        elif not math.isnan(seen.instrumental[k]):
            gain[k] += 1.5  # of typical stars
    gain = np.sort(gain)[::-1]
    total = 0.0
    for k in range(n):
        total += gain[k]
        choice = choice_lost(P) + 1.5 * math.log(n / (k + 1.0))
        in_view = max(k + 1.0, SPARSE * rule.in_view)
        if k >= 2 and total + choice - log_ways(n, k + 1, in_view) >= least:
            return k + 1
    return n + 1


@kernel
def _try_counted(
    seen, stars, rule, pairs, i, n_companions, log2, votes, least, enough, room, top, R_best
):
    """Try the hypotheses of pivot i that have at least so many votes; return the work done."""
    work, mag_gate, shift = 0, MAG_GATE * rule.spread, 16 - log2
    for m in range(n_companions - least + 1):  # one of these voted for any that has enough
        j = votes.companion[m]
        m_i, m_j = seen.instrumental[i] + rule.zero_point, seen.instrumental[j] + rule.zero_point
        m_ij = seen.instrumental[i] - seen.instrumental[j]
        order = room.none
        work += votes.high[m] - votes.low[m]
        for p in range(votes.low[m], votes.high[m]):
            for way in range(2):
                if way == 0:
                    a, b, turn = pairs.first[p], pairs.second[p], int(pairs.at_first[p])
                else:
                    a, b, turn = pairs.second[p], pairs.first[p], int(pairs.at_second[p])
                turn = ((turn - votes.angle[m]) & (TURN - 1)) >> shift
                cell = (a << log2) + turn
                if votes.cast[cell] < least:
                    continue
                if is_odd(stars.magnitude, a, b, m_i, m_j, m_ij, mag_gate):
                    continue
                if len(order) == 0:
                    c = separation(seen.u, i, j)
                    order = prepare_pair(seen, stars, rule, i, j, c, room)
                    work += 5 * seen.n_checked
                work += 3 * seen.n_checked
                odds = try_pair(stars, a, b, pairs.chord[p], order, FLOOR, room)
                if odds < WORTH:
                    votes.cast[cell] -= np.uint8(1)  # a vote that speaks for nothing
                    continue
                work += 20 * len(seen.u)
                evidence = judge_pair(seen, stars, rule, i, a, j, b, top[1], room)
                _keep(evidence, room.R, top, R_best)
                if top[0] > enough and top[0] - top[1] > enough:
                    return work
    return work


@kernel
def _mixed_order(n):
    """Return 0 .. n - 1, by turns from the bright end and from the middle on: what is false is
    often bright, or often faint."""
    order = np.empty(n, np.int64)
    half = (n + 1) // 2
    for k in range(n):
        order[k] = k // 2 if k % 2 == 0 else half + k // 2
    return order


@kernel
def search(
    u,
    sigma,
    instrumental,
    beta,
    star_u,
    star_mag,
    first,
    star,
    n_face,
    grid_radius,
    chord,
    below,
    slope,
    intercept,
    pair_a,
    pair_b,
    at_a,
    at_b,
    min_chord,
    n_pattern,
    gate,
    log_density,
    zero_point,
    spread,
    in_view,
    area,
    box,
    least,
    enough,
    budget,
    R_best,
):
    """Return evidence, runner-up's evidence and work done; write the best attitude (compiled).

    Parameters
    ----------
    u, sigma, instrumental : (n, 3), (n,), (n,)
        Centroids, brightest first: directions (sensor), sigma [rad], -2.5 log10 flux or NaN.
    beta : (3,)
        The sensor's barycentric velocity over that of light.
    star_u, star_mag, first, star, n_face, grid_radius
        The catalogue and its `SkyGrid`.
    chord, below, slope, intercept, pair_a, pair_b, at_a, at_b
        The `PairTable`.
    min_chord, n_pattern
        Closest centroids paired [rad]; how many of the brightest are.
    gate, log_density, zero_point, spread, in_view, area, box
        As in `evidence`; the mean number of stars in view; the image as `Optics` has it.
    least, enough, budget
        Log evidence below which nothing is reported, with which to stop; most work.
    """
    n = len(u)
    seen = Centroids(u, sigma, instrumental, beta, min(n, N_VERIFIED))
    stars = Stars(star_u, star_mag, first, star, n_face, grid_radius)
    rule = Rule(gate, log_density, zero_point, spread, in_view, area, box)
    pairs = Pairs(chord, below, slope, intercept, pair_a, pair_b, at_a, at_b)
    n_pattern = min(n, n_pattern)
    room, top = make_scratch(n, seen.n_checked), np.array([-1e9, -1e9])
    needed = matches_needed(seen, rule, least)
    if needed > n:
        return top[0], top[1], 0
    order = _mixed_order(n_pattern)
    votes = make_votes(len(star_u), n_pattern)
    # With so many pivots, one is among the matches of any attitude that has enough.
    n_pivots, work = min(n_pattern, n - needed + 1), 0
    for step in range(len(ROUNDS)):
        pivots, companions, share, enough_votes, cells = ROUNDS[step]
        companions = max(companions, int(share * n_pattern))
        for i in order[: min(n_pivots, pivots)]:
            n_companions, cast, log2 = count_votes(
                seen, stars, rule, pairs, i, order, companions, enough_votes, GATE,
                MAG_GATE * spread, min_chord, votes,
            )  # fmt: skip
            least_votes = max(needed - SLACK, 2)
            while votes.reached[least_votes] > cells:
                least_votes += 1
            work += cast + (len(star_u) << log2) // 100 + _try_counted(
                seen, stars, rule, pairs, i, n_companions, log2, votes, least_votes, enough,
                room, top, R_best,
            )  # fmt: skip
            if work > budget or (top[0] > enough and top[0] - top[1] > enough):
                return top[0], top[1], work
    return top[0], top[1], work
