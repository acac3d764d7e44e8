"""A pair of centroids taken for a pair of stars: its attitude, tried and judged by all others."""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.geometry.attitude import refine_attitude
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.star_identification.search.evidence import (
    choice_lost,
    log_ways,
    match_evidence,
)
from epipole.tasks.algorithms.star_identification.search.field import aberrated
from epipole.tasks.algorithms.star_identification.sky.sky_grid import nearest_star

Array = npt.NDArray[np.float64]

STAR_SHARE = 0.5  # of the centroids, before anything is known
LOG_MISS = math.log(1.0 - STAR_SHARE)
MAX_BETA = 1.1e-4  # of an observer near the Earth


class Centroids(NamedTuple):
    """A frame's centroids, brightest first; as `frame.Frame`.

    n_checked : how many of them a hypothesis is tried on
    """

    u: Array
    sigma: Array
    instrumental: Array
    beta: Array
    n_checked: int


class Stars(NamedTuple):
    """The catalogue with its `SkyGrid`."""

    u: Array
    magnitude: Array
    first: npt.NDArray[np.int32]
    star: npt.NDArray[np.int32]
    n_face: int
    grid_radius: float


class Rule(NamedTuple):
    """How matches are weighed; as in `evidence`.

    in_view : stars in an image on average
    """

    gate: float
    log_density: Array
    zero_point: float
    spread: float
    in_view: float
    area: float
    box: Array


class Scratch(NamedTuple):
    """Room for one pair of centroids and one hypothesis.

    E, F, R, P : (3, 3): frames of the pair in the image and in the sky, attitude, covariance
    t : (n_checked, 3), the centroids in E
    gain, fall, radius : (n_checked,), what a hit adds, less `fall` times its squared
        distance, and how far one is looked for
    row_of : (n,), the star of each centroid, -1 none
    none : (0,), an empty order
    """

    E: Array
    F: Array
    R: Array
    P: Array
    t: Array
    gain: Array
    fall: Array
    radius: Array
    row_of: npt.NDArray[np.int64]
    none: npt.NDArray[np.int64]


@kernel
def make_scratch(n, n_checked):
    """Return room for frames of n centroids (compiled)."""
    return Scratch(
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


@kernel
def separation(u, i, j):
    """Return the chord between two of the directions (compiled)."""
    dx, dy, dz = u[j, 0] - u[i, 0], u[j, 1] - u[i, 1], u[j, 2] - u[i, 2]
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@kernel
def _basis(a, b, c, F):
    """Write rows: along the sum of two unit vectors c apart, along the difference, and their
    cross product."""
    f, g = 1.0 / math.sqrt(4.0 - c * c), 1.0 / c
    for m in range(3):
        F[0, m], F[1, m] = f * (a[m] + b[m]), g * (b[m] - a[m])
    F[2, 0] = F[0, 1] * F[1, 2] - F[0, 2] * F[1, 1]
    F[2, 1] = F[0, 2] * F[1, 0] - F[0, 0] * F[1, 2]
    F[2, 2] = F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0]


@kernel
def prepare_pair(seen, stars, rule, i, j, c, room):
    """Fill the room for centroids i and j, c apart; return in which order the others are to
    be looked up (compiled)."""
    u, sigma, t = seen.u, seen.sigma, room.t
    noise2 = sigma[i] * sigma[i] + sigma[j] * sigma[j]
    E, fall, gain = room.E, room.fall, room.gain
    _basis(u[i], u[j], c, E)
    for k in range(seen.n_checked):
        for m in range(3):
            t[k, m] = E[m, 0] * u[k, 0] + E[m, 1] * u[k, 1] + E[m, 2] * u[k, 2]
        # The pair's own errors, with the lever of the distance from its middle;
        # aberration, left out here, is nearly the same for all.
        d2 = t[k, 1] * t[k, 1] + t[k, 2] * t[k, 2]
        s2 = sigma[k] * sigma[k] + 0.5 * noise2 * (0.5 + 2.0 * d2 / (c * c))
        s2 += MAX_BETA * MAX_BETA * d2
        fall[k] = 0.5 / s2
        gain[k] = math.log(STAR_SHARE * rule.area * fall[k] / (math.pi * rule.in_view))
        # Beyond that a hit says less than a miss.
        near = min(rule.gate * rule.gate, 2.0 * max(gain[k] - LOG_MISS, 0.0))
        room.radius[k] = min(math.sqrt(near * s2), stars.grid_radius)
    # The pair itself first, then the nearest, which it places best: not by
    # brightness, as false ones may be the brightest.
    fall[i] = fall[j] = np.inf
    return np.argsort(-fall)[2:].copy()


@kernel
def try_pair(stars, a, b, c, order, floor, room):
    """Return how much more likely the other centroids are with the attitude that puts star a
    on the first and b on the second centroid of the pair than by chance (ln), below `floor`
    as soon as that is seen (compiled).

    A sequential probability ratio test (Wald 1945). F and row_of of the room are written.
    """
    F, t = room.F, room.t
    _basis(stars.u[a], stars.u[b], c, F)
    odds = 0.0
    for k in order:
        room.row_of[k], d2 = nearest_star(
            t[k, 0] * F[0, 0] + t[k, 1] * F[1, 0] + t[k, 2] * F[2, 0],
            t[k, 0] * F[0, 1] + t[k, 1] * F[1, 1] + t[k, 2] * F[2, 1],
            t[k, 0] * F[0, 2] + t[k, 1] * F[1, 2] + t[k, 2] * F[2, 2],
            room.radius[k],
            stars.u,
            stars.first,
            stars.star,
            stars.n_face,
        )
        odds += room.gain[k] - room.fall[k] * d2 if room.row_of[k] >= 0 else LOG_MISS
        if odds < floor:
            break
    return odds


@kernel
def judge_pair(seen, stars, rule, i, a, j, b, beaten, room):
    """Return the log evidence of the attitude last tried, refined with its matches, or a
    number below `beaten` where it is no more than that; R of the room gets it (compiled)."""
    row_of, E, F, R = room.row_of, room.E, room.F, room.R
    row_of[i], row_of[j] = a, b
    for k in range(seen.n_checked, len(row_of)):
        row_of[k] = -1
    for r in range(3):
        for m in range(3):
            R[r, m] = E[0, r] * F[0, m] + E[1, r] * F[1, m] + E[2, r] * F[2, m]
    return _judge(seen, stars, rule, beaten, R, room.P, row_of)


@kernel
def _look_up(R, seen, k, radius, stars):
    """Return the star nearest to centroid k, and the squared chord: aberration taken off it."""
    u, beta = seen.u, seen.beta
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
        stars.first,
        stars.star,
        stars.n_face,
    )


@kernel
def _stars_in_image(R, beta, star_u, box):
    """Return how many catalogue stars are in the image."""
    n = 0
    rx, ry = max(-box[0], box[1]), max(-box[2], box[3])
    c = 1.0 / math.sqrt(1.0 + rx * rx + ry * ry) - 1e-4
    for s in range(len(star_u)):
        x, y, z = star_u[s, 0], star_u[s, 1], star_u[s, 2]
        z = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z
        if z > c:
            x, y, w = x + beta[0], y + beta[1], star_u[s, 2] + beta[2]
            z = R[2, 0] * x + R[2, 1] * y + R[2, 2] * w
            across = (R[0, 0] * x + R[0, 1] * y + R[0, 2] * w) / z
            down = (R[1, 0] * x + R[1, 1] * y + R[1, 2] * w) / z
            n += box[0] < across < box[1] and box[2] < down < box[3]
    return n


@kernel
def _judge(seen, stars, rule, beaten, R, P, row_of):
    """Refine an attitude whose first matches are in row_of; return its log evidence, or a
    number below `beaten` where it is no more than that."""
    u, sigma = seen.u, seen.sigma
    n = len(u)
    a, magnitude = np.empty((n, 3)), np.zeros(n)
    slot, chi2_of = np.empty(n, np.int64), np.zeros(n)
    before = np.full(n, -2, np.int64)
    for step in range(6):
        same, matches = True, 0
        for k in range(n):
            if step > 0:
                wide = 1.7 if step == 1 else 1.0
                radius = min(rule.gate * sigma[k] * wide, stars.grid_radius)
                row_of[k], d2 = _look_up(R, seen, k, radius, stars)
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
                aberrated(stars.u[s, 0], stars.u[s, 1], stars.u[s, 2], seen.beta, a[k])
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
        slot, chi2_of, sigma, seen.instrumental, magnitude, rule.log_density, rule.zero_point,
        rule.spread, 0.0, rule.area,
    )  # fmt: skip
    evidence += choice_lost(P)
    if evidence <= beaten:  # even if no star was missed
        return evidence
    in_view = float(_stars_in_image(R, seen.beta, stars.u, rule.box))
    return evidence + log_ways(n, matches, float(matches)) - log_ways(n, matches, in_view)
