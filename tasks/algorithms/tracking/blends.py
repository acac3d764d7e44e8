"""Blends: detections that may hold the light of a second object of the same sensor.

Two images closer than about their diameter give one centroid. It lies between the two, and it
stays there while they pass: for a slow object up to half a minute. So the error is common to
all these detections, and no average removes it. The other object's tracklet has a gap there, or
it has ended or not yet begun. Its predicted direction shows which detections may be blends, and how
large their errors may be.
"""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.tasks.algorithms.geometry.covariances import traces
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.photometry import medians
from epipole.tasks.algorithms.tracking.local_motion import directions_at
from epipole.tasks.algorithms.tracking.sky_filter import BEND_SHARE, acceleration

BLEND_PX = 2.5  # separation below which two images blend, if there are too few pairs to measure it
# How that separation is measured: width of the bins, share of the expected pairs below which images
# blend, and minimum number of pairs. With half the bins, or twice the share, some separations
# in the tests come out wrong; with 50 to 200 pairs none does.
BIN_PX, RESOLVED_SHARE, MIN_PAIRS = 0.25, 0.25, 100
# Longest time over which a tracklet is predicted beyond its ends; half and double fail tests.
MAX_PREDICTED_S = 60.0
MIN_FLUX_SHARE = 0.5  # share of the usual flux below which a blend is the neighbour alone
# Minimum number of detections of each tracklet in the time of both: 1 to 6 make no difference in
# the tests; fewer than three may be false detections.
MIN_COEXISTING = 3


class TrackedDetections(NamedTuple):
    """The detections of one sensor's t tracklets, n in all, by tracklet and then by time.

    bounds : (t + 1,) int
        Tracklet k has the detections ``bounds[k]:bounds[k + 1]``.
    time_s : (n,) float
        Times of their frames [s].
    u_icrs : (n, 3) float
        Unit vectors.
    cov_noise : (n, 3, 3) float
        Independent errors [rad^2].
    flux : (n,) float
        In any unit, the same for all; NaN where unknown.
    """

    bounds: Indices
    time_s: Array
    u_icrs: Array
    cov_noise: Array
    flux: Array


class _TrackletEnds(NamedTuple):
    """Each tracklet's first (0) and last (1) detection: time, direction, rate, variance.

    The arrays are (t, 2), (t, 2, 3), (t, 2, 3), (t, 2); `fitted_s` (t,) is the time
    [s] of the detections that gave the rate, `flux` (t,) the median flux.
    """

    time: Array
    u: Array
    w: Array
    variance: Array
    fitted_s: Array
    flux: Array


def blend_variance(tracked: TrackedDetections, frame_s: Array, pixel_rad: float | Array) -> Array:
    """Return the variance per axis [rad^2] that blends may add to each detection, (n,).

    Parameters
    ----------
    frame_s : (f,) float
        Times of the sensor's frames [s], increasing; those of the detections are among them.
    pixel_rad : float or (f,) float
        Angle of a pixel [rad], of all frames or of each: a sensor may begin to bin its pixels.

    Notes
    -----
    With fluxes f and g, the centroid of a blend is off by the share g / (f + g) of the separation.
    Half of it is taken where a flux is unknown. This is the size of the error, taken as 1-sigma.
    """
    u = np.ascontiguousarray(tracked.u_icrs, float)
    frame_s = np.ascontiguousarray(frame_s, float)
    tracklet = np.repeat(np.arange(len(tracked.bounds) - 1), np.diff(tracked.bounds))
    alike = _with_like_pixels(tracked, u, frame_s, np.broadcast_to(pixel_rad, len(frame_s)))
    ends, out = _ends_of(tracked), np.zeros(len(tracked.time_s))
    for _ in range(2):
        # Blends are brighter. Once they are known, so are the fluxes of the objects.
        ends = ends._replace(flux=_usual_flux(tracked, out > 0))
        out[:] = 0.0
        for each in alike:
            _enter_blends(
                tracked.time_s, u, tracklet, each.by_frame, each.starts, tracked.bounds, frame_s,
                ends, each.blend_rad, out,
            )  # fmt: skip
    return out


class _LikePixels(NamedTuple):
    """The detections in frames with pixels of one size, and how near images blend there [rad].

    Frame k has the detections ``by_frame[starts[k]:starts[k + 1]]``, none if its pixels differ.
    """

    by_frame: Indices
    starts: Indices
    blend_rad: float


def _with_like_pixels(
    tracked: TrackedDetections, u: Array, frame_s: Array, pixel_rad: Array
) -> list[_LikePixels]:
    """Return the detections by the size of the pixels of their frames, pixel_rad (f,)."""
    by_time = np.argsort(tracked.time_s, kind="stable")
    pixel = pixel_rad[np.searchsorted(frame_s, tracked.time_s[by_time])]
    n_bins = 2 * round(BLEND_PX / BIN_PX)
    alike = []
    for size in np.unique(pixel).tolist():
        by_frame = by_time[pixel == size]
        starts = np.searchsorted(tracked.time_s[by_frame], np.append(frame_s, np.inf))
        pairs = _separations(u, by_frame, starts, BIN_PX * size, n_bins)
        alike.append(_LikePixels(by_frame, starts, resolved_px(pairs) * size))
    return alike


def of_neighbour(tracked: TrackedDetections, variance: Array) -> Flags:
    """Return which detections are too faint to hold their tracklet's object, (n,).

    A blend is brighter than either object. Detections that may be blends by their `variance` (n,),
    but are much fainter than the others of their tracklet, show the neighbour alone.
    """
    blended = variance > 0
    usual = np.repeat(_usual_flux(tracked, blended), np.diff(tracked.bounds))
    return np.asarray(blended & (tracked.flux < MIN_FLUX_SHARE * usual))


def resolved_px(pairs: Indices) -> float:
    """Return the separation [px] below which two images may be one centroid.

    Parameters
    ----------
    pairs : (b,) int
        Pairs of detections of a frame by their separation, in bins of `BIN_PX`.

    Notes
    -----
    Without blends, pairs are spread evenly: there are a third as many below a separation as between
    it and twice the separation.
    """
    below = np.concatenate([[0], np.cumsum(pairs)])
    for bins in range(len(pairs) // 2, 0, -1):
        expected = (below[2 * bins] - below[bins]) / 3
        if expected >= MIN_PAIRS / 3 and below[bins] < RESOLVED_SHARE * expected:
            return (bins + 1) * BIN_PX
    return BLEND_PX if below[-1] < MIN_PAIRS else BIN_PX


def _ends_of(tracked: TrackedDetections) -> _TrackletEnds:
    first, last = tracked.bounds[:-1], tracked.bounds[1:]
    t = tracked.time_s
    time = np.column_stack([t[first], t[last - 1]])
    fit = directions_at(
        np.repeat(first, 2), np.repeat(last, 2), time.ravel(), 1.0,
        t, tracked.u_icrs, tracked.cov_noise, np.zeros_like(tracked.cov_noise), MAX_PREDICTED_S / 2,
    )  # fmt: skip
    fitted_s = np.clip(time[:, 1] - time[:, 0], 1e-3, MAX_PREDICTED_S / 2)
    variance = traces(fit.cov_noise).reshape(-1, 2) / 2
    flux = np.full(len(first), np.nan)
    return _TrackletEnds(
        time, fit.u.reshape(-1, 2, 3), fit.w.reshape(-1, 2, 3), variance, fitted_s, flux
    )


def _usual_flux(tracked: TrackedDetections, blended: Flags) -> Array:
    """Return the median flux of each tracklet's unblended detections; NaN if unknown."""
    n, known = len(tracked.bounds) - 1, ~blended & np.isfinite(tracked.flux)
    tracklet = np.repeat(np.arange(n), np.diff(tracked.bounds))
    return medians(tracklet[known], tracked.flux[known], n)


@kernel
def _separations(u, by_frame, starts, width, n_bins):
    """Return the number of pairs of detections of a frame by their separation, (n_bins,).

    u (n, 3) are the directions, `width` [rad] that of a bin. Frame k has the detections
    by_frame[starts[k]:starts[k + 1]]: by_frame (n,) int, `starts` (f + 1,) int for f frames.
    """
    out = np.zeros(n_bins, np.int64)
    for f in range(len(starts) - 1):
        for q in range(starts[f], starts[f + 1]):
            i = by_frame[q]
            for r in range(q + 1, starts[f + 1]):
                j, chord2 = by_frame[r], 0.0
                for c in range(3):
                    chord2 += (u[i, c] - u[j, c]) ** 2
                if chord2 < (n_bins * width) ** 2:
                    out[int(np.sqrt(chord2) / width)] += 1
    return out


@kernel
def _enter_blends(time, u, tracklet, by_frame, starts, bounds, frame_s, ends, blend_rad, out):
    """Write the variance [rad^2] of each detection's possible blends to `out` (n,).

    `time`, u and `bounds` are the times, directions and `bounds` of `TrackedDetections`, `tracklet`
    (n,) int the tracklet of each detection, by_frame and `starts` as in `_separations`. frame_s
    (f,) [s] are the times of the frames, `ends` the `_TrackletEnds`. Images blend within blend_rad
    [rad].
    """
    p = np.empty(3)
    for b in range(len(bounds) - 1):
        k = bounds[b]
        lo = np.searchsorted(frame_s, ends.time[b, 0] - MAX_PREDICTED_S)
        hi = np.searchsorted(frame_s, ends.time[b, 1] + MAX_PREDICTED_S, side="right")
        for f in range(lo, hi):
            while k < bounds[b + 1] and time[k] < frame_s[f]:
                k += 1
            if k < bounds[b + 1] and time[k] == frame_s[f]:
                continue  # it is detected separately
            variance = _predict(time, u, bounds, ends, b, k, frame_s[f], p)
            if not variance < blend_rad * blend_rad:
                continue  # its direction is too uncertain
            # Its light is in the nearest detection, which may be its next tracklet.
            nearest = np.inf
            for q in range(starts[f], starts[f + 1]):
                nearest = min(nearest, _distance(u[by_frame[q]], p))
            farthest = min(blend_rad + np.sqrt(variance), nearest + 2 * np.sqrt(variance))
            for q in range(starts[f], starts[f + 1]):
                i = by_frame[q]
                distance_rad, a = _distance(u[i], p), tracklet[i]
                if distance_rad > farthest or not _coexist(time, bounds, ends, a, b):
                    continue
                share = ends.flux[b] / (ends.flux[a] + ends.flux[b])
                share = share if 0.0 <= share <= 1.0 else 0.5  # 0.5 for NaN
                # The blend moves the centroid towards the neighbour by the share of the separation.
                separation2 = min(
                    (distance_rad * distance_rad + variance) / max(1.0 - share, 1e-3) ** 2,
                    blend_rad * blend_rad,
                )
                size = share * share * separation2
                out[i] = max(out[i], size)


@kernel
def _distance(u, p):
    """Return the chord between two directions (3,): for small angles the angle [rad]."""
    return np.sqrt((u[0] - p[0]) ** 2 + (u[1] - p[1]) ** 2 + (u[2] - p[2]) ** 2)


@kernel
def _predict(time, u, bounds, ends, b, k, at, p):
    """Write the direction of tracklet b at a time without a detection; return its variance.

    `time` (n,) [s], u (n, 3) and `bounds` (t + 1,) are of `TrackedDetections`, `ends` the
    `_TrackletEnds`. p (3,) receives the direction at `at` [s], nearly a unit vector. The variance
    [rad^2] is per axis; `k` is the row of the next detection. Between two detections the direction
    is interpolated.
    """
    if bounds[b] < k < bounds[b + 1]:
        x = (at - time[k - 1]) / (time[k] - time[k - 1])
        for c in range(3):
            p[c] = u[k - 1, c] + x * (u[k, c] - u[k - 1, c])
        return max(ends.variance[b, 0], ends.variance[b, 1])
    e = 0 if k == bounds[b] else 1
    gap, rate = at - ends.time[b, e], 0.0
    for c in range(3):
        p[c] = ends.u[b, e, c] + gap * ends.w[b, e, c]
        rate += ends.w[b, e, c] ** 2
    bent = BEND_SHARE * acceleration(np.sqrt(rate)) * gap * gap / 2
    return ends.variance[b, e] * (1 + 2 * abs(gap) / ends.fitted_s[b]) ** 2 + bent * bent


@kernel
def _coexist(time, bounds, ends, a, b):
    """Return whether two tracklets are two objects: both have detections at the same times.

    `time` (n,) [s] and `bounds` (t + 1,) are of `TrackedDetections`, `ends` the `_TrackletEnds`.
    """
    if a == b:
        return False
    start, end = max(ends.time[a, 0], ends.time[b, 0]), min(ends.time[a, 1], ends.time[b, 1])
    for t in (a, b):
        lo = np.searchsorted(time[bounds[t] : bounds[t + 1]], start)
        hi = np.searchsorted(time[bounds[t] : bounds[t + 1]], end, side="right")
        if hi - lo < MIN_COEXISTING:
            return False
    return True
