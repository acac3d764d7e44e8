"""Stars of a known field: which centroid is which star, given nearly the right attitude."""

import math

import numpy as np

from epipole.tasks.algorithms.geometry.attitude import copy_matrix, refine_attitude, turn
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.star_identification.search.evidence import (
    choice_lost,
    choice_predicted,
    match_evidence,
)

# A centroid between two stars, or a star between two centroids, goes to the better one only
# if that is this much better in chi-square (odds 20:1); otherwise to neither.
CLEARLY_BETTER = 6.0
# Brightest centroids on which a prediction is tried to be shifted.
N_NUDGED = 12
# A match whose brightness is this far off is a coincidence [mag].
ODD_MAG = 2.5


@kernel
def aberrated(x, y, z, beta, out):
    """Write the direction that an observer at beta (v / c) sees of a unit vector (compiled).

    Explanatory Supplement to the Astronomical Almanac (2013), eq. 7.40.
    """
    p = x * beta[0] + y * beta[1] + z * beta[2]
    g = math.sqrt(1.0 - beta[0] * beta[0] - beta[1] * beta[1] - beta[2] * beta[2])
    f = 1.0 + p / (1.0 + g)
    ax, ay, az = g * x + f * beta[0], g * y + f * beta[1], g * z + f * beta[2]
    norm = math.sqrt(ax * ax + ay * ay + az * az)
    out[0], out[1], out[2] = ax / norm, ay / norm, az / norm


@kernel
def stars_in_cone(u_icrs, n_stars, R, radius, row):
    """Write the rows of the first n_stars within `radius` [rad] of the boresight; return how
    many (compiled)."""
    x, y, z, c, n = R[2, 0], R[2, 1], R[2, 2], math.cos(radius), 0
    for s in range(n_stars):
        if x * u_icrs[s, 0] + y * u_icrs[s, 1] + z * u_icrs[s, 2] > c:
            row[n] = s
            n += 1
    return n


@kernel
def turn_stars(R, a, v):
    """Write the stars' directions in the sensor frame (compiled)."""
    for s in range(len(a)):
        for i in range(3):
            v[s, i] = R[i, 0] * a[s, 0] + R[i, 1] * a[s, 1] + R[i, 2] * a[s, 2]


@kernel
def count_in_view(v, box):
    """Return how many stars are in the image, sensor-frame directions given (compiled).

    `box` is x0, x1, y0, y1 of the image in normalised coordinates.
    """
    n = 0
    for s in range(len(v)):
        if v[s, 2] > 0.0:
            x, y = v[s, 0] / v[s, 2], v[s, 1] / v[s, 2]
            if box[0] < x < box[1] and box[2] < y < box[3]:
                n += 1
    return n


@kernel
def match_stars(u, sigma, v, radius, star_of, chi2_of, strict):
    """Match each centroid with the star nearest to it within its radius, one to one (compiled).

    Parameters
    ----------
    u, sigma, radius : (n, 3), (n,), (n,)
        Centroids' directions, sigma and search radius [rad], sensor frame.
    v : (m, 3)
        Stars' directions, sensor frame.
    star_of, chi2_of : (n,), out
        The star, -1 none; squared distance over sigma squared.
    strict : bool
        Where two could be meant, neither.
    """
    n, m = len(u), len(v)
    owner = np.full(m, -1, np.int64)
    contested = np.zeros(m, np.bool_)
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
            star_of[other] = -1
        owner[best] = k
        star_of[k] = best
        chi2_of[k] = chi2
    if strict:
        for k in range(n):
            if star_of[k] >= 0 and contested[star_of[k]]:
                star_of[k] = -1


@kernel
def _drop_odd(star_of, instrumental, magnitude, zero_point):
    if math.isnan(zero_point):
        return
    for k in range(len(star_of)):
        s = star_of[k]
        if s >= 0 and abs(magnitude[s] - instrumental[k] - zero_point) > ODD_MAG:
            star_of[k] = -1


@kernel
def settle(
    R, P, s_xy, s_z, u, sigma, instrumental, a, magnitude, gate, zero_point, star_of, chi2_of
):
    """Match, refine, match again until nothing changes; return the number of matches (compiled).

    Starts at R with an error of s_xy across and s_z about the boresight [rad]; R is moved in
    place, P gets its covariance, star_of and chi2_of the matches. 0: no attitude.
    """
    n = len(u)
    v = np.empty((len(a), 3))
    radius = np.empty(n)
    before = np.full(n, -2, np.int64)
    for step in range(8):
        turn_stars(R, a, v)
        for k in range(n):
            wide = 0.0
            if step == 0:
                off2 = u[k, 0] * u[k, 0] + u[k, 1] * u[k, 1]
                wide = s_xy * s_xy + s_z * s_z * off2
            elif step == 1:  # the first attitude may rest on a wrong match
                wide = 2.0 * sigma[k] * sigma[k]
            radius[k] = gate * math.sqrt(sigma[k] * sigma[k] + wide)
        match_stars(u, sigma, v, radius, star_of, chi2_of, step > 1)
        _drop_odd(star_of, instrumental, magnitude, zero_point)
        same, matches = True, 0
        for k in range(n):
            same = same and star_of[k] == before[k]
            before[k] = star_of[k]
            matches += star_of[k] >= 0
        if matches < 2:
            return 0
        if same and step > 2:
            return matches
        if not refine_attitude(R, u, sigma, a, star_of, P):
            return 0
    return matches


@kernel
def _nudge(R, u, k, a, s):
    """Turn R by the smallest rotation that puts star s on centroid k."""
    x = R[0, 0] * a[s, 0] + R[0, 1] * a[s, 1] + R[0, 2] * a[s, 2]
    y = R[1, 0] * a[s, 0] + R[1, 1] * a[s, 1] + R[1, 2] * a[s, 2]
    z = R[2, 0] * a[s, 0] + R[2, 1] * a[s, 1] + R[2, 2] * a[s, 2]
    cx, cy, cz = y * u[k, 2] - z * u[k, 1], z * u[k, 0] - x * u[k, 2], x * u[k, 1] - y * u[k, 0]
    sine = math.sqrt(cx * cx + cy * cy + cz * cz)
    if sine > 0.0:
        f = math.asin(min(sine, 1.0)) / sine
        turn(R, f * cx, f * cy, f * cz)


@kernel
def best_nudge(R0, s_xy, s_z, u, sigma, a, gate, n_tried, R):
    """Write to R the attitude near R0, moved so that one star falls on one centroid, that
    brings most other stars onto centroids (compiled).

    For predictions with an error wider than the stars are apart: their pattern, shifted as
    a whole, decides. The first n_tried centroids (brightest first) are tried.
    """
    n, m = len(u), len(a)
    v, w, trial = np.empty((m, 3)), np.empty((m, 3)), np.empty((3, 3))
    turn_stars(R0, a, v)
    best = 0.0
    copy_matrix(R0, R)
    for i in range(min(n, n_tried)):
        off2 = u[i, 0] * u[i, 0] + u[i, 1] * u[i, 1]
        reach2 = gate * gate * (s_xy * s_xy + s_z * s_z * off2 + sigma[i] * sigma[i])
        for s in range(m):
            dx, dy = v[s, 0] - u[i, 0], v[s, 1] - u[i, 1]
            if dx * dx + dy * dy > reach2 or v[s, 2] <= 0.0:
                continue
            copy_matrix(R0, trial)
            _nudge(trial, u, i, a, s)
            turn_stars(trial, a, w)
            hits = 0.0
            for k in range(n):
                ex, ey = u[k, 0] - u[i, 0], u[k, 1] - u[i, 1]
                lever2 = s_z * s_z * (ex * ex + ey * ey)
                r2 = 6.0 * (sigma[k] * sigma[k] + sigma[i] * sigma[i] + lever2)
                nearest = r2
                for t in range(m):
                    dx, dy = w[t, 0] - u[k, 0], w[t, 1] - u[k, 1]
                    nearest = min(nearest, dx * dx + dy * dy)
                hits += 1.0 - nearest / r2
            if hits > best:
                best = hits
                copy_matrix(trial, R)


@kernel
def solve_predicted(
    R0,
    P0,
    lost,
    u,
    sigma,
    instrumental,
    a,
    magnitude,
    box,
    gate,
    log_density,
    zero_point,
    spread,
    enough,
    R,
    P,
    star_of,
    chi2_of,
):
    """Identify a frame whose attitude is nearly known; return its log evidence (compiled).

    Parameters
    ----------
    R0, P0 : (3, 3), (3, 3)
        Predicted attitude (sensor from ICRS) and its covariance about the sensor axes [rad^2].
    lost : bool
        The attitude was searched over the whole sky: then P0 only says where to look, and the
        evidence is charged with every attitude there is.
    u, sigma, instrumental : (n, 3), (n,), (n,)
        Centroids, brightest first.
    a, magnitude : (m, 3), (m,)
        Apparent directions (ICRS axes) and magnitudes of the stars around the field.
    enough : float
        Log evidence with which to stop trying.
    R, P, star_of, chi2_of : out
        Attitude, covariance, matches; of no use where the evidence is -1e9.
    """
    s_xy, s_z = math.sqrt(0.5 * (P0[0, 0] + P0[1, 1])), math.sqrt(P0[2, 2])
    v = np.empty((len(a), 3))
    turn_stars(R0, a, v)
    in_view = count_in_view(v, box)
    area = (box[1] - box[0]) * (box[3] - box[2])
    best = -1e9
    Rt, Pt = np.empty((3, 3)), np.empty((3, 3))
    star_t, chi2_t = np.empty(len(u), np.int64), np.zeros(len(u))
    for way in range(2):
        copy_matrix(R0, Rt)
        if way == 1:
            best_nudge(R0, s_xy, s_z, u, sigma, a, gate, N_NUDGED, Rt)
        matches = settle(
            Rt,
            Pt,
            s_xy if way == 0 else 2.0 * sigma[0],
            s_z,
            u,
            sigma,
            instrumental,
            a,
            magnitude,
            gate,
            zero_point,
            star_t,
            chi2_t,
        )
        if matches >= 3:
            evidence, _ = match_evidence(
                star_t,
                chi2_t,
                sigma,
                instrumental,
                magnitude,
                log_density,
                zero_point,
                spread,
                in_view,
                area,
            )
            evidence += choice_lost(Pt) if lost else choice_predicted(Pt, P0, Rt, R0)
            if evidence > best:
                best = evidence
                copy_matrix(Rt, R)
                copy_matrix(Pt, P)
                for k in range(len(u)):
                    star_of[k], chi2_of[k] = star_t[k], chi2_t[k]
        if best > enough or lost:
            break
    return best
