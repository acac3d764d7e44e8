"""Tracking: detections of one sensor, frame after frame, become runs of one object.

Everything happens on the sky, after attitude, so that the sensor's own turning is gone. A
track is a direction and a rate; between frames it moves along its great circle, and the
uncertainty of both grows with the acceleration that its rate allows. No chart is involved,
so no place on the sky is special.
"""

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]

GRAVITY_PER_SPEED = 1e-3  # [1/s] g / v of a low orbit: how fast a path bends under gravity
FLOOR_RAD_S2 = 2.5e-7  # [rad/s^2] a low sensor's own acceleration, seen from a distant object

NONE = -1
SEEN = 0.9  # probability that a frame shows an object it looks at
SLACK = 4  # frames beyond the fewest detections in which a track must begin


@njit(cache=True, nogil=True)
def _acceleration(rate: float) -> float:
    """Return how fast [rad/s^2] the rate of an object may change.

    Geometry changes it by the square of the rate (passing at range d with speed v:
    v / d = rate, rate change up to rate^2), gravity by g / v times the rate, and a sensor in a
    low orbit by its own acceleration over the range.
    """
    return rate * rate + GRAVITY_PER_SPEED * rate + FLOOR_RAD_S2


@njit(cache=True, nogil=True)
def _advance(u, w, dt):
    """Turn direction u and rate w (both changed in place) by dt along their great circle."""
    rate = np.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2)
    angle = rate * dt
    if angle == 0.0:
        return
    cosine, sine = np.cos(angle), np.sin(angle)
    for a in range(3):
        old_u, old_w = u[a], w[a]
        u[a] = old_u * cosine + old_w / rate * sine
        w[a] = old_w * cosine - old_u * rate * sine


@njit(cache=True, nogil=True)
def _grow(P, rate, dt):
    """Let the covariance P = (direction, cross, rate) of one axis grow over dt."""
    a = _acceleration(rate)
    step = abs(dt)
    P[0] += 2 * dt * P[1] + dt * dt * P[2] + 0.25 * a * a * step**4
    P[1] += dt * P[2] + 0.5 * a * a * dt * step**2
    P[2] += a * a * step * step


@njit(cache=True, nogil=True)
def _correct(u, w, P, measured, variance):
    """Update u, w, P in place by a measured direction; both axes share one covariance."""
    s = P[0] + variance
    gain_u, gain_w = P[0] / s, P[1] / s
    norm = 0.0
    for a in range(3):
        difference = measured[a] - u[a]
        u[a] += gain_u * difference
        w[a] += gain_w * difference
        norm += u[a] * u[a]
    norm = np.sqrt(norm)
    along = 0.0
    for a in range(3):
        u[a] /= norm
        along += w[a] * u[a]
    for a in range(3):
        w[a] -= along * u[a]  # a rate stays perpendicular to its direction
    P[2] -= gain_w * P[1]
    P[1] -= gain_u * P[1]
    P[0] -= gain_u * P[0]


@njit(cache=True, nogil=True)
def _begin(u_1, t_1, var_1, u_2, t_2, var_2, u, w, P):
    """Set u, w, P to the state at the second of two detections."""
    dt = t_2 - t_1
    cosine = u_1[0] * u_2[0] + u_1[1] * u_2[1] + u_1[2] * u_2[2]
    chord = 0.0
    for a in range(3):
        u[a] = u_2[a]
        w[a] = u_2[a] * cosine - u_1[a]  # perpendicular to u_2, away from u_1
        chord += w[a] * w[a]
    chord = np.sqrt(chord)
    rate = np.arctan2(chord, cosine) / dt
    for a in range(3):
        w[a] *= rate / chord if chord > 0 else 0.0
    acceleration = _acceleration(abs(rate))
    P[0] = var_2
    P[1] = var_2 / dt
    P[2] = (var_1 + var_2) / (dt * dt) + 0.25 * acceleration**2 * dt * dt
    return abs(rate)


@njit(cache=True, nogil=True)
def _distance2(a, b):
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2


@njit(cache=True, nogil=True)
def _nearest_free(u, variance, directions, variances, order, key, axis, lo, hi, track, gate2):
    """Return the free detection of a frame that is nearest to u in sigmas, and its chi-square.

    `order[lo:hi]` are the frame's detections by their coordinate on `axis`, `key` that
    coordinate: |difference on an axis| <= distance, so a band of it holds the whole gate.
    """
    largest = 0.0
    for k in range(lo, hi):
        largest = max(largest, variances[order[k]])
    reach = np.sqrt(gate2 * (variance + largest))
    first = lo + np.searchsorted(key[lo:hi], u[axis] - reach)
    best, best_chi2 = NONE, gate2
    for k in range(first, hi):
        if key[k] > u[axis] + reach:
            break
        j = order[k]
        if track[j] != NONE:
            continue
        chi2 = _distance2(directions[j], u) / (variance + variances[j])
        if chi2 < best_chi2:
            best, best_chi2 = j, chi2
    return best, best_chi2


@njit(cache=True, nogil=True)
def _rate_of(w):
    return np.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2)


@njit(cache=True, nogil=True)
def _chain_back(
    f, g, i, j, directions, variances, times, offsets, order, key, axis, track, density, gate2,
    members,
):  # fmt: skip
    """Follow the pair (j of frame f, i of frame g) back; return its detections and evidence.

    `members` receives the detections, newest first. The evidence is the log of how much
    likelier one moving object makes the further detections than strays of that density do.
    """
    u, w, P = np.empty(3), np.empty(3), np.empty(3)
    _begin(directions[j], times[f], variances[j], directions[i], times[g], variances[i], u, w, P)
    members[0], members[1] = j, i
    n, evidence, at = 2, (f - g - 1) * np.log(1.0 - SEEN), times[g]
    waiting = 0.0  # frames missed before the oldest detection so far: it may have entered there
    for h in range(g - 1, f - len(density), -1):
        dt = times[h] - at
        if dt == 0.0:
            continue
        _grow(P, _rate_of(w), dt)
        _advance(u, w, dt)
        at = times[h]
        k, chi2 = _nearest_free(
            u, P[0], directions, variances, order, key, axis[h], offsets[h], offsets[h + 1],
            track, gate2,
        )  # fmt: skip
        if k == NONE:
            waiting += np.log(1.0 - SEEN)
            continue
        spot = 2 * np.pi * (P[0] + variances[k])
        gain = np.log(SEEN / (density[f - h] * spot)) - 0.5 * chi2 + waiting
        if gain < 0.0:
            waiting += np.log(1.0 - SEEN)
            continue
        evidence, waiting = evidence + gain, 0.0
        _correct(u, w, P, directions[k], variances[k])
        members[n] = k
        n += 1
    return n, evidence


@njit(cache=True, nogil=True)
def _free_density(f, depth, offsets, track, field_sr):
    """Return free detections a steradian in frame f and the frames before it, at least one."""
    out = np.empty(min(depth, f + 1))
    for back in range(len(out)):
        free = 0
        for j in range(offsets[f - back], offsets[f - back + 1]):
            free += track[j] == NONE
        out[back] = max(free, 1) / field_sr
    return out


@njit(cache=True, nogil=True)
def _new_tracks(
    f, times, offsets, directions, variances, order, key, axis, track, n_tracks, max_rate,
    max_coast, need, gate2, field_sr, enough,
):  # fmt: skip
    """Begin tracks that end in frame f from detections no track has claimed.

    Each pair of this frame and one of the two before it is followed back. It begins a track if
    it gathers `need` detections and more evidence than the number of pairs tried lets chance
    have. The strongest come first; a detection serves once. Returns the number of tracks there
    are now; `track` is filled in.
    """
    depth = need + SLACK
    lo, hi = offsets[f], offsets[f + 1]
    n = hi - lo
    density = _free_density(f, depth, offsets, track, field_sr)
    held, strength = np.zeros(n, np.int64), np.full(n, -np.inf)
    chains, members = np.full((n, depth), NONE), np.empty(depth, np.int64)
    for g in range(f - 1, max(f - 3, -1), -1):
        dt = times[f] - times[g]
        if dt <= 0.0 or dt > max_coast:
            continue
        tries = np.log(density[0] * density[f - g] * field_sr * field_sr)
        # No chord is longer than the arc, so the band holds all that is slow enough.
        reach = max_rate * dt
        for row in range(n):
            j = lo + row
            if track[j] != NONE:
                continue
            centre = directions[j, axis[g]]
            first = offsets[g] + np.searchsorted(key[offsets[g] : offsets[g + 1]], centre - reach)
            for k in range(first, offsets[g + 1]):
                if key[k] > centre + reach:
                    break
                i = order[k]
                if track[i] != NONE or _distance2(directions[i], directions[j]) > reach * reach:
                    continue
                got, evidence = _chain_back(
                    f, g, i, j, directions, variances, times, offsets, order, key, axis, track,
                    density, gate2, members,
                )  # fmt: skip
                evidence -= tries
                if got >= need and evidence > max(enough, strength[row]):
                    held[row], strength[row] = got, evidence
                    chains[row, :got] = members[:got]
    # A stable sort: the same order on every run.
    for row in np.argsort(-strength, kind="mergesort"):
        if held[row] == 0:
            break
        free = True
        for m in range(held[row]):
            free = free and track[chains[row, m]] == NONE
        if free:
            for m in range(held[row]):
                track[chains[row, m]] = n_tracks
            n_tracks += 1
    return n_tracks


@njit(cache=True, nogil=True)
def _state_of(members, frame_of, times, directions, variances, u, w, P):
    """Filter a new track's detections, oldest first, into its state at the newest."""
    n = len(members)
    _begin(
        directions[members[0]],
        times[frame_of[members[0]]],
        variances[members[0]],
        directions[members[1]],
        times[frame_of[members[1]]],
        variances[members[1]],
        u,
        w,
        P,
    )
    for m in range(2, n):
        dt = times[frame_of[members[m]]] - times[frame_of[members[m - 1]]]
        _grow(P, _rate_of(w), dt)
        _advance(u, w, dt)
        _correct(u, w, P, directions[members[m]], variances[members[m]])


@njit(cache=True, nogil=True)
def _claim(
    live, n_live, U, W, P, at, ids, missed, f, times, offsets, directions, variances, track, gate2
):
    """Move the live tracks to frame f and give each detection to the track it fits best."""
    lo, hi = offsets[f], offsets[f + 1]
    n = hi - lo
    for a in range(n_live):
        m = live[a]
        dt = times[f] - at[m]
        _grow(P[m], _rate_of(W[m]), dt)
        _advance(U[m], W[m], dt)
        at[m] = times[f]
    count = 0
    pair_track, pair_row = np.empty(n_live * n, np.int64), np.empty(n_live * n, np.int64)
    pair_chi2 = np.empty(n_live * n)
    for a in range(n_live):
        m = live[a]
        for row in range(n):
            chi2 = _distance2(directions[lo + row], U[m]) / (P[m, 0] + variances[lo + row])
            if chi2 < gate2:
                pair_track[count], pair_row[count], pair_chi2[count] = m, row, chi2
                count += 1
    served = np.zeros(len(ids), np.bool_)
    for p in np.argsort(pair_chi2[:count], kind="mergesort"):
        m, j = pair_track[p], lo + pair_row[p]
        if served[m] or track[j] != NONE:
            continue
        served[m] = True
        track[j] = ids[m]
        _correct(U[m], W[m], P[m], directions[j], variances[j])
    for a in range(n_live):
        m = live[a]
        missed[m] = 0 if served[m] else missed[m] + 1


@njit(cache=True, nogil=True)
def _follow(
    times, offsets, directions, variances, order, key, axis, max_rate, max_coast, max_missed, need,
    gate2, field_sr, enough,
):  # fmt: skip
    n = len(directions)
    frame_of = np.empty(n, np.int64)
    for f in range(len(times)):
        frame_of[offsets[f] : offsets[f + 1]] = f
    track = np.full(n, NONE)
    room = n // max(need, 1) + 1
    U, W, P = np.empty((room, 3)), np.empty((room, 3)), np.empty((room, 3))
    at, ids = np.empty(room), np.empty(room, np.int64)
    missed, live = np.zeros(room, np.int64), np.empty(room, np.int64)
    members = np.empty(need + SLACK, np.int64)
    n_live, n_tracks = 0, 0
    for f in range(len(times)):
        kept = 0
        for a in range(n_live):  # a track that was missed too often has ended
            m = live[a]
            if missed[m] <= max_missed and times[f] - at[m] <= max_coast:
                live[kept] = m
                kept += 1
        n_live = kept
        _claim(
            live, n_live, U, W, P, at, ids, missed, f, times, offsets, directions, variances,
            track, gate2,
        )  # fmt: skip
        before = n_tracks
        n_tracks = _new_tracks(
            f, times, offsets, directions, variances, order, key, axis, track, n_tracks, max_rate,
            max_coast, need, gate2, field_sr, enough,
        )  # fmt: skip
        for new in range(before, n_tracks):
            count = 0
            for j in range(offsets[max(f - need - SLACK + 1, 0)], offsets[f + 1]):
                if track[j] == new:
                    members[count] = j
                    count += 1
            _state_of(
                members[:count], frame_of, times, directions, variances, U[new], W[new], P[new]
            )
            at[new], ids[new], missed[new] = times[f], new, 0
            live[n_live] = new
            n_live += 1
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
    axis, order, key = _sorted_frames(offsets, u_icrs)
    return _follow(
        np.ascontiguousarray(time_s, float),
        np.ascontiguousarray(offsets, np.int64),
        np.ascontiguousarray(u_icrs, float),
        np.ascontiguousarray(sigma_rad, float) ** 2,
        order,
        key,
        axis,
        float(max_rate_rad_s),
        float(max_coast_s),
        int(max_missed),
        int(max(min_detections, 2)),
        float(gate_sigma) ** 2,
        float(field_sr),
        -float(np.log(false_alarm)),
    )


def _sorted_frames(
    offsets: npt.NDArray[np.int64], u_icrs: Array
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], Array]:
    """Return, a frame, the axis most across the line of sight, and its detections by it."""
    n_frames = len(offsets) - 1
    frame_of = np.repeat(np.arange(n_frames), np.diff(offsets))
    total = np.zeros((n_frames, 3))
    np.add.at(total, frame_of, u_icrs)
    axis = np.argmin(np.abs(total), axis=1).astype(np.int64)
    coordinate = u_icrs[np.arange(len(u_icrs)), axis[frame_of]]
    order = np.lexsort((coordinate, frame_of)).astype(np.int64)
    return axis, order, coordinate[order]
