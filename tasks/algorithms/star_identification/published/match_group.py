"""Improved match group: a state counter per catalogue star, and the triangle check [published].

Star identification in celestial navigation, 16th "Huawei Cup" graduate modelling competition
(2019). Each centroid in turn is the main star; its separations from the others, smallest
first, are looked up in the pair table, in bins of 0.01 degrees; the state of a catalogue
star rises by one for each pair set that holds it. The star with the highest state is the
main star's identity; where states tie, the triangle check decides.

Decided here, as the source leaves it open: a set is all bins that the separation's error reaches.
The identities of one image must agree with each other in separations before an attitude is
computed from them.
"""

import math

import numpy as np

from epipole.schemas.arrays import Array, Integers
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.star_identification.centroids import RawCentroids
from epipole.tasks.algorithms.star_identification.frame import FieldOfView, MatchSettings
from epipole.tasks.algorithms.star_identification.published.common import (
    Matcher,
    agreeing_candidates,
    identify_each_frame,
)
from epipole.tasks.algorithms.star_identification.sensor import IdentifiedSensor
from epipole.tasks.algorithms.star_identification.sensor_model import Skies
from epipole.tasks.algorithms.star_identification.sequence import Priors
from epipole.tasks.algorithms.star_identification.star_grid import Sky, pattern_pairs
from epipole.tasks.algorithms.star_identification.star_pairs import PairTable, chord, range_of

BIN_RAD = math.radians(0.01)
PAIR_GATE = 2.5  # sigma; of a separation
N_NEIGHBOURS = 24  # nearest centroids whose separations from the main star are looked up
N_CENTROIDS = 48  # brightest centroids that are used


def match_group(u: Array, sigma_rad: Array, star_u: Array, pairs: PairTable) -> Integers:
    """Return the star of each centroid, by the improved match group.

    Parameters and result as `four_base_stars.match_four_base_stars`.
    """
    single = states(u[:N_CENTROIDS], sigma_rad[:N_CENTROIDS], star_u, pairs)
    centroid = np.flatnonzero(single >= 0)
    return agreeing_candidates(u, sigma_rad, star_u, centroid, single[centroid], PAIR_GATE)


def states(u: Array, sigma_rad: Array, star_u: Array, pairs: PairTable) -> Integers:
    """Return the star with the highest state for each centroid alone; -1: none, or a tie."""
    star = np.full(len(u), -1, np.int64)
    if len(u) >= 3 and len(star_u) >= 3:
        _match(u, sigma_rad, star_u, pairs, star)
    return star


def identify_by_match_group(
    t_s: Array,
    centroids: RawCentroids,
    priors: Priors,
    skies: Skies,
    magnitude_limit: float | None,
    matching: MatchSettings,
) -> IdentifiedSensor:
    """Identify the stars of a sensor's frames by the improved match group.

    Parameters and result as `sensor.identify_sensor`; times and priors are not used.
    """
    return identify_each_frame(make_matcher, centroids, skies, magnitude_limit, matching)


def make_matcher(sky: Sky, optics: FieldOfView) -> Matcher:
    """Return the method as a function of centroids alone, its table of pairs made for a camera."""
    star_u = sky.catalogue.u_icrs
    pairs = pattern_pairs(star_u, 2 * optics.half_diagonal_rad)
    return lambda u, sigma_rad: match_group(u, sigma_rad, star_u, pairs)


@kernel
def _bins(u, sigma, i, j):
    """Return the chords between which the bins lie that a separation's error reaches.

    The separation is between rows i and j of the centroids u (n, 3), with errors `sigma` (n,)
    [rad].
    """
    angle = 2.0 * math.asin(min(0.5 * chord(u, i, u, j), 1.0))
    reach = PAIR_GATE * math.sqrt(sigma[i] * sigma[i] + sigma[j] * sigma[j]) + 1.1e-4 * angle
    low = math.floor((angle - reach) / BIN_RAD) * BIN_RAD
    high = math.ceil((angle + reach) / BIN_RAD) * BIN_RAD
    return 2.0 * math.sin(0.5 * max(low, 0.0)), 2.0 * math.sin(0.5 * high)


@kernel
def _triangles(u, sigma, star_u, pairs, neighbours_in_order, s, set_low, set_high):
    """Return how many triangles of the main star with two neighbours that follow each other in
    order are triangles of the catalogue too, if the main star is s, a row of star_u (m, 3), ICRS.

    neighbours_in_order (k,) int64 are rows of the centroids u (n, 3), sensor frame, with errors
    `sigma` (n,) [rad]. The pairs set_low[q]:set_high[q], (n,) int64, have the separation of the
    q-th neighbour from the main star.
    """
    pair_a, pair_b, order = pairs.first, pairs.second, neighbours_in_order
    total = 0
    before = np.empty(0, np.int64)
    for k in range(len(order)):
        neighbours = np.empty(set_high[k] - set_low[k], np.int64)
        n = 0
        for i in range(set_low[k], set_high[k]):
            if pair_a[i] == s:
                neighbours[n] = pair_b[i]
                n += 1
            elif pair_b[i] == s:
                neighbours[n] = pair_a[i]
                n += 1
        if k > 0:
            low, high = _bins(u, sigma, order[k - 1], order[k])
            closed = False
            for a in before:
                for b in neighbours[:n]:
                    closed = closed or (a != b and low <= chord(star_u, a, star_u, b) <= high)
            total += closed
        before = neighbours[:n]
    return total


@kernel
def _match(u, sigma, star_u, pairs, star):
    """Write the star of each centroid to `star` (n,), which is -1 before.

    The centroids are directions u (n, 3), sensor frame, with errors `sigma` (n,) [rad]; the stars
    are star_u (m, 3), ICRS, and their `pairs` a `PairTable`.
    """
    n, m = len(u), len(star_u)
    state, counted_in = np.zeros(m, np.int16), np.zeros(m, np.int32)
    separation = np.empty(n)
    set_low, set_high = np.zeros(n, np.int64), np.zeros(n, np.int64)
    stamp = 0
    for main in range(n):
        state[:] = 0
        for k in range(n):
            separation[k] = chord(u, main, u, k) if k != main else 1e9
        order = np.argsort(separation)
        used = min(n - 1, N_NEIGHBOURS)
        for k in range(used):
            low, high = _bins(u, sigma, main, order[k])
            set_low[k], set_high[k] = range_of(pairs.chord, low, high)
            stamp += 1
            for i in range(set_low[k], set_high[k]):  # a set counts a star once
                a, b = pairs.first[i], pairs.second[i]
                if counted_in[a] != stamp:
                    counted_in[a] = stamp
                    state[a] += 1
                if counted_in[b] != stamp:
                    counted_in[b] = stamp
                    state[b] += 1
        top = state.max()
        if top < 2:
            continue
        tied = np.flatnonzero(state == top)
        if len(tied) == 1:
            star[main] = tied[0]
            continue
        best, draw = -1, False
        for s in tied:
            closed = _triangles(u, sigma, star_u, pairs, order[:used], s, set_low, set_high)
            draw = closed == best or (draw and closed < best)
            if closed > best:
                best = closed
                star[main] = s
        if draw:
            star[main] = -1
