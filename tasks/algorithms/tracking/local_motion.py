"""Local motion: the direction of an object at a time, from its detections around that time.

A polynomial is fitted to the directions in a window around the time. Its value there is a weighted
mean of the detections, ``sum c_k d_k`` with ``sum c_k = 1``. So covariances of the detections
propagate exactly, both independent ones and one that all share.
"""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Integers
from epipole.tasks.algorithms.geometry.covariances import traces
from epipole.tasks.algorithms.geometry.directions import lengths
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.symmetric_matrices import invert_symmetric
from epipole.tasks.algorithms.tracking.sky_filter import BEND_SHARE, acceleration, jerk

BIAS_SHARE = 0.25  # maximum error by the neglected third derivative, in sigmas of a detection


class _Queries(NamedTuple):
    """The arguments of `directions_at` that say which directions are computed.

    first, last : (q,) int64, the rows of the detections that each query may use, first:last
    at : (q,) float, times [s]
    unknown_rate, max_half : [rad/s], [s]
    """

    first: Integers
    last: Integers
    at: Array
    unknown_rate: float
    max_half: float


class _MotionDetections(NamedTuple):
    """Detections.

    t, u : (n,), (n, 3) float, times [s] and unit vectors, ICRS
    noise, bias : (n, 3, 3) float, errors [rad^2], independent and shared
    noise_trace, bias_trace : (n,) float, their traces [rad^2]
    """

    t: Array
    u: Array
    noise: Array
    bias: Array
    noise_trace: Array
    bias_trace: Array


class _MotionFits(NamedTuple):
    """What `directions_at` returns, as in `LocalMotion`, but u is not yet normalised."""

    u: Array
    w: Array
    noise: Array
    bias: Array
    fitted: Integers
    moments: Array
    unmodelled: Array


class LocalMotion(NamedTuple):
    """Directions at the times of queries.

    u : (q, 3) float
        Unit vectors.
    w : (q, 3) float
        Rates of change [rad/s].
    cov_noise, cov_bias : (q, 3, 3) float
        Propagated errors [rad^2]; `cov_noise` includes `unmodelled`.
    fitted : (q, 2) int
        The detections that were fitted: ``fitted[k, 0]:fitted[k, 1]``.
    moments : (q, 3) float
        Weighted means of (time minus that of the query)^1, ^2, ^3 [s, s^2, s^3] of the detections:
        u differs from the true direction by these times its derivatives, over 1, 2 and 6.
    unmodelled : (q,) float
        Variance per axis of the part of these differences that the fit neglects [rad^2].
    """

    u: Array
    w: Array
    cov_noise: Array
    cov_bias: Array
    fitted: Integers
    moments: Array
    unmodelled: Array


@kernel
def _half_width(rate, sigma, max_half):
    """Return half the window [s] in which the neglected cubic term stays below the noise.

    `rate` [rad/s], `sigma` [rad] of a detection, `max_half` [s] the largest half-width.
    """
    return min(max_half, (6 * BIAS_SHARE * sigma / jerk(rate)) ** (1 / 3))


@kernel
def _coefficients(t, weight, scale, curvature_prior, value, slope):
    """Fill the coefficients of the polynomial's value and slope at t = 0; return the value's
    variance for detections of variance 1 / weight, with the prior's part.

    t (n,) [s], from the query on, and `weight` (n,) [1/rad^2] are of the detections; `value` (n,)
    and `slope` (n,) [1/s] are written; `scale` is in [s], the variance in [rad^2].
    `curvature_prior` is the weight of a zero second derivative, in the units of `weight` and of
    time over `scale`. It decides the curvature where the detections do not.
    """
    S = np.zeros((3, 3))
    for k in range(len(t)):
        x = t[k] / scale
        h0, h1, h2 = 1.0, x, 0.5 * x * x
        S[0, 0] += weight[k] * h0
        S[0, 1] += weight[k] * h1
        S[0, 2] += weight[k] * h2
        S[1, 1] += weight[k] * h1 * h1
        S[1, 2] += weight[k] * h1 * h2
        S[2, 2] += weight[k] * h2 * h2
    S[2, 2] += curvature_prior
    inverse = np.full((3, 3), np.nan)
    invert_symmetric(S, inverse)
    v0, v1, v2 = inverse[0]
    s0, s1, s2 = inverse[1]
    for k in range(len(t)):
        x = t[k] / scale
        value[k] = weight[k] * (v0 + v1 * x + 0.5 * v2 * x * x)
        slope[k] = weight[k] * (s0 + s1 * x + 0.5 * s2 * x * x) / scale
    return v0


@kernel
def detections_about(t, first, last, at, half):
    """Return the range of rows within `half` [s] of the time `at`, or the three nearest if fewer.

    t (n,) are times [s] in order; only rows first:last count.
    """
    lo = first + np.searchsorted(t[first:last], at - half)
    hi = first + np.searchsorted(t[first:last], at + half, side="right")
    while hi - lo < min(3, last - first):
        if hi == last or (lo > first and at - t[lo - 1] <= t[hi] - at):
            lo -= 1
        else:
            hi += 1
    return lo, hi


@kernel
def _window(t, u, first, last, at, sigma, max_half):
    """Return the part of first:last that is fitted, the rate [rad/s] and the half-width [s].

    t (n,) [s] and u (n, 3) are times and directions of the detections, `at` [s] is the time of the
    query, `sigma` [rad] the error of a detection. Three detections are kept, however slow the
    sensor or fast the object. The prior covers the curvature, and a window beyond the half-width
    adds to the error.
    """
    lo, hi = detections_about(t, first, last, at, max_half)
    rate = 0.0
    if hi - lo > 1:
        chord = 0.0
        for a in range(3):
            chord += (u[hi - 1, a] - u[lo, a]) ** 2
        rate = np.sqrt(chord) / (t[hi - 1] - t[lo])
    half = _half_width(rate, sigma, max_half)
    lo, hi = detections_about(t, lo, hi, at, half)
    return lo, hi, rate, half


@kernel
def _nearest(t, first, last, at):
    """Return the row of first:last whose time t (n,) [s] is nearest to `at`."""
    nearest = first + np.searchsorted(t[first:last], at)
    if nearest == last or (nearest > first and at - t[nearest - 1] <= t[nearest] - at):
        nearest -= 1
    return nearest


@kernel
def _fit(detections, lo, hi, at, rate, half, unknown_rate):
    """Return the coefficients of value and slope at a time, and the variance that neither noise nor
    bias explains.

    The coefficients are those of the detections lo:hi, (hi - lo,) and (hi - lo,) [1/s], the
    variance is per axis [rad^2]. `at` and `half` are in [s], `rate` and unknown_rate in [rad/s].
    """
    n = hi - lo
    tau, weight = detections.t[lo:hi] - at, np.empty(n)
    smallest = np.inf
    for k in range(lo, hi):
        smallest = min(smallest, detections.bias_trace[k])
    for k in range(n):
        # The bias that all share does not change the weights; what exceeds it does.
        more = detections.bias_trace[lo + k] - smallest
        weight[k] = 2.0 / (detections.noise_trace[lo + k] + more)
    value, slope = np.empty(n), np.empty(n)
    if n == 1:
        value[0], slope[0] = 1.0, 0.0
        unmodelled = (unknown_rate * tau[0]) ** 2
    else:
        scale = max(np.max(np.abs(tau)), 1e-9)
        prior = 1.0 / (BEND_SHARE * acceleration(rate) * scale * scale) ** 2
        unmodelled = _coefficients(tau, weight, scale, prior, value, slope)
        if scale > half:
            unmodelled += (jerk(rate) * scale**3 / 6) ** 2
        for k in range(n):
            unmodelled -= value[k] * value[k] / weight[k]
    return value, slope, unmodelled


@kernel
def _enter_errors(q, lo, value, unmodelled, detections, fits):
    """Write the propagated errors of query q, fitted to the detections from `lo` on.

    `value` (k,) are the coefficients of the detections, `unmodelled` [rad^2] is from `_fit`. Writes
    row q of `noise` and `bias` of `fits`.
    """
    noise, bias = detections.noise, detections.bias
    # One error, larger in some frames than in others (0 where stars gave the attitude): it
    # adds up with its signs, and its square is never negative.
    amplitude, total = 0.0, 0.0
    for k in range(len(value)):
        square = detections.bias_trace[lo + k]
        if square > 0.0:
            amplitude += value[k] * np.sqrt(square)
            total += abs(value[k]) * square
    share = amplitude * amplitude / total if total > 0.0 else 0.0
    for a in range(3):
        for b in range(a, 3):
            independent, shared = 0.0, 0.0
            for k in range(len(value)):
                independent += value[k] * value[k] * noise[lo + k, a, b]
            if share > 0.0:
                for k in range(len(value)):
                    shared += abs(value[k]) * bias[lo + k, a, b]
            independent += max(unmodelled, 0.0) if a == b else 0.0
            fits.noise[q, a, b] = fits.noise[q, b, a] = independent
            fits.bias[q, a, b] = fits.bias[q, b, a] = share * shared


@kernel
def _evaluate(queries, detections, fits):
    """Write to `fits` the direction and rate of a tracklet at each time of `queries`.

    `detections` are those of all tracklets; each query names the rows of one.
    """
    t, u = detections.t, detections.u
    for q in range(len(queries.at)):
        first, last, at = queries.first[q], queries.last[q], queries.at[q]
        nearest = _nearest(t, first, last, at)
        sigma = np.sqrt(detections.noise_trace[nearest] / 2)
        lo, hi, rate, half = _window(t, u, first, last, at, sigma, queries.max_half)
        fits.fitted[q, 0], fits.fitted[q, 1] = lo, hi
        value, slope, unmodelled = _fit(detections, lo, hi, at, rate, half, queries.unknown_rate)
        for a in range(3):
            mean, moving = 0.0, 0.0
            for k in range(hi - lo):
                # Differences from the nearest detection lose no digits.
                mean += value[k] * (u[lo + k, a] - u[nearest, a])
                moving += slope[k] * (u[lo + k, a] - u[nearest, a])
            fits.u[q, a] = u[nearest, a] + mean
            fits.w[q, a] = moving
        for k in range(hi - lo):
            tau = t[lo + k] - at
            fits.moments[q, 0] += value[k] * tau
            fits.moments[q, 1] += value[k] * tau * tau
            fits.moments[q, 2] += value[k] * tau * tau * tau
        fits.unmodelled[q] = max(unmodelled, 0.0)
        _enter_errors(q, lo, value, unmodelled, detections, fits)


def directions_at(
    first: Integers,
    last: Integers,
    at_s: Array,
    unknown_rate_rad_s: float,
    time_s: Array,
    u_icrs: Array,
    cov_noise: Array,
    cov_bias: Array,
    max_half_s: float,
) -> LocalMotion:
    """Return directions at given times, their rates and covariances.

    Parameters
    ----------
    first, last : (q,) int
        Query q may use the detections ``first[q]:last[q]``, one tracklet's, in time order.
    at_s : (q,) float
        Times of the queries [s].
    unknown_rate_rad_s
        1-sigma rate per axis of an object with a single detection [rad/s].
    time_s, u_icrs : (n,), (n, 3) float
        Detections: times [s] and unit vectors.
    cov_noise, cov_bias : (n, 3, 3) float
        Their errors [rad^2], in ICRS components: independent from frame to frame, and shared
        by all frames.
    max_half_s
        Maximum half-width of a window [s].

    Notes
    -----
    A quadratic is fitted. Its second derivative has a weak prior (the acceleration that the rate
    allows), so that two detections suffice. The window shrinks for fast objects until the
    neglected third derivative is a fraction of the noise. The curvature of the sphere over the
    window, which is neglected too, is of the same order.
    """
    q = len(at_s)
    queries = _Queries(
        np.ascontiguousarray(first, np.int64),
        np.ascontiguousarray(last, np.int64),
        np.ascontiguousarray(at_s, float),
        float(unknown_rate_rad_s),
        float(max_half_s),
    )
    detections = _MotionDetections(
        *(np.ascontiguousarray(a, float) for a in (time_s, u_icrs, cov_noise, cov_bias)),
        *(traces(cov) for cov in (cov_noise, cov_bias)),
    )
    fits = _MotionFits(
        np.empty((q, 3)), np.empty((q, 3)), np.empty((q, 3, 3)), np.empty((q, 3, 3)),
        np.empty((q, 2), np.int64), np.zeros((q, 3)), np.empty(q),
    )  # fmt: skip
    _evaluate(queries, detections, fits)
    u = fits.u / lengths(fits.u)[:, None]
    return LocalMotion(u, fits.w, fits.noise, fits.bias, fits.fitted, fits.moments, fits.unmodelled)
