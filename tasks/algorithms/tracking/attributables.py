"""Attributables: the direction of a tracklet at its middle, its rate, and their covariance.

An attributable is the information on an orbit that one sensor gets within seconds (Tommei, Milani
and Rossi 2007, "Orbit determination of space debris: admissible regions", Celestial Mechanics 97,
289). The range and its rate remain unknown.

A polynomial of fifth order in time is fitted to the detections about the middle, along the motion
and across it. Its second and higher derivatives have priors: zero, with the scatter of orbits with
this rate. So the detections decide the order of the fit: a derivative that they do not determine
adds its scatter to the errors.
"""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Indices
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.symmetric_matrices import factor, solve_factored
from epipole.tasks.algorithms.tracking.local_motion import detections_about
from epipole.tasks.algorithms.tracking.sky_filter import (
    BEND_SHARE,
    FAR_RAD_S2,
    LOW_ORBIT_S,
    acceleration,
    approach,
    jerk,
)

ORDER = 5  # of the polynomial
N_ROWS = 2 * (ORDER + 1)
MAX_HALF_S = 90.0  # detections farther from the middle are not fitted
MAX_TURN = 0.5  # maximum time from the middle times the relative range rate
MAX_ROUNDS = 8  # each doubles how fast the range may change
MAX_SIGMA = 1.0  # of chi-square: a worse fit means that the range changes faster than usual
SMALL_RAD = 1e-5  # an angle below this equals its sine


class Attributables(NamedTuple):
    """Directions and rates of t tracklets.

    u : (t, 3) float
        Directions, ICRS.
    w : (t, 3) float
        Their rates [rad/s], at right angles to them.
    cov : (t, 4, 4) float
        Covariance of (east, north, east rate, north rate) [rad, rad/s]; NaN without detections.
    """

    u: Array
    w: Array
    cov: Array


def attributables(
    rows: Indices, at_s: Array, time_s: Array, u_icrs: Array, cov_noise: Array
) -> Attributables:
    """Return the attributables of tracklets.

    Parameters
    ----------
    rows : (t, 2) int
        The detections of tracklet k are ``rows[k, 0]:rows[k, 1]``, in order of time.
    at_s : (t,) float
        The epochs of the attributables [s], usually the middles of the tracklets.
    time_s, u_icrs : (n,), (n, 3) float
        Detections: times [s] and unit vectors without aberration, ICRS.
    cov_noise : (n, 3, 3) float
        Their errors [rad^2], ICRS, independent from frame to frame.
    """
    n = len(at_s)
    out = Attributables(np.zeros((n, 3)), np.zeros((n, 3)), np.full((n, 4, 4), np.nan))
    _fit_all(
        np.ascontiguousarray(rows, np.int64),
        *(np.ascontiguousarray(a, float) for a in (at_s, time_s, u_icrs, cov_noise)),
        out,
    )
    return out


@kernel
def _fit_all(rows, at_s, time_s, u, noise, out):
    """Write the attributables of all tracklets to `out`; arguments as in `attributables`.

    u and `noise` are its u_icrs and cov_noise.
    """
    frame, derivatives = np.empty((3, 3)), np.empty((ORDER + 1, 2))
    N, rhs = np.empty((N_ROWS, N_ROWS)), np.empty(N_ROWS)
    for k in range(len(at_s)):
        lo, hi = detections_about(time_s, rows[k, 0], rows[k, 1], at_s[k], MAX_HALF_S)
        if lo == hi:
            continue
        scale, widening = 1.0, 1.0
        for _ in range(MAX_ROUNDS):
            rate = _frame(time_s, u, lo, hi, at_s[k], frame)
            faster = widening * (rate + LOW_ORBIT_S + 2 * approach(rate))
            lo, hi = detections_about(time_s, lo, hi, at_s[k], MAX_TURN / faster)
            chi2 = 0.0
            for _ in range(2):  # again about the direction of the first fit
                scale, chi2 = _solve(
                    time_s, u, noise, lo, hi, at_s[k], rate, widening, frame, N, rhs
                )
                for m in range(ORDER + 1):
                    for a in range(2):
                        derivatives[m, a] = rhs[2 * m + a] / scale**m
                _turn(frame, derivatives[0])
            dof = 2 * (hi - lo) - 4
            if dof <= 0 or chi2 < dof + MAX_SIGMA * np.sqrt(2.0 * dof):
                break
            widening *= 2.0
        _write(frame, derivatives, N, scale, out, k)


@kernel
def _frame(t, u, lo, hi, at, frame):
    """Write axes along the motion, across it, and towards the detection nearest to `at` [s].

    The axes are the rows of `frame` (3, 3), ICRS. The detections are lo:hi of their times t (n,)
    [s] and directions u (n, 3), ICRS. Returns the rate [rad/s] from the first to the last of them,
    0 with one.
    """
    nearest = lo
    for k in range(lo, hi):
        if abs(t[k] - at) < abs(t[nearest] - at):
            nearest = k
    frame[2] = u[nearest]
    along = u[hi - 1] - u[lo]
    chord = np.sqrt(np.sum(along**2))
    if not chord > 0.0:
        along[:] = 0.0
        along[np.argmin(np.abs(frame[2]))] = 1.0
    along = along - np.sum(along * frame[2]) * frame[2]
    frame[0] = along / np.sqrt(np.sum(along**2))
    frame[1] = np.cross(frame[2], frame[0])
    return chord / (t[hi - 1] - t[lo]) if hi - lo > 1 else 0.0


@kernel
def _offset(u, frame, xy, J):
    """Write the offset xy (2,) of a direction from the frame's: angle times direction.

    A great circle through the middle is a straight line, and uniform motion on it is uniform.
    J (2, 3) receives the derivatives of the offset by the direction.
    """
    a, b, c = np.sum(u * frame[0]), np.sum(u * frame[1]), np.sum(u * frame[2])
    s2 = a * a + b * b
    s = np.sqrt(s2)
    near = s < SMALL_RAD  # the angle over its sine is 1 there
    stretch = 1.0 if near else np.arctan2(s, c) / s
    xy[0], xy[1] = stretch * a, stretch * b
    for k in range(3):
        inward = a * frame[0, k] + b * frame[1, k]
        rest = 0.0 if near else (c - stretch) * inward / s2 - frame[2, k]
        J[0, k] = stretch * frame[0, k] + a * rest
        J[1, k] = stretch * frame[1, k] + b * rest


@kernel
def _solve(t, u, noise, lo, hi, at, rate, widening, frame, N, rhs):
    """Solve for the scaled derivatives at the time `at` [s]; N becomes its factor.

    The detections are lo:hi of their times t (n,) [s], directions u (n, 3), ICRS, and errors
    `noise` (n, 3, 3) [rad^2]. `frame` (3, 3) is from `_frame`; `rate` [rad/s] and `widening` set
    the priors. N (N_ROWS, N_ROWS) is the normal matrix. `rhs` (N_ROWS,) [rad] receives the
    derivatives of order m times the m-th power of the scale: along the motion in element 2 m,
    across it in 2 m + 1.

    Returns the scale [s], and chi-square with the priors.
    """
    N[:], rhs[:] = 0.0, 0.0
    scale, chi2 = 1e-3, 0.0
    for k in range(lo, hi):
        scale = max(scale, abs(t[k] - at))
    xy, J, W, h = np.empty(2), np.empty((2, 3)), np.empty((2, 2)), np.empty(ORDER + 1)
    for k in range(lo, hi):
        _offset(u[k], frame, xy, J)
        C = J @ noise[k] @ J.T
        det = C[0, 0] * C[1, 1] - C[0, 1] * C[0, 1]
        W[0, 0], W[1, 1], W[0, 1] = C[1, 1] / det, C[0, 0] / det, -C[0, 1] / det
        W[1, 0] = W[0, 1]
        x = (t[k] - at) / scale
        h[0] = 1.0
        for m in range(1, ORDER + 1):
            h[m] = h[m - 1] * x / m
        chi2 += W[0, 0] * xy[0] ** 2 + 2 * W[0, 1] * xy[0] * xy[1] + W[1, 1] * xy[1] ** 2
        for m in range(ORDER + 1):
            for a in range(2):
                for b in range(2):
                    rhs[2 * m + a] += h[m] * W[a, b] * xy[b]
                    for j in range(m + 1):
                        N[2 * m + a, 2 * j + b] += h[m] * h[j] * W[a, b]
    _add_prior(rate, widening, scale, N)
    rhs_before = rhs.copy()
    factor(N, rhs)
    return scale, chi2 - np.sum(rhs_before * rhs)


@kernel
def _add_prior(rate, widening, scale, N):
    """Add the priors of the derivatives from the second one on, along and across the motion.

    N (N_ROWS, N_ROWS) is that of `_solve`, `rate` in [rad/s], `scale` in [s]. Without gravity a
    path is a great circle: nothing bends it across.
    """
    faster = widening * (rate + LOW_ORBIT_S + 2 * approach(rate))
    along, across = widening * acceleration(rate), widening * (LOW_ORBIT_S * rate + FAR_RAD_S2)
    for m in range(2, ORDER + 1):
        N[2 * m, 2 * m] += 1.0 / (BEND_SHARE * along * scale**m) ** 2
        N[2 * m + 1, 2 * m + 1] += 1.0 / (BEND_SHARE * across * scale**m) ** 2
        along = widening**2 * jerk(rate) if m == 2 else along * m * faster
        across *= m * faster


@kernel
def _turn(frame, offset):
    """Turn the frame (3, 3) in place so that it looks along an offset (2,) of it [rad]."""
    u = frame[2] + offset[0] * frame[0] + offset[1] * frame[1]
    frame[2] = u / np.sqrt(np.sum(u**2))
    along = frame[0] - np.sum(frame[0] * frame[2]) * frame[2]
    frame[0] = along / np.sqrt(np.sum(along**2))
    frame[1] = np.cross(frame[2], frame[0])


@kernel
def _write(frame, derivatives, L, scale, out, k):
    """Write direction, rate and covariance, from the frame's axes to east and north.

    `frame` (3, 3) has the axes as rows, ICRS; `derivatives` (ORDER + 1, 2) are along and across
    [rad, rad/s ...]; L (N_ROWS, N_ROWS) and `scale` [s] are from `_solve`. Writes row k of `out`,
    the `Attributables`.
    """
    out.u[k] = frame[2]
    out.w[k] = derivatives[1, 0] * frame[0] + derivatives[1, 1] * frame[1]
    x, y = frame[2, 0], frame[2, 1]
    level, east = np.sqrt(x * x + y * y), np.zeros(3)
    if level > 0.0:
        east[0], east[1] = -y / level, x / level
    else:  # at a pole, as in `east_north`
        east[1] = np.copysign(1.0, x)
    north = np.cross(frame[2], east)
    turn = np.zeros((4, 4))
    for a in range(2):
        turn[0, a] = turn[2, 2 + a] = np.sum(east * frame[a])
        turn[1, a] = turn[3, 2 + a] = np.sum(north * frame[a])
    cov, column = np.empty((4, 4)), np.empty(N_ROWS)
    for a in range(4):
        column[:] = 0.0
        column[a] = 1.0
        solve_factored(L, column)
        for b in range(4):
            cov[a, b] = column[b] / scale ** (a // 2 + b // 2)
    out.cov[k] = turn @ cov @ turn.T
