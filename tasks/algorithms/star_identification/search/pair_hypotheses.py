"""A pair of centroids taken for a pair of stars: its attitude, verified on all other centroids.

`prepare_pair` is called once for a pair of centroids, `try_pair` for each pair of stars it may be.
Hypotheses that pass are refined with all their matches and weighed by their log evidence
(`judge_pair`). `keep` remembers the best attitude of a search, and the best that differs from it;
`is_clear` says when the search may end.
"""

import math
from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Flags, Integers
from epipole.tasks.algorithms.geometry.attitude import copy_matrix, refine_attitude
from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel
from epipole.tasks.algorithms.star_identification.evidence import (
    MatchRule,
    choice_lost,
    log_ways,
    match_evidence,
)
from epipole.tasks.algorithms.star_identification.search.match_stars import Centroids, aberrated
from epipole.tasks.algorithms.star_identification.star_grid import (
    SkyGrid,
    StarBands,
    cell_at,
    cells_of_cone,
    nearest_star,
)
from epipole.tasks.algorithms.star_identification.star_pairs import PairTable

# Fastest observer near the Earth over the speed of light: 29.8 km/s of the Earth and some 3 km/s
# beside it. Aberration changes a separation by at most this share.
MAX_BETA = 1.1e-4


class Stars(NamedTuple):
    """The catalogue.

    u, magnitude : (m, 3), (m,) float, directions, ICRS, and magnitudes
    grid, bands : for look-ups of the star nearest to a direction, and of all stars of a field
    """

    u: Array
    magnitude: Array
    grid: SkyGrid
    bands: StarBands


class Image(NamedTuple):
    """A camera's image.

    box : (4,) float, x0, x1, y0, y1 in normalised coordinates
    area : solid angle [sr]
    in_view : mean number of catalogue stars in an image
    """

    box: Array
    area: float
    in_view: float


class SearchLimits(NamedTuple):
    """Bounds of a search.

    min_chord : closest centroids that are paired [rad]
    n_pattern : number of brightest centroids that are paired
    n_tried : number of brightest centroids that each hypothesis is tried on
    star_share : share of the centroids that are stars, a prior
    budget : maximum of work, see `WORK_PER_S`
    """

    min_chord: float
    n_pattern: int
    n_tried: int
    star_share: float
    budget: float


class Problem(NamedTuple):
    """A frame whose attitude is searched for over the whole sky, and what is known."""

    centroids: Centroids
    stars: Stars
    pairs: PairTable
    image: Image
    rule: MatchRule
    limits: SearchLimits


class PairScratch(NamedTuple):
    """Work space of one pair of centroids and one hypothesis.

    E, F, R, P : (3, 3): axes of the pair as rows, in the image (sensor frame) and in the sky
        (ICRS); attitude, sensor from ICRS, and its covariance about the sensor axes [rad^2]
    t : (n_checked, 3), the centroids on the axes E
    gain, fall, radius : (n_checked,); a hit at distance d adds gain - fall d^2, and stars
        within the radius are hits
    row_of : (n,), the star of each centroid, -1 none
    no_order : (0,), an empty order
    """

    E: Array
    F: Array
    R: Array
    P: Array
    t: Array
    gain: Array
    fall: Array
    radius: Array
    row_of: Integers
    no_order: Integers


@kernel
def make_scratch(n, n_checked):
    """Return scratch for n centroids, of which hypotheses are tried on n_checked (compiled)."""
    return PairScratch(
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((n_checked, 3)),
        np.empty(n_checked),
        np.empty(n_checked),
        np.empty(n_checked),
        np.full(n, -1, np.int64),
        np.empty(0, np.int64),
    )


@borrowing_kernel
def separation(u, i, j):
    """Return the chord between rows i and j of the unit vectors u (n, 3) (compiled)."""
    dx, dy, dz = u[j, 0] - u[i, 0], u[j, 1] - u[i, 1], u[j, 2] - u[i, 2]
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@borrowing_kernel
def _basis(a, b, c, F):
    """Write to F (3, 3) the rows: along the sum of two unit vectors a, b (3,) with the chord c,
    along their difference b - a, and the cross product of both rows."""
    f, g = 1.0 / math.sqrt(4.0 - c * c), 1.0 / c
    for m in range(3):
        F[0, m], F[1, m] = f * (a[m] + b[m]), g * (b[m] - a[m])
    F[2, 0] = F[0, 1] * F[1, 2] - F[0, 2] * F[1, 1]
    F[2, 1] = F[0, 2] * F[1, 0] - F[0, 0] * F[1, 2]
    F[2, 2] = F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0]


@kernel
def prepare_pair(problem, i, j, c, scratch):
    """Fill the scratch for centroids i and j, with the chord c; return in which order the others
    are to be looked up, (n_checked - 2,) int64 (compiled)."""
    u, sigma, t = problem.centroids.u, problem.centroids.sigma, scratch.t
    image, gate, grid_radius = problem.image, problem.rule.gate, problem.stars.grid.radius_rad
    share = problem.limits.star_share
    noise2 = sigma[i] * sigma[i] + sigma[j] * sigma[j]
    E, fall, gain = scratch.E, scratch.fall, scratch.gain
    _basis(u[i], u[j], c, E)
    for k in range(len(gain)):
        for m in range(3):
            t[k, m] = E[m, 0] * u[k, 0] + E[m, 1] * u[k, 1] + E[m, 2] * u[k, 2]
        # The pair's errors, with the lever of the distance from its middle. Aberration, which
        # is ignored here, is nearly the same for all.
        d2 = t[k, 1] * t[k, 1] + t[k, 2] * t[k, 2]
        s2 = sigma[k] * sigma[k] + 0.5 * noise2 * (0.5 + 2.0 * d2 / (c * c))
        s2 += MAX_BETA * MAX_BETA * d2
        fall[k] = 0.5 / s2
        gain[k] = math.log(share * image.area * fall[k] / (math.pi * image.in_view))
        # Farther away, a hit would be worth less than a miss.
        near = min(gate * gate, 2.0 * max(gain[k] - math.log(1.0 - share), 0.0))
        scratch.radius[k] = min(math.sqrt(near * s2), grid_radius)
    # The pair itself comes first and is cut off. The nearest follow: the pair predicts their
    # positions best. Not by brightness: false centroids may be the brightest.
    fall[i] = fall[j] = np.inf
    return np.argsort(-fall)[2:].copy()


@borrowing_kernel
def try_pair(stars, a, b, c, order, log_miss, floor, scratch):
    """Return the log odds of the attitude that puts stars a and b on the pair's centroids, by all
    other centroids (compiled).

    A sequential probability ratio test (Wald 1945): it stops as soon as the odds are below `floor`.
    A centroid without a star adds `log_miss`. c is the chord between the stars, `order` is from
    `prepare_pair`. Writes F and row_of of the scratch.
    """
    F, t = scratch.F, scratch.t
    _basis(stars.u[a], stars.u[b], c, F)
    odds = 0.0
    for k in order:
        scratch.row_of[k], d2 = nearest_star(
            t[k, 0] * F[0, 0] + t[k, 1] * F[1, 0] + t[k, 2] * F[2, 0],
            t[k, 0] * F[0, 1] + t[k, 1] * F[1, 1] + t[k, 2] * F[2, 1],
            t[k, 0] * F[0, 2] + t[k, 1] * F[1, 2] + t[k, 2] * F[2, 2],
            scratch.radius[k],
            stars.u,
            stars.grid.first,
            stars.grid.star,
            stars.grid.n_face,
        )
        odds += scratch.gain[k] - scratch.fall[k] * d2 if scratch.row_of[k] >= 0 else log_miss
        if odds < floor:
            break
    return odds


@borrowing_kernel
def _attitude(scratch):
    """Write to R of the scratch the attitude, sensor from ICRS, that turns F to E."""
    E, F, R = scratch.E, scratch.F, scratch.R
    for r in range(3):
        for m in range(3):
            R[r, m] = E[0, r] * F[0, m] + E[1, r] * F[1, m] + E[2, r] * F[2, m]


@borrowing_kernel
def pair_attitude(u_i, u_j, star_i, star_j, c, scratch):
    """Write to R of the scratch the attitude that puts two stars, c apart, on two centroids
    (compiled).

    u_i and u_j (3,) are the centroids' unit vectors, sensor frame, star_i and star_j (3,) the
    stars', ICRS; c is the chord between the stars. E and F of the scratch are written too.
    """
    apart2 = (u_i[0] - u_j[0]) ** 2 + (u_i[1] - u_j[1]) ** 2 + (u_i[2] - u_j[2]) ** 2
    _basis(u_i, u_j, math.sqrt(apart2), scratch.E)
    _basis(star_i, star_j, c, scratch.F)
    _attitude(scratch)


@borrowing_kernel
def judge_pair(problem, i, a, j, b, beaten, scratch):
    """Return the log evidence of the attitude tried last, refined with its matches (compiled).

    An evidence of `beaten` or less is not computed exactly: the number returned is then an upper
    bound, also `beaten` or less. Writes the attitude to R of the scratch.
    """
    row_of = scratch.row_of
    row_of[i], row_of[j] = a, b
    for k in range(len(scratch.gain), len(row_of)):
        row_of[k] = -1
    _attitude(scratch)
    return _judge(problem, beaten, scratch.R, scratch.P, row_of)


@borrowing_kernel
def _look_up(R, centroids, k, radius, stars):
    """Return the star nearest to centroid k, without aberration, and the squared chord to it.

    R (3, 3) is sensor from ICRS. The star is a row of `stars`, a `Stars`, within `radius` [rad]; -1
    without one.
    """
    u, beta = centroids.u, centroids.beta
    x = R[0, 0] * u[k, 0] + R[1, 0] * u[k, 1] + R[2, 0] * u[k, 2]
    y = R[0, 1] * u[k, 0] + R[1, 1] * u[k, 1] + R[2, 1] * u[k, 2]
    z = R[0, 2] * u[k, 0] + R[1, 2] * u[k, 1] + R[2, 2] * u[k, 2]
    p = x * beta[0] + y * beta[1] + z * beta[2]
    # To first order in v / c; the rest is 2 mas.
    return nearest_star(
        x + p * x - beta[0],
        y + p * y - beta[1],
        z + p * z - beta[2],
        radius,
        stars.u,
        stars.grid.first,
        stars.grid.star,
        stars.grid.n_face,
    )


@borrowing_kernel
def _stars_in_image(R, beta, stars, box):
    """Return how many catalogue stars, `StarBands`, are in the image.

    R (3, 3) is sensor from ICRS; `beta` (3,) as in `Centroids`, `box` (4,) as in `Image`.
    """
    n = 0
    rx, ry = max(-box[0], box[1]), max(-box[2], box[3])
    c = 1.0 / math.sqrt(1.0 + rx * rx + ry * ry) - 1e-4
    cells = cells_of_cone(R[2, 0], R[2, 1], R[2, 2], c)
    for band in range(cells.low, cells.high + 1):
        for sector in range(cells.left, cells.left + cells.n_sectors):
            cell = cell_at(band, sector)
            for k in range(stars.first[cell], stars.first[cell + 1]):
                x, y = stars.u[k, 0] + beta[0], stars.u[k, 1] + beta[1]
                w = stars.u[k, 2] + beta[2]
                z = R[2, 0] * x + R[2, 1] * y + R[2, 2] * w
                if z > c:
                    across = (R[0, 0] * x + R[0, 1] * y + R[0, 2] * w) / z
                    down = (R[1, 0] * x + R[1, 1] * y + R[1, 2] * w) / z
                    n += box[0] < across < box[1] and box[2] < down < box[3]
    return n


@kernel
def _judge(problem, beaten, R, P, row_of):
    """Refine an attitude whose first matches are in row_of; return its log evidence, as
    `judge_pair` does.

    R (3, 3), sensor from ICRS, its covariance P (3, 3) about the sensor axes [rad^2] and row_of
    (n,) int64, each centroid's star, -1 none, are written.
    """
    centroids, stars, rule = problem.centroids, problem.stars, problem.rule
    u, sigma = centroids.u, centroids.sigma
    n = len(u)
    a, magnitude = np.empty((n, 3)), np.zeros(n)
    slot, chi2_of = np.empty(n, np.int64), np.zeros(n)
    before = np.full(n, -2, np.int64)
    for step in range(6):
        same, matches = True, 0
        for k in range(n):
            if step > 0:
                factor = 1.7 if step == 1 else 1.0
                radius = min(rule.gate * sigma[k] * factor, stars.grid.radius_rad)
                row_of[k], d2 = _look_up(R, centroids, k, radius, stars)
                chi2_of[k] = d2 / (sigma[k] * sigma[k])
                for j in range(k):  # one star, one centroid
                    if row_of[k] >= 0 and row_of[j] == row_of[k]:
                        if chi2_of[j] <= chi2_of[k]:
                            row_of[k] = -1
                        else:
                            row_of[j] = slot[j] = -1
                            matches -= 1
            s = row_of[k]
            slot[k] = k if s >= 0 else -1
            if s >= 0:
                matches += 1
                magnitude[k] = stars.magnitude[s]
                aberrated(stars.u[s, 0], stars.u[s, 1], stars.u[s, 2], centroids.beta, a[k])
        for k in range(n):
            same = same and before[k] == row_of[k]
            before[k] = row_of[k]
        if matches < 3:
            return -1e9
        if same and step > 1:
            break
        if not refine_attitude(R, u, sigma, a, slot, P):
            return -1e9
    evidence, matches = match_evidence(
        slot, chi2_of, sigma, centroids.instrumental, magnitude, rule, 0.0, problem.image.area
    )
    evidence += choice_lost(P)
    if evidence <= beaten:  # even if every star in view was matched
        return evidence
    in_view = float(_stars_in_image(R, centroids.beta, stars.bands, problem.image.box))
    return evidence + log_ways(n, matches, float(matches)) - log_ways(n, matches, in_view)


# The best attitude of a search.

# Attitudes closer than this are the same one [rad, about 0.3 degrees].
SAME_ATTITUDE = 5e-3
# Log odds below which a hypothesis is dropped, and from which it is refined.
DROP_LOG_ODDS, REFINE_LOG_ODDS = -6.0, 2.0
# A search goes on where more than half of the matches are this near to each other, in sides of the
# image: in a cluster of stars, a wrong attitude may match many of them, and little else.
CLUSTER = 0.1


class Best(NamedTuple):
    """The best attitude so far.

    evidence : (2,) float, log evidence of the best, and of the best that is another attitude
    clustered : (1,) bool, most matches of the best are in one part of the image
    R : (3, 3) float
    """

    evidence: Array
    clustered: Flags
    R: Array


@kernel
def no_attitude(R):
    """Return the best attitude before any is found; it will be written to R (3, 3) (compiled)."""
    return Best(np.array([-1e9, -1e9]), np.zeros(1, np.bool_), R)


@borrowing_kernel
def keep(evidence, problem, scratch, best):
    """Enter the attitude judged last, R of the scratch, into `best` if it is the best, or the
    best that differs from the best. `evidence` is its log evidence."""
    top, R = best.evidence, scratch.R
    if evidence <= top[1]:
        return
    gap2 = 0.0
    for r in range(3):
        for m in range(3):
            gap2 += (R[r, m] - best.R[r, m]) ** 2
    same = gap2 < 2.0 * SAME_ATTITUDE * SAME_ATTITUDE
    if evidence > top[0]:
        if not same:
            top[1] = top[0]
        top[0] = evidence
        best.clustered[0] = _is_clustered(problem.centroids.u, scratch.row_of, problem.image.box)
        copy_matrix(R, best.R)
    elif not same:
        top[1] = evidence


@borrowing_kernel
def _is_clustered(u, row_of, box):
    """Return whether more than half of the matches are near one of them.

    u (n, 3) are the centroids, sensor frame, row_of (n,) int64 their stars, -1 none, and `box` (4,)
    is as in `Image`.
    """
    near = CLUSTER * max(box[1] - box[0], box[3] - box[2])
    matches = 0
    for star in row_of:
        matches += star >= 0
    for k in range(len(row_of)):
        if row_of[k] < 0:
            continue
        around = 0
        for m in range(len(row_of)):
            dx, dy = u[m, 0] - u[k, 0], u[m, 1] - u[k, 1]
            around += (row_of[m] >= 0) & (dx * dx + dy * dy < near * near)
        if 2 * around > matches:
            return True
    return False


@borrowing_kernel
def is_clear(best, rule):
    """Return whether the best attitude is beyond doubt (compiled)."""
    top = best.evidence
    return (
        not best.clustered[0]
        and top[0] > rule.clear_evidence
        and top[0] - top[1] > rule.clear_evidence
    )
