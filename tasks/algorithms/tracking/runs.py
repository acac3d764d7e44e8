"""Tracking: detections of one sensor, frame after frame, become runs of one object.

Everything happens on the sky, after attitude, so that the sensor's own turning is gone. Each
frame the tracks that live claim the detections they fit, the nearest in sigmas first; what is
left may begin new ones.
"""

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.tracking.frame_grid import fill_grid, make_grids, window
from epipole.tasks.algorithms.tracking.initiation import NONE, new_tracks
from epipole.tasks.algorithms.tracking.sky_filter import (
    advance,
    begin,
    correct,
    distance2,
    grow,
    rate_of,
)

Array = npt.NDArray[np.float64]

SLACK = 4  # frames beyond the fewest detections in which a track must begin
DEEPEST = 9  # the same where strays are so dense that it takes more detections


@kernel
def _state_of(members, frame_of, times, directions, variances, u, w, P):
    """Filter a new track's detections, newest first in `members`, into its state at the newest."""
    last = len(members) - 1
    one, two = members[last], members[last - 1]
    begin(
        directions[one], times[frame_of[one]], variances[one],
        directions[two], times[frame_of[two]], variances[two], u, w, P,
    )  # fmt: skip
    for m in range(last - 2, -1, -1):
        dt = times[frame_of[members[m]]] - times[frame_of[members[m + 1]]]
        grow(P, rate_of(w), dt)
        advance(u, w, dt)
        correct(u, w, P, directions[members[m]], variances[members[m]])


@kernel
def _candidates(live, U, P, directions, variances, largest, grids, slot, gate2):
    """Return all (track, detection, chi-square) within the gate."""
    start, items = grids[2], grids[3]
    room, count = 4 * len(live) + 16, 0
    who, which, chi2 = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room)
    for m in live:
        reach = np.sqrt(gate2 * (P[m, 0] + largest))
        x_from, x_to, y_from, y_to, side = window(grids, slot, U[m], reach)
        if x_from > x_to:
            continue
        for y in range(y_from, y_to + 1):
            for k in range(start[slot, y * side + x_from], start[slot, y * side + x_to + 1]):
                j = items[slot, k]
                miss = distance2(directions[j], U[m]) / (P[m, 0] + variances[j])
                if miss >= gate2:
                    continue
                if count == room:
                    who = np.concatenate((who, np.empty(room, np.int64)))
                    which = np.concatenate((which, np.empty(room, np.int64)))
                    chi2 = np.concatenate((chi2, np.empty(room)))
                    room *= 2
                who[count], which[count], chi2[count] = m, j, miss
                count += 1
    return who[:count], which[:count], chi2[:count]


@kernel
def _claim(
    live, U, W, P, at, missed, time, directions, variances, largest, grids, slot, track, gate2
):
    """Move the live tracks to a frame and give each detection to the track it fits best."""
    for m in live:
        dt = time - at[m]
        grow(P[m], rate_of(W[m]), dt)
        advance(U[m], W[m], dt)
        at[m] = time
        missed[m] += 1
    who, which, chi2 = _candidates(live, U, P, directions, variances, largest, grids, slot, gate2)
    for p in np.argsort(chi2, kind="mergesort"):
        m, j = who[p], which[p]
        if missed[m] == 0 or track[j] != NONE:
            continue
        missed[m] = 0
        track[j] = m
        correct(U[m], W[m], P[m], directions[j], variances[j])


@kernel
def _follow(
    times, offsets, frame_of, most, directions, variances, max_rate, max_coast, max_missed, need,
    gate2, field_sr, enough,
):  # fmt: skip
    n, n_frames = len(directions), len(times)
    track = np.full(n, NONE)
    room = n // max(need, 1) + 1
    U, W, P = np.empty((room, 3)), np.empty((room, 3)), np.empty((room, 3))
    at, missed = np.empty(room), np.zeros(room, np.int64)
    live = np.empty(0, np.int64)
    # Not the literal 0, for which what it is given to would be compiled once more.
    n_tracks, deepest = len(live), need + DEEPEST
    n_slots = deepest + 1
    grids = make_grids(n_slots, most)
    smallest, largest = np.full(n_slots, np.inf), np.zeros(n_slots)
    for f in range(n_frames):
        lo, hi, slot = offsets[f], offsets[f + 1], f % n_slots
        fill_grid(grids, slot, directions, lo, hi)
        smallest[slot] = variances[lo:hi].min() if hi > lo else np.inf
        largest[slot] = variances[lo:hi].max() if hi > lo else 0.0
        # A track that was missed too often has ended.
        live = live[(missed[live] <= max_missed) & (times[f] - at[live] <= max_coast)]
        _claim(
            live, U, W, P, at, missed, times[f], directions, variances, largest[slot], grids,
            slot, track, gate2,
        )  # fmt: skip
        begun, held, chains = new_tracks(
            f, need + SLACK, deepest, times, offsets, directions, variances, smallest, largest,
            grids, n_slots, track, n_tracks, max_rate, max_coast, need, gate2, field_sr, enough,
        )  # fmt: skip
        for row in begun:
            _state_of(
                chains[row, : held[row]], frame_of, times, directions, variances, U[n_tracks],
                W[n_tracks], P[n_tracks],
            )  # fmt: skip
            at[n_tracks], missed[n_tracks] = times[f], 0
            n_tracks += 1
        live = np.concatenate((live, np.arange(n_tracks - len(begun), n_tracks)))
    return track


def follow_detections(
    time_s: Array,
    offsets: npt.NDArray[np.int64],
    u_icrs: Array,
    sigma_rad: Array,
    *,
    max_rate_rad_s: float,
    max_coast_s: float,
    max_missed: int,
    min_detections: int,
    gate_sigma: float,
    field_sr: float,
    false_alarm: float,
) -> npt.NDArray[np.int64]:
    """Return the track number of every detection, -1 where it belongs to none.

    Parameters
    ----------
    time_s : (f,) float
        Frame times [s], increasing, of one sensor.
    offsets : (f + 1,) int
        Frame k has the detections ``offsets[k]:offsets[k + 1]``.
    u_icrs : (n, 3) float
        Directions, unit vectors.
    sigma_rad : (n,) float
        1-sigma error an axis, of centroid and attitude together [rad].
    max_rate_rad_s, max_coast_s
        Fastest motion looked for; longest time without a frame that a track survives.
    max_missed
        Frames in a row in which a track may miss its object.
    min_detections
        Fewest detections that begin a track (at least 2), within `SLACK` frames more.
    gate_sigma
        A detection continues a track within this many standard deviations.
    field_sr
        Solid angle of the field: with it, how dense the detections are.
    false_alarm
        Accepted number of tracks a frame that are made of strays. Where strays are dense, or
        an object is fast, it takes more detections to begin a track.

    Returns
    -------
    (n,) int
        Tracks count from 0 by the frame in which they were confirmed.
    """
    n_in = np.diff(offsets)
    return _follow(
        np.ascontiguousarray(time_s, float),
        np.ascontiguousarray(offsets, np.int64),
        np.repeat(np.arange(len(n_in)), n_in),
        int(n_in.max(initial=0)),
        np.ascontiguousarray(u_icrs, float),
        np.ascontiguousarray(sigma_rad, float) ** 2,
        float(max_rate_rad_s),
        float(max_coast_s),
        int(max_missed),
        int(max(min_detections, 2)),
        float(gate_sigma) ** 2,
        float(field_sr),
        -float(np.log(false_alarm)),
    )
