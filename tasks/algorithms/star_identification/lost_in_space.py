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
from epipole.tasks.algorithms.star_identification.evidence import choice_lost, match_evidence
from epipole.tasks.algorithms.star_identification.field import aberrated
from epipole.tasks.algorithms.star_identification.sky_grid import nearest_star

# A wrong attitude closer than this to the best one is the best one [rad, about 0.3 degrees].
SAME_ATTITUDE = 5e-3
# The best attitude must be this much (in log) more probable than any other.
CLEAR_LEAD = 7.0
GIVE_UP_AFTER = 8  # look-ups without a hit, on the quick first pass
N_VERIFIED = 64  # brightest centroids that are looked up for each hypothesis
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
    in_view,
    area,
    row_of,
):
    """Refine an attitude whose first matches are in row_of; return its log evidence."""
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
    evidence, _ = match_evidence(
        slot, chi2_of, sigma, instrumental, magnitude, log_density, zero_point, in_view, area
    )
    return evidence + choice_lost(P)


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
    in_view,
    area,
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
    gate, log_density, zero_point, in_view, area
        As in `evidence`; the mean number of stars in view.
    enough, budget
        Log evidence to stop at; most look-ups.
    """
    n = len(u)
    n_checked = min(n, N_VERIFIED)
    min_hits = 2 if n > 3 else 1
    E, F, R, P = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    sa, sb = np.empty(3), np.empty(3)
    t, radius, gain = np.empty((n, 3)), np.empty(n), np.empty(n)
    row_of, row_try = np.empty(n, np.int64), np.empty(n, np.int64)
    best, runner, work = -1e9, -1e9, 0
    for thorough in range(2):
        give_up_after = n if thorough else GIVE_UP_AFTER
        mag_gate = 1.5 if thorough else 0.8
        pair_gate = 3.2 if thorough else 2.3
        for j in range(1, min(n, n_pattern)):
            for i in range(j):
                dx, dy, dz = u[j, 0] - u[i, 0], u[j, 1] - u[i, 1], u[j, 2] - u[i, 2]
                c = math.sqrt(dx * dx + dy * dy + dz * dz)
                if c < min_chord:
                    continue
                noise2 = sigma[i] * sigma[i] + sigma[j] * sigma[j]
                # Aberration stretches by v / c at most.
                tolerance = pair_gate * math.sqrt(noise2) + 1.1e-4 * c
                lo, hi = range_of(chord, below, slope, intercept, c - tolerance, c + tolerance)
                work += 10
                if lo == hi:
                    continue
                _basis(u[i, 0], u[i, 1], u[i, 2], u[j, 0], u[j, 1], u[j, 2], E)
                for k in range(n_checked):
                    for m in range(3):
                        t[k, m] = E[m, 0] * u[k, 0] + E[m, 1] * u[k, 1] + E[m, 2] * u[k, 2]
                    # The pair's own errors, with the lever of the distance from its middle.
                    d2 = t[k, 1] * t[k, 1] + t[k, 2] * t[k, 2]
                    s2 = sigma[k] * sigma[k] + 0.5 * noise2 * (0.5 + 2.0 * d2 / (c * c))
                    radius[k] = min(gate * math.sqrt(s2), grid_radius)
                    gain[k] = math.log(area / (math.pi * radius[k] * radius[k] * in_view))
                m_ij = instrumental[i] - instrumental[j]
                for p in range(lo, hi):
                    for way in range(2):
                        ra, rb = (pair_a[p], pair_b[p]) if way == 0 else (pair_b[p], pair_a[p])
                        if abs(star_mag[ra] - star_mag[rb] - m_ij) > mag_gate:  # false where NaN
                            continue
                        if abs(star_mag[ra] - instrumental[i] - zero_point) > mag_gate:
                            continue
                        aberrated(star_u[ra, 0], star_u[ra, 1], star_u[ra, 2], beta, sa)
                        aberrated(star_u[rb, 0], star_u[rb, 1], star_u[rb, 2], beta, sb)
                        _basis(sa[0], sa[1], sa[2], sb[0], sb[1], sb[2], F)
                        work += 4
                        hits, score = 0, 0.0
                        for k in range(n_checked):
                            if k >= give_up_after and hits == 0:
                                break
                            row_of[k] = -1
                            if k in (i, j):
                                continue
                            work += 1
                            x = t[k, 0] * F[0, 0] + t[k, 1] * F[1, 0] + t[k, 2] * F[2, 0]
                            y = t[k, 0] * F[0, 1] + t[k, 1] * F[1, 1] + t[k, 2] * F[2, 1]
                            z = t[k, 0] * F[0, 2] + t[k, 1] * F[1, 2] + t[k, 2] * F[2, 2]
                            q = x * beta[0] + y * beta[1] + z * beta[2]
                            s, _ = nearest_star(
                                x + q * x - beta[0],
                                y + q * y - beta[1],
                                z + q * z - beta[2],
                                radius[k],
                                star_u,
                                first,
                                star,
                                n_face,
                            )
                            if s >= 0:
                                row_of[k] = s
                                hits += 1
                                score += gain[k]
                        if hits < min_hits:
                            continue
                        rest = n_checked - 2.0
                        score -= (
                            math.lgamma(rest + 1.0)
                            - math.lgamma(hits + 1.0)
                            - math.lgamma(rest - hits + 1.0)
                        )
                        if score < math.log(rest + 1.0) - 1.0:  # as many hits as chance gives
                            continue
                        row_of[i], row_of[j] = ra, rb
                        for r in range(3):
                            for m in range(3):
                                R[r, m] = E[0, r] * F[0, m] + E[1, r] * F[1, m] + E[2, r] * F[2, m]
                        for k in range(n):
                            row_try[k] = row_of[k] if k < n_checked else -1
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
                            in_view,
                            area,
                            row_try,
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
