"""Lost in space: the attitude of one frame with no prior, by likelihood over all centroids.

Hypotheses are pairs of centroids, brightest first; each is looked up in the table of
catalogue pairs, both ways round; two directions give an attitude; every other centroid is
turned to the sky and looked up in a grid of the catalogue. Where two more hit, the attitude
is refined and judged by its log evidence over all centroids (`evidence`). The search ends
early once one is beyond doubt, and in any case after a counted number of look-ups, so that
it takes bounded time and gives the same answer on every machine.
"""

import math
from typing import NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.attitude import copy_matrix, refine_attitude
from epipole.tasks.algorithms.kvector import range_of
from epipole.tasks.algorithms.star_identification.evidence import (
    choice_lost,
    log_ways,
    match_evidence,
)
from epipole.tasks.algorithms.star_identification.field import aberrated
from epipole.tasks.algorithms.star_identification.sky_grid import nearest_star

# A wrong attitude closer than this to the best one is the best one [rad, about 0.3 degrees].
SAME_ATTITUDE = 5e-3
# The best attitude must be this much (in log) more probable than any other.
CLEAR_LEAD = 7.0
N_VERIFIED = 64  # brightest centroids that are looked up for each hypothesis
# Passes over the pairs of centroids, ever more thorough: log odds at which a hypothesis is
# dropped, gates of the pair's brightness [spreads] and separation [sigma], log odds that are
# worth a refinement. The last does without brightness, for flux of which nothing is known.
PASSES = np.array([[-1.5, 2.0, 2.0, 2.0], [-3.0, 3.0, 2.5, 1.0], [-3.0, 1e9, 2.5, 1.0]])
# Where brightness is known, a frame's stars turn up within this many look-ups or hardly ever.
ENOUGH_LOOKUPS = 750_000
STAR_SHARE = 0.5  # of the centroids, before anything is known
LOG_MISS = math.log(1.0 - STAR_SHARE)
MAX_BETA = 1.1e-4  # of an observer near the Earth
MAX_LOOKUPS_PER_S = 2.5e7


class Verdict(NamedTuple):
    """What a search found.

    found : the attitude is beyond doubt
    R_sensor_from_icrs : (3, 3), of the best hypothesis
    evidence, runner_up : log evidence of the best and of the best different attitude
    exhausted : the search ended because its bound was reached
    """

    found: bool
    R_sensor_from_icrs: npt.NDArray[np.float64]
    evidence: float
    runner_up: float
    exhausted: bool


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _basis(ax, ay, az, bx, by, bz, E):
    """Write rows: along the sum, along the difference, and their cross product."""
    x, y, z = ax + bx, ay + by, az + bz
    n = math.sqrt(x * x + y * y + z * z)
    E[0, 0], E[0, 1], E[0, 2] = x / n, y / n, z / n
    x, y, z = bx - ax, by - ay, bz - az
    n = math.sqrt(x * x + y * y + z * z)
    E[1, 0], E[1, 1], E[1, 2] = x / n, y / n, z / n
    E[2, 0] = E[0, 1] * E[1, 2] - E[0, 2] * E[1, 1]
    E[2, 1] = E[0, 2] * E[1, 0] - E[0, 0] * E[1, 2]
    E[2, 2] = E[0, 0] * E[1, 1] - E[0, 1] * E[1, 0]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _star_basis(a, b, c, F):
    """Write `_basis` of two unit vectors c apart; faster."""
    f, g = 1.0 / math.sqrt(4.0 - c * c), 1.0 / c
    for m in range(3):
        F[0, m], F[1, m] = f * (a[m] + b[m]), g * (b[m] - a[m])
    F[2, 0] = F[0, 1] * F[1, 2] - F[0, 2] * F[1, 1]
    F[2, 1] = F[0, 2] * F[1, 0] - F[0, 0] * F[1, 2]
    F[2, 2] = F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _try_pair(t, order, F, sign, gain, fall, radius, floor, star_u, first, star, n_face, row_of):
    """Return how much more likely the other centroids are with the pair's attitude than by
    chance (ln), below `floor` as soon as that is seen; write their stars. `order`: in which
    they are looked up.

    A sequential probability ratio test (Wald 1945).
    """
    odds = 0.0
    for k in order:
        p, q = sign * t[k, 1], sign * t[k, 2]
        row_of[k], d2 = nearest_star(
            t[k, 0] * F[0, 0] + p * F[1, 0] + q * F[2, 0],
            t[k, 0] * F[0, 1] + p * F[1, 1] + q * F[2, 1],
            t[k, 0] * F[0, 2] + p * F[1, 2] + q * F[2, 2],
            radius[k],
            star_u,
            first,
            star,
            n_face,
        )
        odds += gain[k] - fall[k] * d2 if row_of[k] >= 0 else LOG_MISS
        if odds < floor:
            break
    return odds


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _look_up(R, u, k, beta, radius, star_u, first, star, n_face):
    """Return the star nearest to centroid k, and the squared chord: aberration taken off it."""
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
        star_u,
        first,
        star,
        n_face,
    )


@numba.njit(nogil=True, cache=True, error_model="numpy")
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


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _judge(
    R,
    P,
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
    gate,
    log_density,
    zero_point,
    spread,
    box,
    area,
    row_of,
    beaten,
):
    """Refine an attitude whose first matches are in row_of; return its log evidence, or a
    number below `beaten` where it is no more than that."""
    n = len(u)
    a, magnitude = np.empty((n, 3)), np.zeros(n)
    slot, chi2_of = np.empty(n, np.int64), np.zeros(n)
    before = np.full(n, -2, np.int64)
    for step in range(6):
        same, matches = True, 0
        for k in range(n):
            if step > 0:
                wide = 1.7 if step == 1 else 1.0
                radius = min(gate * sigma[k] * wide, grid_radius)
                row_of[k], d2 = _look_up(R, u, k, beta, radius, star_u, first, star, n_face)
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
                magnitude[k] = star_mag[s]
                aberrated(star_u[s, 0], star_u[s, 1], star_u[s, 2], beta, a[k])
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
        slot, chi2_of, sigma, instrumental, magnitude, log_density, zero_point, spread, 0.0, area
    )
    evidence += choice_lost(P)
    if evidence <= beaten:  # even if no star was missed
        return evidence
    in_view = float(_stars_in_image(R, beta, star_u, box))
    return evidence + log_ways(n, matches, float(matches)) - log_ways(n, matches, in_view)


@numba.njit(nogil=True, cache=True, error_model="numpy")
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
    min_chord,
    n_pattern,
    gate,
    log_density,
    zero_point,
    spread,
    in_view,
    area,
    box,
    passes,
    enough,
    budget,
    R_best,
):
    """Return evidence, runner-up's evidence and look-ups made; write the best attitude (compiled).

    Parameters
    ----------
    u, sigma, instrumental : (n, 3), (n,), (n,)
        Centroids, brightest first: directions (sensor), sigma [rad], -2.5 log10 flux or NaN.
    beta : (3,)
        The sensor's barycentric velocity over that of light.
    star_u, star_mag, first, star, n_face, grid_radius
        The catalogue and its `SkyGrid`.
    chord, below, slope, intercept, pair_a, pair_b
        The `PairTable`.
    min_chord, n_pattern
        Closest centroids paired [rad]; how many of the brightest are.
    gate, log_density, zero_point, spread, in_view, area, box
        As in `evidence`; the mean number of stars in view; the image as `Optics` has it.
    enough, budget
        Log evidence to stop at; most look-ups.
    """
    n = len(u)
    n_checked = min(n, N_VERIFIED)
    E, F, R, P = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    t, gain = np.empty((n_checked, 3)), np.empty(n_checked)
    fall, radius = np.empty(n_checked), np.empty(n_checked)
    row_of = np.full(n, -1, np.int64)
    best, runner, work = -1e9, -1e9, 0
    for step in range(len(passes)):
        floor, mag_gate, pair_gate = passes[step, 0], passes[step, 1] * spread, passes[step, 2]
        worth = passes[step, 3]
        for j in range(1, min(n, n_pattern)):
            for i in range(j):
                dx, dy, dz = u[j, 0] - u[i, 0], u[j, 1] - u[i, 1], u[j, 2] - u[i, 2]
                c = math.sqrt(dx * dx + dy * dy + dz * dz)
                if c < min_chord:
                    continue
                noise2 = sigma[i] * sigma[i] + sigma[j] * sigma[j]
                # Aberration stretches by v / c at most.
                tolerance = pair_gate * math.sqrt(noise2) + MAX_BETA * c
                lo, hi = range_of(chord, below, slope, intercept, c - tolerance, c + tolerance)
                work += 10
                if lo == hi:
                    continue
                _basis(u[i, 0], u[i, 1], u[i, 2], u[j, 0], u[j, 1], u[j, 2], E)
                for k in range(n_checked):
                    for m in range(3):
                        t[k, m] = E[m, 0] * u[k, 0] + E[m, 1] * u[k, 1] + E[m, 2] * u[k, 2]
                    # The pair's own errors, with the lever of the distance from its middle;
                    # aberration, left out here, is nearly the same for all.
                    d2 = t[k, 1] * t[k, 1] + t[k, 2] * t[k, 2]
                    s2 = sigma[k] * sigma[k] + 0.5 * noise2 * (0.5 + 2.0 * d2 / (c * c))
                    s2 += MAX_BETA * MAX_BETA * d2
                    fall[k] = 0.5 / s2
                    gain[k] = math.log(STAR_SHARE * area * fall[k] / (math.pi * in_view))
                    # Beyond that a hit says less than a miss.
                    near = min(gate * gate, 2.0 * max(gain[k] - LOG_MISS, 0.0))
                    radius[k] = min(math.sqrt(near * s2), grid_radius)
                # The pair itself first, then the nearest, which it places best: not by
                # brightness, as false ones may be the brightest.
                fall[i] = fall[j] = np.inf
                order = np.argsort(-fall)
                m_ij = instrumental[i] - instrumental[j]
                for p in range(lo, hi):
                    d_mag = star_mag[pair_a[p]] - star_mag[pair_b[p]]
                    for way in range(2):
                        sign, a = (1.0, pair_a[p]) if way == 0 else (-1.0, pair_b[p])
                        if abs(sign * d_mag - m_ij) > 1.414 * mag_gate:  # false where NaN
                            continue
                        if abs(star_mag[a] - instrumental[i] - zero_point) > mag_gate:
                            continue
                        _star_basis(star_u[pair_a[p]], star_u[pair_b[p]], chord[p], F)
                        work += 10
                        odds = _try_pair(
                            t,
                            order[2:],
                            F,
                            sign,
                            gain,
                            fall,
                            radius,
                            floor,
                            star_u,
                            first,
                            star,
                            n_face,
                            row_of,
                        )
                        if odds < worth:
                            continue
                        row_of[i] = a
                        row_of[j] = pair_b[p] if way == 0 else pair_a[p]
                        for k in range(n_checked, n):
                            row_of[k] = -1
                        for r in range(3):
                            for m in range(3):
                                turned = E[1, r] * F[1, m] + E[2, r] * F[2, m]
                                R[r, m] = E[0, r] * F[0, m] + sign * turned
                        evidence = _judge(
                            R,
                            P,
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
                            gate,
                            log_density,
                            zero_point,
                            spread,
                            box,
                            area,
                            row_of,
                            runner,
                        )
                        work += 10 * n
                        if evidence <= runner:
                            continue
                        gap2 = 0.0
                        for r in range(3):
                            for m in range(3):
                                gap2 += (R[r, m] - R_best[r, m]) ** 2
                        if best > -1e9 and gap2 < 2.0 * SAME_ATTITUDE * SAME_ATTITUDE:
                            if evidence > best:
                                best = evidence
                                copy_matrix(R, R_best)
                        elif evidence > best:
                            best, runner = evidence, best
                            copy_matrix(R, R_best)
                        else:
                            runner = evidence
                        if best > enough and best - runner > CLEAR_LEAD:
                            return best, runner, work
                    if work > budget:
                        return best, runner, work
    return best, runner, work
