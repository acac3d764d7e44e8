"""Stars of a known field: which centroid is which star, given nearly the right attitude.

`solve_predicted` matches stars and refines the attitude in turn (`settle`). Where the prediction's
error is wider than the stars are apart, their pattern is first moved as a whole (`best_nudge`).
"""

import math
from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Flags, Integers
from epipole.tasks.algorithms.geometry.attitude import copy_matrix, refine_attitude_in, turn
from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel
from epipole.tasks.algorithms.star_identification.evidence import (
    choice_lost,
    choice_predicted,
    match_evidence,
)
from epipole.tasks.algorithms.star_identification.star_grid import find_in_cone

# A centroid between two stars, or a star between two centroids, is matched with the nearer one if
# that is so much better in chi-square (odds 20:1), and with neither otherwise.
CLEARLY_BETTER = 6.0
N_NUDGED = 12  # brightest centroids onto which a predicted star is moved
MAX_COMPARED = 100_000_000  # pairs of all tries for this; most are far apart: about 10 ms
MAX_MAG_ERROR = 2.5  # [mag] a match whose brightness is farther off is false


class Centroids(NamedTuple):
    """A frame's centroids, brightest first.

    u, sigma, instrumental : (n, 3), (n,), (n,) float, directions (sensor frame), error an
        axis [rad], -2.5 log10 flux (NaN unknown)
    beta : (3,) float, the sensor's barycentric velocity over that of light, ICRS axes
    """

    u: Array
    sigma: Array
    instrumental: Array
    beta: Array


class StarDirections(NamedTuple):
    """Directions (m, 3) and magnitudes (m,) of stars."""

    u: Array
    magnitude: Array


class Attitude(NamedTuple):
    """An attitude: R (3, 3), sensor from ICRS, and P (3, 3), its covariance about the sensor axes
    [rad^2]."""

    R: Array
    P: Array


class Matches(NamedTuple):
    """Each centroid's star (n,) int64, -1 none, and squared distance over sigma squared (n,)."""

    star: Integers
    chi2: Array


class _SettleScratch(NamedTuple):
    """Work space of `settle` for n centroids and m stars.

    v, radius, before : (m, 3), (n,), (n,) int64: directions of the stars in the sensor frame,
        search radii, matches of the step before
    owner, contested : (m,) int64, (m,) bool, see `match_stars`
    A : (3, 3), see `refine_attitude_in`
    """

    v: Array
    radius: Array
    before: Integers
    owner: Integers
    contested: Flags
    A: Array


@borrowing_kernel
def aberrated(x, y, z, beta, out):
    """Write the direction that an observer at beta (v / c) sees of a unit vector (compiled).

    `beta` (3,), the vector and `out` (3,) are on the same axes, ICRS. Explanatory Supplement to the
    Astronomical Almanac (2013), eq. 7.40.
    """
    p = x * beta[0] + y * beta[1] + z * beta[2]
    g = math.sqrt(1.0 - beta[0] * beta[0] - beta[1] * beta[1] - beta[2] * beta[2])
    f = 1.0 + p / (1.0 + g)
    ax, ay, az = g * x + f * beta[0], g * y + f * beta[1], g * z + f * beta[2]
    norm = math.sqrt(ax * ax + ay * ay + az * az)
    out[0], out[1], out[2] = ax / norm, ay / norm, az / norm


@borrowing_kernel
def stars_in_cone(u_icrs, n_stars, R, radius, row):
    """Write the rows of those of the first n_stars that are within `radius` [rad] of the boresight;
    return how many (compiled).

    u_icrs (m, 3) are unit vectors, R (3, 3) is sensor from ICRS. `row` (n_stars,) int, out.
    """
    x, y, z, c, n = R[2, 0], R[2, 1], R[2, 2], math.cos(radius), 0
    for s in range(n_stars):
        if x * u_icrs[s, 0] + y * u_icrs[s, 1] + z * u_icrs[s, 2] > c:
            row[n] = s
            n += 1
    return n


@kernel
def stars_about(bands, magnitude, R, radius, beta):
    """Return the stars within `radius` [rad], at most 90 degrees, of the boresight as an observer
    at beta sees them, and their rows in the catalogue, in order (compiled).

    `bands` are the stars of the catalogue by cells, `magnitude` (n,) theirs by rows. R (3, 3) is
    sensor from ICRS, `beta` (3,) is on ICRS axes, as the apparent directions are.
    """
    at = np.empty(len(bands.row), np.int32)
    at = at[: find_in_cone(bands, R[2, 0], R[2, 1], R[2, 2], math.cos(radius), at)]
    at = at[np.argsort(bands.row[at])]
    u, row = np.empty((len(at), 3)), np.empty(len(at), np.int64)
    for k, m in enumerate(at):
        row[k] = bands.row[m]
        aberrated(bands.u[m, 0], bands.u[m, 1], bands.u[m, 2], beta, u[k])
    return StarDirections(u, magnitude[row]), row


@borrowing_kernel
def turn_stars(R, a, v):
    """Write directions a (m, 3), ICRS axes, in the sensor frame of R (3, 3) to v (m, 3)
    (compiled)."""
    for s in range(len(a)):
        for i in range(3):
            v[s, i] = R[i, 0] * a[s, 0] + R[i, 1] * a[s, 1] + R[i, 2] * a[s, 2]


@borrowing_kernel
def count_in_view(v, box):
    """Return how many of the stars, given in the sensor frame, are in the image (compiled).

    v (m, 3) are the stars; `box` (4,) is x0, x1, y0, y1 of the image in normalised coordinates.
    """
    n = 0
    for s in range(len(v)):
        if v[s, 2] > 0.0:
            x, y = v[s, 0] / v[s, 2], v[s, 1] / v[s, 2]
            if box[0] < x < box[1] and box[2] < y < box[3]:
                n += 1
    return n


@borrowing_kernel
def match_stars(u, sigma, v, radius, matches, strict, owner, contested):
    """Match each centroid with the star nearest to it within its radius, one to one (compiled).

    Parameters
    ----------
    u, sigma, radius : (n, 3), (n,), (n,)
        Centroids' directions, sigma and search radius [rad], sensor frame.
    v : (m, 3)
        Stars' directions, sensor frame.
    matches : Matches, out
        The matches.
    strict : bool
        Where two are possible, match neither.
    owner, contested : (m,) int64, (m,) bool
        Work space.
    """
    star_of, chi2_of = matches.star, matches.chi2
    n, m = len(u), len(v)
    for s in range(m):
        owner[s], contested[s] = -1, False
    for k in range(n):
        star_of[k] = -1
        r, limit = radius[k], radius[k] * radius[k]
        best, best_d2, next_d2 = -1, limit, 1e9
        for s in range(m):
            dx = v[s, 0] - u[k, 0]
            if dx > r or dx < -r:
                continue
            dy, dz = v[s, 1] - u[k, 1], v[s, 2] - u[k, 2]
            d2 = dx * dx + dy * dy + dz * dz
            if d2 < best_d2:
                best, best_d2, next_d2 = s, d2, best_d2 if best >= 0 else 1e9
            elif d2 < next_d2 and d2 < limit:
                next_d2 = d2
        if best < 0:
            continue
        chi2 = best_d2 / (sigma[k] * sigma[k])
        if strict and next_d2 / (sigma[k] * sigma[k]) - chi2 < CLEARLY_BETTER:
            continue
        other = owner[best]
        if other >= 0:
            if abs(chi2_of[other] - chi2) < CLEARLY_BETTER:
                contested[best] = True
            if chi2_of[other] <= chi2:
                continue
            if chi2_of[other] - chi2 >= CLEARLY_BETTER:  # than all before, whoever contested it
                contested[best] = False
            star_of[other] = -1
        owner[best] = k
        star_of[k] = best
        chi2_of[k] = chi2
    if strict:
        for k in range(n):
            if star_of[k] >= 0 and contested[star_of[k]]:
                star_of[k] = -1


@borrowing_kernel
def _drop_odd(star_of, instrumental, magnitude, zero_point):
    """Take the star from centroids whose magnitude differs from it by more than `MAX_MAG_ERROR`.

    `star_of` (n,) is changed to -1 there. `instrumental` (n,) are magnitudes of the centroids, NaN
    where unknown, `magnitude` (m,) those of the stars, `zero_point` the latter minus the former;
    with NaN nothing changes.
    """
    if math.isnan(zero_point):
        return
    for k in range(len(star_of)):
        s = star_of[k]
        if s >= 0 and abs(magnitude[s] - instrumental[k] - zero_point) > MAX_MAG_ERROR:
            star_of[k] = -1


@kernel
def settle(R, P, s_xy, s_z, centroids, stars, rule, matches):
    """Match, refine, match again until nothing changes; return the number of matches (compiled).

    Starts at R (3, 3), sensor from ICRS, with an error of s_xy across and s_z about the boresight
    [rad]. R is refined in place; its covariance P (3, 3) about the sensor axes [rad^2] and the
    matches are written. `stars` have apparent directions. Returns 0 where there is no attitude.
    """
    n, m = len(centroids.u), len(stars.u)
    scratch = _SettleScratch(
        np.empty((m, 3)),
        np.empty(n),
        np.full(n, -2, np.int64),
        np.empty(m, np.int64),
        np.empty(m, np.bool_),
        np.empty((3, 3)),
    )
    return _settle_in(scratch, R, P, s_xy, s_z, centroids, stars, rule, matches)


@borrowing_kernel
def _settle_in(scratch, R, P, s_xy, s_z, centroids, stars, rule, matches):
    """Do what `settle` does, in the given work space, a `_SettleScratch`."""
    u, sigma = centroids.u, centroids.sigma
    v, radius, before, owner, contested, A = scratch
    n = len(u)
    for step in range(8):
        turn_stars(R, stars.u, v)
        for k in range(n):
            more2 = 0.0
            if step == 0:
                off2 = u[k, 0] * u[k, 0] + u[k, 1] * u[k, 1]
                more2 = s_xy * s_xy + s_z * s_z * off2
            elif step == 1:  # the first attitude may rest on a wrong match
                more2 = 2.0 * sigma[k] * sigma[k]
            radius[k] = rule.gate * math.sqrt(sigma[k] * sigma[k] + more2)
        match_stars(u, sigma, v, radius, matches, step > 1, owner, contested)
        _drop_odd(matches.star, centroids.instrumental, stars.magnitude, rule.zero_point)
        same, count = True, 0
        for k in range(n):
            same = same and matches.star[k] == before[k]
            before[k] = matches.star[k]
            count += matches.star[k] >= 0
        if count < 2:
            return 0
        if same and step > 2:
            return count
        if not refine_attitude_in(R, u, sigma, stars.u, matches.star, P, A):
            return 0
    return count


@borrowing_kernel
def _nudge(R, u, k, a, s):
    """Turn R by the smallest rotation that puts star s on centroid k.

    R (3, 3), sensor from ICRS, changes. u (n, 3) are the centroids, sensor frame, a (m, 3) the
    stars, ICRS axes.
    """
    x = R[0, 0] * a[s, 0] + R[0, 1] * a[s, 1] + R[0, 2] * a[s, 2]
    y = R[1, 0] * a[s, 0] + R[1, 1] * a[s, 1] + R[1, 2] * a[s, 2]
    z = R[2, 0] * a[s, 0] + R[2, 1] * a[s, 1] + R[2, 2] * a[s, 2]
    cx, cy, cz = y * u[k, 2] - z * u[k, 1], z * u[k, 0] - x * u[k, 2], x * u[k, 1] - y * u[k, 0]
    sine = math.sqrt(cx * cx + cy * cy + cz * cz)
    if sine > 0.0:
        f = math.asin(min(sine, 1.0)) / sine
        turn(R, f * cx, f * cy, f * cz)


@kernel
def best_nudge(R0, s_xy, s_z, centroids, a, gate, R):
    """Write to R the best of the attitudes near R0 that put a star on a centroid (compiled).

    The best one brings most other centroids near stars. For predictions with an error wider than
    the stars are apart. The `N_NUDGED` brightest centroids are tried, until `MAX_COMPARED`
    pairs of a centroid and a star are spent.

    Parameters
    ----------
    R0, R : (3, 3)
        Prediction, sensor from ICRS; R is written.
    s_xy, s_z : float
        Its errors across and about the boresight [rad].
    a : (m, 3)
        Apparent directions of the stars, ICRS axes.
    gate : float
        How far a star is moved at most, in sigmas.
    """
    u, sigma = centroids.u, centroids.sigma
    n, m = len(u), len(a)
    v, w, trial = np.empty((m, 3)), np.empty((m, 3)), np.empty((3, 3))
    by_x, nearest, r2 = np.argsort(u[:, 0]), np.empty(n), np.empty(n)
    x_of = u[:, 0][by_x]
    turn_stars(R0, a, v)
    best, compared = 0.0, 0
    copy_matrix(R0, R)
    for i in range(min(n, N_NUDGED)):
        off2 = u[i, 0] * u[i, 0] + u[i, 1] * u[i, 1]
        reach2 = gate * gate * (s_xy * s_xy + s_z * s_z * off2 + sigma[i] * sigma[i])
        for k in range(n):
            ex, ey = u[k, 0] - u[i, 0], u[k, 1] - u[i, 1]
            lever2 = s_z * s_z * (ex * ex + ey * ey)
            r2[k] = 6.0 * (sigma[k] * sigma[k] + sigma[i] * sigma[i] + lever2)
        reach = math.sqrt(np.max(r2))
        for s in range(m):
            dx, dy = v[s, 0] - u[i, 0], v[s, 1] - u[i, 1]
            if dx * dx + dy * dy > reach2 or v[s, 2] <= 0.0:
                continue
            compared += n * m
            if compared > MAX_COMPARED:
                return
            copy_matrix(R0, trial)
            _nudge(trial, u, i, a, s)
            turn_stars(trial, a, w)
            hits = _count_hits(u, by_x, x_of, w, reach, r2, nearest)
            if hits > best:
                best = hits
                copy_matrix(trial, R)


@kernel
def _count_hits(u, by_x, x_of, w, reach, r2, nearest):
    """Return how many centroids have a star near, each as 1 less its squared distance over r2.

    Parameters
    ----------
    u, w : (n, 3), (m, 3) float
        Centroids and stars, sensor frame. Only x and y are compared.
    by_x, x_of : (n,) int64, (n,) float
        Rows of u in order of x, and x in this order.
    reach : float
        The largest radius about a centroid [rad].
    r2, nearest : (n,) float
        Squared radius about each centroid [rad^2]; work space, written.
    """
    nearest[:] = r2
    for t in range(len(w)):
        at = np.searchsorted(x_of, w[t, 0] - reach)
        while at < len(x_of) and x_of[at] <= w[t, 0] + reach:
            k = by_x[at]
            dx, dy = w[t, 0] - u[k, 0], w[t, 1] - u[k, 1]
            nearest[k] = min(nearest[k], dx * dx + dy * dy)
            at += 1
    hits = 0.0
    for k in range(len(u)):
        hits += 1.0 - nearest[k] / r2[k]
    return hits


@kernel
def solve_predicted(predicted, lost, centroids, stars, box, rule, solution, matches):
    """Identify a frame whose attitude is nearly known; return its log evidence (compiled).

    Parameters
    ----------
    predicted : Attitude
        The prediction.
    lost : bool
        The attitude was searched over the whole sky: then its covariance only says how far to
        look, and the prior of the evidence is uniform over all attitudes.
    centroids : Centroids
        The frame's centroids.
    stars : StarDirections
        The stars around the field: apparent directions, ICRS axes.
    box : (4,)
        The image in normalised coordinates: x0, x1, y0, y1.
    rule : MatchRule
        How matches are weighed.
    solution, matches : Attitude, Matches, out
        Not written where the evidence is -1e9.
    """
    R0, P0 = predicted.R, predicted.P
    s_xy, s_z = math.sqrt(0.5 * (P0[0, 0] + P0[1, 1])), math.sqrt(P0[2, 2])
    n = len(centroids.u)
    v = np.empty((len(stars.u), 3))
    turn_stars(R0, stars.u, v)
    in_view = count_in_view(v, box)
    area = (box[1] - box[0]) * (box[3] - box[2])
    best = -1e9
    R, P = np.empty((3, 3)), np.empty((3, 3))
    tried = Matches(np.empty(n, np.int64), np.zeros(n))
    for attempt in range(2):
        copy_matrix(R0, R)
        if attempt == 1:
            best_nudge(R0, s_xy, s_z, centroids, stars.u, rule.gate, R)
        start = s_xy if attempt == 0 else 2.0 * centroids.sigma[0]
        if settle(R, P, start, s_z, centroids, stars, rule, tried) >= 3:
            evidence, _ = match_evidence(
                tried.star, tried.chi2, centroids.sigma, centroids.instrumental,
                stars.magnitude, rule, in_view, area,
            )  # fmt: skip
            evidence += choice_lost(P) if lost else choice_predicted(P, P0, R, R0)
            if evidence > best:
                best = evidence
                copy_matrix(R, solution.R)
                copy_matrix(P, solution.P)
                for k in range(n):
                    matches.star[k], matches.chi2[k] = tried.star[k], tried.chi2[k]
        if best > rule.clear_evidence or lost:
            break
    return best
