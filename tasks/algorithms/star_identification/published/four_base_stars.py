"""Four base stars by identifiers, and the quadrilateral rule for the rest [published].

Yuan, Zhang, Shi: A modified star map identification algorithm based on K vector
(doi 10.16547/j.cnki.10-1096.20170210). The six separations of four centroids give six sets
of catalogue pairs; a counter per star finds the stars that stand in all of the first three,
at the cost of the sum of the set sizes. A further centroid is matched with a star if the six
triangles that it forms with two base stars agree with those of the star.

Decided here, as the source leaves it open: base stars are taken from the brightest centroids,
brightest first, until four are identified. Of several identities, the one with most further
matches counts. A tie identifies nothing.
"""

import math

import numpy as np

from epipole.schemas.arrays import Array, Integers
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.star_identification.centroids import RawCentroids
from epipole.tasks.algorithms.star_identification.frame import FieldOfView, MatchSettings
from epipole.tasks.algorithms.star_identification.published.common import (
    Matcher,
    identify_each_frame,
)
from epipole.tasks.algorithms.star_identification.sensor import IdentifiedSensor
from epipole.tasks.algorithms.star_identification.sensor_model import Skies
from epipole.tasks.algorithms.star_identification.sequence import Priors
from epipole.tasks.algorithms.star_identification.star_grid import Sky, pattern_pairs
from epipole.tasks.algorithms.star_identification.star_pairs import PairTable, chord, range_of

N_BASE = 8  # brightest centroids of which four are tried at a time
PAIR_GATE = 3.0  # sigma; of a separation
# The published limit of 1e-6 rad^2 at 0.5 px of 20.3 degrees / 1024, in units of sigma^2.
DISSIMILARITY_SIGMA2 = 33.0
MAX_IDENTITIES = 64  # four centroids with more are skipped


def match_four_base_stars(u: Array, sigma_rad: Array, star_u: Array, pairs: PairTable) -> Integers:
    """Return the star of each centroid, by the method of four base stars.

    Parameters
    ----------
    u, sigma_rad : (n, 3), (n,) float
        Centroids, brightest first: directions (sensor) and errors per axis [rad].
    star_u : (m, 3) float
        Catalogue directions (ICRS).
    pairs
        All their pairs below the field's diagonal.

    Returns
    -------
    (n,) int64
        Row of star_u, -1 where a centroid is not identified; all -1 where the method fails.
    """
    star = np.full(len(u), -1, np.int64)
    if len(u) >= 4 and len(star_u) >= 4:
        _match(u, sigma_rad, star_u, pairs, star)
    return star


def identify_by_four_base_stars(
    t_s: Array,
    centroids: RawCentroids,
    priors: Priors,
    skies: Skies,
    magnitude_limit: float | None,
    matching: MatchSettings,
) -> IdentifiedSensor:
    """Identify the stars of a sensor's frames by four base stars.

    Parameters and result as `sensor.identify_sensor`; times and priors are not used.
    """
    return identify_each_frame(make_matcher, centroids, skies, magnitude_limit, matching)


def make_matcher(sky: Sky, optics: FieldOfView) -> Matcher:
    """Return the method as a function of centroids alone, its table of pairs made for a camera."""
    star_u = sky.catalogue.u_icrs
    pairs = pattern_pairs(star_u, 2 * optics.half_diagonal_rad)
    return lambda u, sigma_rad: match_four_base_stars(u, sigma_rad, star_u, pairs)


@kernel
def _tolerance(sigma, i, j, c):
    """Return the tolerance of the chord c between centroids i and j; `sigma` (n,) [rad]."""
    # Aberration stretches by v / c at most.
    return PAIR_GATE * math.sqrt(sigma[i] * sigma[i] + sigma[j] * sigma[j]) + 1.1e-4 * c


@kernel
def _same_hand(u, p, s_u, s):
    """Return whether the first three of the four turn the same way in image and catalogue.

    p (4,) are rows of the centroids u (n, 3), sensor frame, s (4,) those of their stars in s_u
    (m, 3), ICRS.
    """
    measured = np.linalg.det(np.stack((u[p[0]], u[p[1]], u[p[2]])))
    listed = np.linalg.det(np.stack((s_u[s[0]], s_u[s[1]], s_u[s[2]])))
    return measured * listed > 0.0


@kernel
def _common_neighbours(pairs, low, high, counter):
    """Return the neighbours of the stars that stand in all three sets of pairs.

    Set k = 1 .. 3 holds the pairs low[k]:high[k] of `pairs`, a `PairTable`; `low` and `high` are
    (4,) int64. `counter` (m,) int8, by star, is zero, and zero again afterwards.

    Returns the star and its neighbour, (r,) int64 each, rows of the catalogue, and `bound` (5,)
    int64: those of set k are bound[k]:bound[k + 1].
    """
    pair_a, pair_b = pairs.first, pairs.second
    for k in range(1, 4):
        for i in range(low[k], high[k]):  # a set counts a star once
            if counter[pair_a[i]] == k - 1:
                counter[pair_a[i]] = k
            if counter[pair_b[i]] == k - 1:
                counter[pair_b[i]] = k
    n_total = 0
    for k in range(1, 4):
        n_total += 2 * (high[k] - low[k])
    first, neighbour = np.empty(n_total, np.int64), np.empty(n_total, np.int64)
    bound = np.zeros(5, np.int64)
    n = 0
    for k in range(1, 4):
        bound[k] = n
        for i in range(low[k], high[k]):
            a, b = pair_a[i], pair_b[i]
            if counter[a] == 3:
                first[n], neighbour[n] = a, b
                n += 1
            if counter[b] == 3:
                first[n], neighbour[n] = b, a
                n += 1
    bound[4] = n
    for k in range(1, 4):
        for i in range(low[k], high[k]):
            counter[pair_a[i]] = 0
            counter[pair_b[i]] = 0
    return first, neighbour, bound


@kernel
def _identities(u, sigma, p, star_u, pairs, counter, out):
    """Write the quadruples of stars whose six separations are those of four centroids; return how
    many, 0 where `out` (q, 4) int64 has too few rows.

    p (4,) are rows of the centroids u (n, 3), sensor frame, with errors `sigma` (n,) [rad]; those
    of `out` are rows of star_u (m, 3), ICRS. `counter` (m,) int8 is zero before and after.
    """
    low, high = np.zeros(4, np.int64), np.zeros(4, np.int64)
    for k in range(1, 4):
        c = chord(u, p[0], u, p[k])
        t = _tolerance(sigma, p[0], p[k], c)
        low[k], high[k] = range_of(pairs.chord, c - t, c + t)
    first, neighbour, bound = _common_neighbours(pairs, low, high, counter)
    count = 0
    c23, c24, c34 = chord(u, p[1], u, p[2]), chord(u, p[1], u, p[3]), chord(u, p[2], u, p[3])
    t23, t24, t34 = (
        _tolerance(sigma, p[1], p[2], c23),
        _tolerance(sigma, p[1], p[3], c24),
        _tolerance(sigma, p[2], p[3], c34),
    )
    three = np.argsort(first[bound[2] : bound[3]]) + bound[2]
    four = np.argsort(first[bound[3] : bound[4]]) + bound[3]
    first3, first4 = first[three], first[four]
    for i in range(bound[1], bound[2]):
        s1, s2 = first[i], neighbour[i]
        for j in range(np.searchsorted(first3, s1), np.searchsorted(first3, s1 + 1)):
            s3 = neighbour[three[j]]
            if s3 == s2 or abs(chord(star_u, s2, star_u, s3) - c23) > t23:
                continue
            for k in range(np.searchsorted(first4, s1), np.searchsorted(first4, s1 + 1)):
                s4 = neighbour[four[k]]
                if s4 in (s2, s3) or abs(chord(star_u, s2, star_u, s4) - c24) > t24:
                    continue
                if abs(chord(star_u, s3, star_u, s4) - c34) > t34:
                    continue
                if count == len(out):
                    return 0
                out[count, 0], out[count, 1], out[count, 2], out[count, 3] = s1, s2, s3, s4
                if _same_hand(u, p, star_u, out[count]):
                    count += 1
    return count


@kernel
def _match_rest(u, sigma, p, star_u, s, star):
    """Write the stars of all centroids by the quadrilateral rule; return how many beside the base
    stars.

    p and s (4,) are the base stars: rows of the centroids u (n, 3), sensor frame, with errors
    `sigma` (n,) [rad], and of star_u (m, 3), ICRS. `star` (n,) int64, out: rows of star_u, -1 none.
    """
    star[:] = -1
    diagonal = 0.0
    for k in range(len(u)):
        for b in range(4):
            diagonal = max(diagonal, chord(u, k, u, p[b]))
    measured, listed = np.empty((4, 4)), np.empty((4, 4))
    for b in range(4):
        star[p[b]] = s[b]
        for c in range(4):
            measured[b, c] = chord(u, p[b], u, p[c])
            listed[b, c] = chord(star_u, s[b], star_u, s[c])
    r, big_r = np.empty(4), np.empty(4)
    best_of = np.full(len(u), 1e9)
    matches = 0
    for t in range(len(star_u)):
        if t in (s[0], s[1], s[2], s[3]):
            continue
        inside = True
        for b in range(4):
            big_r[b] = chord(star_u, t, star_u, s[b])
            inside = big_r[b] < 1.01 * diagonal
            if not inside:
                break
        if not inside:  # the field's part of the catalogue
            continue
        for k in range(len(u)):
            if k in (p[0], p[1], p[2], p[3]):
                continue
            worst = 0.0
            limit = DISSIMILARITY_SIGMA2 * sigma[k] * sigma[k]
            for b in range(4):
                r[b] = chord(u, k, u, p[b])
                worst = max(worst, (r[b] - big_r[b]) ** 2)
            if worst > limit:
                continue
            for b in range(4):
                for c in range(b):
                    d = (r[b] - big_r[b]) ** 2 + (r[c] - big_r[c]) ** 2
                    worst = max(worst, d + (measured[b, c] - listed[b, c]) ** 2)
            if worst > limit or worst >= best_of[k]:
                continue
            other = -1  # one star, one centroid
            for j in range(len(u)):
                if star[j] == t:
                    other = j
            if other >= 0:
                if best_of[other] <= worst:
                    continue
                star[other], best_of[other] = -1, 1e9
                matches -= 1
            matches += star[k] < 0
            star[k], best_of[k] = t, worst
    return matches


@kernel
def _match(u, sigma, star_u, pairs, star):
    """Write the star of each centroid to `star` (n,), -1 before and where the four disagree.

    The centroids are directions u (n, 3), sensor frame, the brightest first, with errors `sigma`
    (n,) [rad]; the stars are star_u (m, 3), ICRS, and their `pairs` a `PairTable`.
    """
    n = len(u)
    m = min(n, N_BASE)
    counter = np.zeros(len(star_u), np.int8)
    identities = np.empty((MAX_IDENTITIES, 4), np.int64)
    trial = np.empty(n, np.int64)
    p = np.empty(4, np.int64)
    for last in range(3, m):
        for third in range(2, last):
            for second in range(1, third):
                for lead in range(second):
                    p[0], p[1], p[2], p[3] = lead, second, third, last
                    count = _identities(u, sigma, p, star_u, pairs, counter, identities)
                    best, draw = -1, False
                    for q in range(count):
                        further = _match_rest(u, sigma, p, star_u, identities[q], trial)
                        draw = further == best or (draw and further < best)
                        if further > best:
                            best = further
                            star[:] = trial
                    # Four false matches have no further matches, unless n = 4.
                    if best >= min(n - 4, 1) and not draw:
                        return
                    star[:] = -1
