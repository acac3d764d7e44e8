"""Tracking of one sensor: detections, frame after frame, become runs of one object.

Everything happens on the sky, with attitudes applied, so the rotation of the sensor is removed. For
each frame, `_follow` does these steps:

1. The frame's detections are sorted into a grid (`_fill_frame`).
2. Tracks with too many misses end.
3. The others are predicted, and take the detections within their gates, the smallest chi-square
   first (`_assign`).
4. Two tracks exchange detections where both together then fit better (`_exchange`).
5. Detections that are still free may begin tracks (`initiation.new_tracks`).

Where frames are so far apart that co-located objects are confused, objects that move alike are then
followed again, in a frame of reference that moves with them (`common_motion`). The free detections
of a short sequence are followed once more, with a lower limit of evidence.
"""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Indices, Integers
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.tracking.brightness import SIZE as BRIGHTNESS_SIZE
from epipole.tasks.algorithms.tracking.brightness import (
    begin_brightness,
    brightness_chi2,
    learn_brightness,
    log_flux,
)
from epipole.tasks.algorithms.tracking.common_motion import CommonMotion, common_motion
from epipole.tasks.algorithms.tracking.initiation import (
    EXTRA_DETECTIONS,
    FAINT_FRAMES,
    MAX_PAIRS,
    NONE,
    P_DETECTION,
    Detections,
    RecentFrames,
    TrackRule,
    new_tracks,
)
from epipole.tasks.algorithms.tracking.sky_filter import (
    SIZE,
    advance,
    begin,
    correct,
    distance2,
    fill_grid,
    grow,
    make_grids,
    rate_of,
    window,
)

SLACK_FRAMES = 4  # a track begins within this many frames beyond the minimum of detections
# Limit of pairs in a sequence, and the minimum of that limit per frame. In denser clutter, the
# fastest objects are not searched for.
MAX_PAIRS_OF_ALL, MIN_PAIRS = 20_000_000, 5_000
# Accepted number of false tracks in a sequence. It counts every pair of detections as a test. Most
# pairs are too fast to reach the evidence, so that 1 to 5 % of this number are measured.
FALSE_ALARM_SEQUENCE = 1.0
# Up to this number of detections, a track's motion and brightness are not well known. With 6 or 20,
# as many are mixed; without limit, right detections after a crossing are exchanged too.
YOUNG = 10
SHORT_SEQUENCE = 2  # a sequence is short up to twice the frames in which a track may begin
# A track with a precisely known motion continues through more misses than `max_missed`: up to this
# number of frames, and while fewer false detections than this are expected in its gates.
MAX_MISSED_FRAMES, MAX_STRAYS = 24, 3e-3
# With the common motion removed, objects are slower than this share of its rate, or than this rate
# [rad/s], 6 arcsec/s. Time is counted in units of the factor [s], which divides the bounds of
# acceleration by its square. From simulated geostationary objects at 10 and 30 s.
COMMON_SHARE, COMMON_RATE, COMMON_FACTOR = 0.3, 3e-5, 2.0


class _Tracks(NamedTuple):
    """States of tracks.

    u, w, bend, P : (t, 3), (t, 3), (t, 3), (t, SIZE) float, see `sky_filter`
    brightness : (t, 3) float, see `brightness`
    at, missed : (t,) float and int64, time of the state [s], and misses in a row
    strays : (t,) float, false detections expected in the gates since the last detection
    """

    u: Array
    w: Array
    bend: Array
    P: Array
    brightness: Array
    at: Array
    missed: Integers
    strays: Array


class SkyDetections(NamedTuple):
    """Detections of one sensor on the sky, frame after frame.

    time_s : (f,) float
        Frame times [s], increasing.
    offsets : (f + 1,) int
        Frame k has the detections ``offsets[k]:offsets[k + 1]``.
    u_icrs : (n, 3) float
        Directions, unit vectors.
    sigma_rad : (n,) float
        1-sigma error per axis, of centroid and attitude together [rad].
    flux : (n,) float
        In any unit; NaN where it is unknown. None: all are.
    """

    time_s: Array
    offsets: Integers
    u_icrs: Array
    sigma_rad: Array
    flux: Array | None = None

    def take(self, rows: Indices) -> "SkyDetections":
        """Return these detections, in ascending order, in the same frames."""
        return SkyDetections(
            self.time_s,
            np.searchsorted(rows, self.offsets),
            self.u_icrs[rows],
            self.sigma_rad[rows],
            None if self.flux is None else self.flux[rows],
        )


def follow_detections(
    seen: SkyDetections,
    *,
    max_rate_rad_s: float,
    max_coast_s: float | Array,
    max_missed: int,
    min_detections: int,
    gate_sigma: float,
    field_sr: float,
    false_alarm: float,
    false_alarm_sequence: float = FALSE_ALARM_SEQUENCE,
) -> Integers:
    """Return the track number of every detection, -1 without a track.

    Parameters
    ----------
    max_rate_rad_s
        Maximum rate of an object.
    max_coast_s : float or (f,) float
        Maximum time between each frame and an earlier one of the same track.
    max_missed
        Number of successive misses after which a track ends, unless its motion is known so well
        that a false detection in its gate is improbable (`MAX_STRAYS`).
    min_detections
        Minimum number of detections that begin a track, 2 or more. They lie within `SLACK_FRAMES`
        more frames than that.
    gate_sigma
        A detection continues a track within this many standard deviations.
    field_sr
        Solid angle of the field, for the density of the detections.
    false_alarm
        Accepted number of tracks per frame that consist of false alarms. Where false alarms are
        dense, or an object is fast, it takes more detections to begin a track.
    false_alarm_sequence
        Accepted number of such tracks in the whole sequence. Few frames give less evidence than
        many. So in a short sequence, detections without a track are followed again, with this
        number divided by the number of frames.

    Returns
    -------
    (n,) int
        Tracks count from 0 by the frame in which they were confirmed; those of the second time
        come last.
    """
    max_per_frame = max(MAX_PAIRS_OF_ALL / max(len(seen.time_s), 1), MIN_PAIRS)
    rule = TrackRule(
        float(max_rate_rad_s),
        np.array(np.broadcast_to(max_coast_s, len(seen.time_s)), float),
        int(max_missed),
        int(max(min_detections, 2)),
        float(gate_sigma) ** 2,
        float(field_sr),
        -float(np.log(false_alarm)),
        float(min(max_per_frame, MAX_PAIRS)),
    )
    track = _follow_by_rule(seen, rule)
    motion = common_motion(*seen[:4], track)
    if motion is not None:
        moving = _follow_free(seen, _follow_in_motion(seen, rule, motion), rule)
        # Confused tracks break: better tracks have more detections in fewer pieces.
        track = max(track, moving, key=lambda tracks: _n_explained(tracks, rule.min_detections))
    n_frames = int(np.count_nonzero(np.diff(seen.offsets)))
    if n_frames > SHORT_SEQUENCE * (rule.min_detections + EXTRA_DETECTIONS):
        return track
    per_frame = max(false_alarm, false_alarm_sequence / n_frames) if n_frames else false_alarm
    return _follow_free(seen, track, rule._replace(min_evidence=-float(np.log(per_frame))))


def _n_explained(track: Integers, min_detections: int) -> int:
    """Return the number of detections in tracks, beyond the minimum of each track."""
    return int(np.count_nonzero(track != NONE)) - min_detections * (int(track.max(initial=-1)) + 1)


def _follow_in_motion(seen: SkyDetections, rule: TrackRule, motion: CommonMotion) -> Integers:
    """Return the track number of every detection, -1 if it does not follow the common motion."""
    frame = np.repeat(np.arange(len(seen.time_s)), np.diff(seen.offsets))
    moving = seen._replace(
        time_s=seen.time_s / COMMON_FACTOR,
        u_icrs=np.einsum("nij,nj->ni", motion.rotation[frame], seen.u_icrs),
    )
    slow = rule._replace(
        max_rate=max(COMMON_SHARE * motion.rate, COMMON_RATE) * COMMON_FACTOR,
        max_coast=rule.max_coast / COMMON_FACTOR,
    )
    return _follow_by_rule(moving, slow)


def _follow_free(seen: SkyDetections, track: Integers, rule: TrackRule) -> Integers:
    """Return the tracks, and after them new ones of the detections without a track."""
    free = np.flatnonzero(track == NONE)
    if not len(free):
        return track
    more = _follow_by_rule(seen.take(free), rule)
    out = track.copy()
    out[free] = np.where(more == NONE, NONE, more + track.max() + 1)
    return out


def _follow_by_rule(seen: SkyDetections, rule: TrackRule) -> Integers:
    """Return the track number of every detection, by one rule."""
    n_in, n = np.diff(seen.offsets), len(seen.u_icrs)
    detections = Detections(
        np.ascontiguousarray(seen.time_s, float),
        np.ascontiguousarray(seen.offsets, np.int64),
        np.repeat(np.arange(len(n_in)), n_in),
        np.ascontiguousarray(seen.u_icrs, float),
        np.ascontiguousarray(seen.sigma_rad, float) ** 2,
        np.full(n, np.nan) if seen.flux is None else log_flux(seen.flux),
        np.full(n, NONE),
    )
    _follow_and_retrace(detections, int(n_in.max(initial=0)), rule)
    return detections.track


@kernel
def _follow_and_retrace(detections, max_in_frame, rule):
    """Write each detection's track to `detections.track`; a frame has at most `max_in_frame`.

    A single kernel is called from Python: so `_retrace` is compiled even if no run needs it.
    """
    if _follow(detections, max_in_frame, rule):
        _retrace(detections, max_in_frame, rule)


@kernel
def _follow(detections, max_in_frame, rule):
    """Write each detection's track to `detections.track`; a frame has at most `max_in_frame`.

    Returns whether a detection of one track was in the gate of another.
    """
    times = detections.times
    tracks = _empty_tracks(len(detections.track) // max(rule.min_detections, 1) + 1)
    contested = False
    live = np.empty(0, np.int64)
    # Not the literal 0: `new_tracks` would be compiled for that type as well.
    n_tracks = len(live)
    n_slots = max(rule.min_detections + EXTRA_DETECTIONS, FAINT_FRAMES) + 1
    recent = RecentFrames(
        make_grids(n_slots, max_in_frame), np.full(n_slots, np.inf), np.zeros(n_slots)
    )
    for f in range(len(times)):
        _fill_frame(f, detections, recent)
        # A track with too many misses has ended.
        missed = tracks.missed[live]
        is_sure = (missed <= MAX_MISSED_FRAMES) & (tracks.strays[live] <= MAX_STRAYS)
        live = live[
            ((missed <= rule.max_missed) | is_sure)
            & (times[f] - tracks.at[live] <= rule.max_coast[f])
        ]
        contested |= _assign(f, live, tracks, detections, recent, rule)
        began, length, chains = new_tracks(
            f, rule.min_detections + SLACK_FRAMES, n_tracks, detections, recent, rule
        )
        for row in began:
            members = chains[row, : length[row]]
            u, w, bend, P = tracks.u, tracks.w, tracks.bend, tracks.P
            _state_of(members, detections, u[n_tracks], w[n_tracks], bend[n_tracks], P[n_tracks])
            begin_brightness(tracks.brightness[n_tracks])
            for j in members[::-1]:
                learn_brightness(tracks.brightness[n_tracks], detections.log_flux[j])
            tracks.at[n_tracks], tracks.missed[n_tracks] = times[f], 0
            tracks.strays[n_tracks] = 0.0
            n_tracks += 1
        live = np.concatenate((live, np.arange(n_tracks - len(began), n_tracks)))
    return contested


@kernel
def _empty_tracks(n):
    """Return n tracks whose states are not yet set."""
    return _Tracks(
        np.empty((n, 3)),
        np.empty((n, 3)),
        np.empty((n, 3)),
        np.empty((n, SIZE)),
        np.empty((n, BRIGHTNESS_SIZE)),
        np.empty(n),
        np.zeros(n, np.int64),
        np.zeros(n),
    )


@kernel
def _retrace(detections, max_in_frame, rule):
    """Follow all tracks back in time, and exchange detections where both tracks then fit better.

    Where co-located objects are mixed, it is at the beginning of their tracks: motion and
    brightness are known later. Changes `detections.track`; a frame has at most `max_in_frame`.
    """
    times, offsets, track = detections.times, detections.offsets, detections.track
    n_tracks = track.max() + 1
    tracks, has_state = _empty_tracks(n_tracks), np.zeros(n_tracks, np.bool_)
    last = np.full(n_tracks, NONE)  # detection of a track that has no state yet
    left = np.bincount(track[track != NONE])  # detections of a track that are not yet retraced
    recent = RecentFrames(make_grids(1, max_in_frame), np.full(1, np.inf), np.zeros(1))
    for f in range(len(times) - 1, -1, -1):
        _fill_frame(f, detections, recent)
        rows = np.arange(offsets[f], offsets[f + 1])
        rows = rows[track[rows] != NONE]
        rows = rows[np.argsort(track[rows])]
        moving = np.empty(len(rows), np.int64)
        n = 0
        for j in rows:
            m = track[j]
            if has_state[m]:
                moving[n] = j
                n += 1
            elif last[m] == NONE:
                last[m] = j
            elif times[detections.frame_of[last[m]]] > times[f]:
                _begin_back(tracks, m, detections, last[m], j)
                has_state[m] = True
        moving = moving[:n]
        live = track[moving]
        _move(tracks, live, times[f])
        member, detection, chi2 = _candidates(f, live, tracks, detections, recent, rule)
        other = track[detection]
        young = (other != NONE) & ((left[member] <= YOUNG) | (left[other] <= YOUNG))
        row = np.searchsorted(live, member[young])
        _exchange(
            live, tracks, detections, (row, detection[young], chi2[young]), moving, rule.gate2
        )
        for q in range(n):
            _correct(tracks, live[q], detections, moving[q])
        left[track[rows]] -= 1


@kernel
def _begin_back(tracks, m, detections, newer, older):
    """Set the state of track m at the older of two detections."""
    times, frame_of = detections.times, detections.frame_of
    directions, variances = detections.directions, detections.variances
    begin(
        directions[newer], times[frame_of[newer]], variances[newer],
        directions[older], times[frame_of[older]], variances[older],
        tracks.u[m], tracks.w[m], tracks.bend[m], tracks.P[m],
    )  # fmt: skip
    begin_brightness(tracks.brightness[m])
    learn_brightness(tracks.brightness[m], detections.log_flux[newer])
    learn_brightness(tracks.brightness[m], detections.log_flux[older])
    tracks.at[m] = times[frame_of[older]]


@kernel
def _fill_frame(f, detections, recent):
    """Enter the detections of frame f into its slot."""
    lo, hi, slot = detections.offsets[f], detections.offsets[f + 1], f % len(recent.largest)
    fill_grid(recent.grids, slot, detections.directions, lo, hi)
    recent.smallest[slot] = detections.variances[lo:hi].min() if hi > lo else np.inf
    recent.largest[slot] = detections.variances[lo:hi].max() if hi > lo else 0.0


@kernel
def _assign(f, live, tracks, detections, recent, rule):
    """Move the live tracks to frame f, give them its detections and correct them.

    `live` (l,) int64 are rows of `tracks`, ascending. Writes `tracks` and `detections.track`.
    Returns whether a detection of one track is in the gate of another.
    """
    _move(tracks, live, detections.times[f])
    for m in live:
        tracks.missed[m] += 1
    track, detection, chi2 = _candidates(f, live, tracks, detections, recent, rule)
    row = np.searchsorted(live, track)
    assigned = np.full(len(live), NONE)
    for p in np.argsort(chi2, kind="mergesort"):
        q, j = row[p], detection[p]
        if assigned[q] == NONE and detections.track[j] == NONE:
            assigned[q] = j
            detections.track[j] = track[p]
    contested = _exchange(live, tracks, detections, (row, detection, chi2), assigned, rule.gate2)
    for q in range(len(live)):
        m, j = live[q], assigned[q]
        if j == NONE:
            continue
        tracks.missed[m], tracks.strays[m] = 0, 0.0
        _correct(tracks, m, detections, j)
    return contested


@kernel
def _move(tracks, live, time):
    """Move the states of the live tracks, rows of `tracks`, to a time [s]."""
    u, w, bend, P = tracks.u, tracks.w, tracks.bend, tracks.P
    for m in live:
        dt = time - tracks.at[m]
        grow(P[m], rate_of(w[m]), rate_of(bend[m]), dt)
        advance(u[m], w[m], bend[m], dt)
        tracks.at[m] = time


@kernel
def _correct(tracks, m, detections, j):
    """Update the state of track m by detection j."""
    correct(
        tracks.u[m], tracks.w[m], tracks.bend[m], tracks.P[m],
        detections.directions[j], detections.variances[j],
    )  # fmt: skip
    learn_brightness(tracks.brightness[m], detections.log_flux[j])


@kernel
def _candidates(f, live, tracks, detections, recent, rule):
    """Return all (track, detection, chi-square) within the gates of the tracks in frame f.

    They are (c,) int64, int64 and float; `live` (l,) int64 are rows of `tracks`. Writes their
    `strays`.
    """
    slot, n_in = f % len(recent.largest), detections.offsets[f + 1] - detections.offsets[f]
    density = n_in / rule.field_sr
    start, items = recent.grids[2], recent.grids[3]
    directions, variances = detections.directions, detections.variances
    capacity, count = 4 * len(live) + 16, 0
    track, detection = np.empty(capacity, np.int64), np.empty(capacity, np.int64)
    chi2 = np.empty(capacity)
    for m in live if n_in else live[:0]:
        variance, brightness = tracks.P[m, 0], tracks.brightness[m]
        gate2 = _gate2(variance + recent.smallest[slot], density, rule)
        if not gate2 > 0.0:
            tracks.strays[m] = np.inf
            continue
        reach = np.sqrt(gate2 * (variance + recent.largest[slot]))
        tracks.strays[m] += density * np.pi * reach * reach
        x_from, x_to, y_from, y_to, side = window(recent.grids, slot, tracks.u[m], reach)
        if x_from > x_to:
            continue
        for y in range(y_from, y_to + 1):
            for k in range(start[slot, y * side + x_from], start[slot, y * side + x_to + 1]):
                j = items[slot, k]
                distance = distance2(directions[j], tracks.u[m]) / (variance + variances[j])
                if distance >= gate2:
                    continue
                if count == capacity:
                    track = np.concatenate((track, np.empty(capacity, np.int64)))
                    detection = np.concatenate((detection, np.empty(capacity, np.int64)))
                    chi2 = np.concatenate((chi2, np.empty(capacity)))
                    capacity *= 2
                unlike = brightness_chi2(brightness, detections.log_flux[j])
                track[count], detection[count], chi2[count] = m, j, distance + unlike
                count += 1
    return track[:count], detection[:count], chi2[:count]


@kernel
def _gate2(variance, density, rule):
    """Return the squared gate [sigma^2] of a track: within it a detection is more probably the
    object than a false alarm.

    Parameters
    ----------
    variance : float
        Of the distance between prediction and detection, per axis [rad^2].
    density : float
        Detections per steradian in the frame.

    Notes
    -----
    ``P_D / (density * 2 pi variance) * exp(-chi2 / 2) > 1``, see Blackman, Multiple-Target Tracking
    with Radar Applications (1986). Without this limit a track with an unknown rate would take
    any detection.
    """
    return min(rule.gate2, 2.0 * np.log(P_DETECTION / (density * 2 * np.pi * variance)))


@kernel
def _exchange(live, tracks, detections, candidates, assigned, gate2):
    """Exchange the detections of two tracks where both together then fit better.

    Predictions of neighbours may all be off to one side. Then the nearest detection is often the
    neighbour's. `candidates` are row in `live`, detection and chi-square, (c,) each; `assigned`
    (len(live),) the detection of each live track. Changes `assigned` and `detections.track`.
    Returns whether a detection of one track is in the gate of another.
    """
    row, detection, chi2 = candidates
    contested = False
    for p in range(len(row)):
        q, k = row[p], detection[p]
        j, other = assigned[q], detections.track[k]
        if j in (NONE, k) or other == NONE:
            continue
        at = np.searchsorted(live, other)
        if at == len(live) or live[at] != other:
            continue
        contested = True
        now = _chi2(tracks, live[q], detections, j) + _chi2(tracks, other, detections, k)
        back = _chi2(tracks, other, detections, j)
        in_gate = _direction_chi2(tracks, other, detections, j) < gate2
        if in_gate and chi2[p] + back < now:
            assigned[q], assigned[at] = k, j
            detections.track[k], detections.track[j] = live[q], other
    return contested


@kernel
def _chi2(tracks, m, detections, j):
    """Return chi-square of detection j as one of track m: of its direction and of its flux."""
    unlike = brightness_chi2(tracks.brightness[m], detections.log_flux[j])
    return _direction_chi2(tracks, m, detections, j) + unlike


@kernel
def _direction_chi2(tracks, m, detections, j):
    """Return chi-square of the direction of detection j, 2 degrees of freedom, for track m."""
    variance = tracks.P[m, 0] + detections.variances[j]
    return distance2(detections.directions[j], tracks.u[m]) / variance


@kernel
def _state_of(members, detections, u, w, bend, P):
    """Filter a new track's detections, newest first in `members`, into its state at the newest.

    `members` (k,) int64 are two detections or more. The state u, w, bend (3,) and P (6,), see
    `begin`, is written.
    """
    times, frame_of = detections.times, detections.frame_of
    directions, variances = detections.directions, detections.variances
    last = len(members) - 1
    first, second = members[last], members[last - 1]
    begin(
        directions[first], times[frame_of[first]], variances[first],
        directions[second], times[frame_of[second]], variances[second], u, w, bend, P,
    )  # fmt: skip
    for m in range(last - 2, -1, -1):
        dt = times[frame_of[members[m]]] - times[frame_of[members[m + 1]]]
        grow(P, rate_of(w), rate_of(bend), dt)
        advance(u, w, bend, dt)
        correct(u, w, bend, P, directions[members[m]], variances[members[m]])
