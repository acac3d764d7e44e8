"""Track initiation: free detections begin a track if a false alarm is improbable enough.

1. Pairs are formed of a free detection in the newest frame and one in either of the two frames
   before it (`_try_pairs`).
2. Each pair is followed back in time (`_chain_back`). Every further detection adds to the evidence:
   the more precise the prediction and the lower the density of false alarms, the more it adds.
3. The strongest chains become tracks (`new_tracks`).

Where frames have few free detections, faint objects are searched for too, which are detected in a
third of the frames: pairs reach four frames back, chains `FAINT_FRAMES`.

The rate of a pair limits the evidence that its chain can reach (`_max_evidence`). Pairs that
cannot reach enough are skipped. In dense frames these are most pairs; no track is lost.
"""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Indices
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.tracking.brightness import SIZE as BRIGHTNESS_SIZE
from epipole.tasks.algorithms.tracking.brightness import (
    begin_brightness,
    brightness_chi2,
    learn_brightness,
)
from epipole.tasks.algorithms.tracking.sky_filter import (
    SIZE,
    advance,
    begin,
    begin_covariance,
    correct,
    distance2,
    grow,
    rate_of,
    shrink,
    window,
)

NONE = -1
P_DETECTION = 0.9  # probability that an object in the field is detected in a frame
LOG_MISS = np.log(1.0 - P_DETECTION)
EXTRA_DETECTIONS = 9  # beyond the minimum, that a chain may have
APART = 2  # maximum number of frames between the detections of a pair
# An object at the limit of magnitude is detected in a third of the frames. Where frames have few
# free detections, a chain may be such an object as well, and reaches farther back. In constellation
# scenes of 24 to 96 satellites the passages followed rise from 94.8 to 99.4 of 100; with 16 frames
# or pairs 3 frames apart they are 99.2.
P_FAINT = 0.35
LOG_FAINT_MISS, LOG_FAINT_HIT = np.log(1.0 - P_FAINT), np.log(P_FAINT / P_DETECTION)
LOG_FAINT = np.log(0.5)  # prior odds that a chain is such an object
FAINT_APART, FAINT_FRAMES = 4, 24  # as `APART`; frames that a chain reaches back
MAX_FAINT_MISSES = 8  # in a row; 3 of 100 chains of such objects have more
# Least log-evidence of what a chain has behind a gap at which a track would end. A prediction over
# a gap is wide, and a false alarm is soon within it; a burst of frames on an object adds more.
MIN_BEHIND_GAP = 5.0
# Faint objects are searched for in frames with up to this number of free detections: with 10 it
# would take 10 ms.
MAX_FREE = 8.0
N_RATES = 24  # classes of rate for which the maximum evidence is tabulated
SLOWEST_RAD_S = 1e-6  # upper end of the slowest class of rate [rad/s]
MAX_PAIRS = 500_000  # limit per frame, even in a short sequence
# Up to this number of pairs, only the classes of rate that occur are tabulated: sparse frames are
# then faster.
FEW_TO_CLASSIFY = 1_000
# Up to this number, pairs that are two frames apart are tried as well: it bounds the time.
FEW_PAIRS = 50_000


class Detections(NamedTuple):
    """Detections of one sensor; frame k has the rows offsets[k]:offsets[k + 1].

    times, offsets : (f,) float [s], (f + 1,) int64, of frames
    frame_of, directions, variances : (n,) int64, (n, 3), (n,) float, of detections: rows of the
        frames, unit vectors, and variances per axis [rad^2]. The axes are those of ICRS, or move
        with the common motion; all times are then in units of `COMMON_FACTOR` [s]
    log_flux : (n,) float, see `brightness`
    track : (n,) int64, the track of each detection, NONE while it is free; kernels write it
    """

    times: Array
    offsets: Indices
    frame_of: Indices
    directions: Array
    variances: Array
    log_flux: Array
    track: Indices


class RecentFrames(NamedTuple):
    """The newest frames: frame f is in slot f modulo the number of slots.

    grids : see `sky_filter.make_grids`
    smallest, largest : (slots,) float, minimum and maximum variance [rad^2] of each frame's
        detections
    """

    grids: tuple[Array, Array, Indices, Indices]
    smallest: Array
    largest: Array


class TrackRule(NamedTuple):
    """When a track begins and ends.

    max_rate : maximum rate [rad/s]
    max_coast : (f,) float, maximum time between each frame and an earlier one of a track [s]
    max_missed : maximum number of successive frames without a detection
    min_detections : minimum number of detections of a new track
    gate2 : maximum chi-square at which a detection continues a track
    field_sr : solid angle of the field [sr]
    min_evidence : log-evidence that a new track must have beyond the log of the number of pairs
    max_pairs : maximum number of pairs per frame; beyond it, fast objects are not searched for
    """

    max_rate: float
    max_coast: Array
    max_missed: int
    min_detections: int
    gate2: float
    field_sr: float
    min_evidence: float
    max_pairs: float


class _Pair(NamedTuple):
    """Detection j of frame f and detection i of the earlier frame g.

    chord2, dt : squared chord between them [rad^2], and time from g to f [s], positive
    """

    f: int
    j: int
    g: int
    i: int
    chord2: float
    dt: float


class _Evidence(NamedTuple):
    """How the pairs of two frames are judged.

    density : (depth,) float, free detections per steradian in the newest frame and those before
    best : (N_RATES, k) float, log-evidence that earlier frames can add at most, of those to which
        chains are followed; see `_max_evidence`
    log_pairs : ln of the number of pairs, each of which may be a false alarm
    faint : whether objects that are detected in few frames are searched for
    """

    density: Array
    best: Array
    log_pairs: float
    faint: bool


class _Chains(NamedTuple):
    """The strongest chain of each detection of the newest frame.

    length : (n,) int64, number of detections; 0: no chain
    strength : (n,) float, log-evidence beyond the log of the number of pairs, less the penalty of
        unlike fluxes
    members : (n, longest) int64, detections, newest first
    """

    length: Indices
    strength: Array
    members: Indices


class _ChainScratch(NamedTuple):
    """Work space for one chain.

    u, w, bend, P : (3,), (3,), (3,), (SIZE,) float, state of the filter, see `sky_filter`
    ahead : (3,) float, a predicted direction
    brightness : (3,) float, see `brightness`
    members : (longest,) int64, detections, newest first
    """

    u: Array
    w: Array
    bend: Array
    P: Array
    ahead: Array
    brightness: Array
    members: Indices


@kernel
def _free_density(f, depth, detections, field_sr):
    """Return free detections per steradian in frame f and up to depth - 1 frames before it.

    (depth,) or (f + 1,) where there are fewer frames; newest first. A frame without free detections
    counts as a frame with one.
    """
    offsets = detections.offsets
    out = np.empty(min(depth, f + 1))
    for back in range(len(out)):
        free = 0
        for j in range(offsets[f - back], offsets[f - back + 1]):
            free += detections.track[j] == NONE
        out[back] = max(free, 1) / field_sr
    return out


@kernel
def _class_rates(max_rate):
    """Return the bounds of the classes of rate [rad/s], (N_RATES + 1,)."""
    out = np.zeros(N_RATES + 1)
    top = max(max_rate, 2 * SLOWEST_RAD_S)
    for c in range(1, N_RATES + 1):
        out[c] = SLOWEST_RAD_S * (top / SLOWEST_RAD_S) ** ((c - 1) / (N_RATES - 1))
    return out


@kernel
def _max_evidence(f, g, times, density, variance, class_rates, occurring):
    """Return the maximum log-evidence that frames before g can still add, (N_RATES, frames + 1).

    Row c is for a class of rate, column k for the frames g - 1 - k and earlier. It is an upper
    bound: it assumes a chain without a miss, and the lowest rate of the class, which is predicted
    best. Rows of classes that are not `occurring` (N_RATES,) are zero.

    `times` [s] are those of all frames; `density` [1/sr] is from `_free_density`, class_rates
    (N_RATES + 1,) [rad/s] from `_class_rates`. `variance` [rad^2] is the smallest of a detection.
    """
    n_back = len(density) - (f - g) - 1
    out = np.zeros((N_RATES, n_back + 1))
    P = np.empty(SIZE)
    for c in range(N_RATES):
        if not occurring[c]:
            continue
        rate = class_rates[c]
        begin_covariance(rate, times[g] - times[f], variance, variance, P)
        at = times[g]
        for k in range(n_back):
            h = g - 1 - k
            dt = times[h] - at
            if dt == 0.0:
                continue
            grow(P, rate, 0.0, dt)
            at = times[h]
            area = 2 * np.pi * (P[0] + variance)
            out[c, k] = max(np.log(P_DETECTION / (density[f - h] * area)), 0.0)
            shrink(P, variance)
        for k in range(n_back - 1, -1, -1):
            out[c, k] += out[c, k + 1]
    return out


@kernel
def _nearest_free(u, variance, brightness, detections, recent, slot, gate2):
    """Return the free detection of a frame that fits u (3,) and `brightness` (3,) best, and the
    chi-squares of its direction and its flux.

    NONE if no free detection is within the gate. `variance` [rad^2] is that of u, `slot` that of
    the frame in `recent`; brightness is that of a track.
    """
    directions, variances, track = detections.directions, detections.variances, detections.track
    start, items = recent.grids[2], recent.grids[3]
    reach = np.sqrt(gate2 * (variance + recent.largest[slot]))
    x_from, x_to, y_from, y_to, side = window(recent.grids, slot, u, reach)
    best, best_chi2, best_unlike = NONE, gate2, 0.0
    if x_from > x_to:
        return best, best_chi2, best_unlike
    lowest = gate2  # sum of both chi-squares; the gate is of the direction alone
    for y in range(y_from, y_to + 1):
        for k in range(start[slot, y * side + x_from], start[slot, y * side + x_to + 1]):
            j = items[slot, k]
            if track[j] != NONE:
                continue
            chi2 = distance2(directions[j], u) / (variance + variances[j])
            if chi2 >= min(gate2, lowest):
                continue
            unlike = brightness_chi2(brightness, detections.log_flux[j])
            if best == NONE or chi2 + unlike < lowest:
                best, best_chi2, best_unlike, lowest = j, chi2, unlike, chi2 + unlike
    return best, best_chi2, best_unlike


@kernel
def _extrapolate(u_f, u_g, chord2, ratio, out):
    """Write to `out` (3,) the direction beyond u_g on the great circle from u_f through u_g.

    It is `ratio` times as far from u_g as u_f is. Series approximate the trigonometric functions:
    they are good for some degrees, which is enough for a first test.
    """
    angle2 = chord2 * (1 + chord2 / 12)
    x2 = ratio * ratio * angle2
    cosine = 1 - x2 / 2 + x2 * x2 / 24
    sines = ratio * (1 - x2 / 6 + x2 * x2 / 120) / (1 - angle2 / 6 + angle2 * angle2 / 120)
    along = 1 - 0.5 * chord2
    for a in range(3):
        out[a] = u_g[a] * (cosine + along * sines) - u_f[a] * sines


@kernel
def _chain_back(pair, detections, recent, rule, frames, best, wanted, scratch):
    """Follow a pair back in time; return the number of detections, the log-evidence, and the
    penalty of unlike fluxes.

    Writes the detections, newest first, to `scratch.members`. The evidence is the log-likelihood
    ratio of one moving object against false alarms, over all detections but the first two; with
    `frames.faint`, of an object that is detected in most frames or in few, whichever is likelier.
    The penalty only ranks chains: an object of changing brightness begins a track as soon as
    another. `frames` is the `_Evidence` of the pairs of both frames, `best` its row for the pair's
    rate. The number is 0 if the evidence can no longer reach `wanted`.
    """
    f, j, g, i = pair.f, pair.j, pair.g, pair.i
    times, directions, variances = detections.times, detections.directions, detections.variances
    u, w, bend, P = scratch.u, scratch.w, scratch.bend, scratch.P
    begin(
        directions[j], times[f], variances[j], directions[i], times[g], variances[i], u, w, bend, P
    )
    scratch.members[0], scratch.members[1] = j, i
    begin_brightness(scratch.brightness)
    learn_brightness(scratch.brightness, detections.log_flux[j])
    learn_brightness(scratch.brightness, detections.log_flux[i])
    n, at = 2, times[g]
    # Log-evidence of an object that is detected in most frames, and of one in few.
    bright, dim = (f - g - 1) * LOG_MISS, -np.inf
    if frames.faint:
        dim = LOG_FAINT + (f - g - 1) * LOG_FAINT_MISS
    # Misses beyond the oldest detection count only if an older one follows: the object may have
    # entered the field there.
    misses, taken = 0, 0.0
    # The chain on this side of the last gap that it reached over: what lies behind is uncertain.
    n_near, evidence_near, taken_near = n, -np.inf, taken
    for k in range(len(best) - 1):
        evidence = max(bright, dim)
        bright_after, dim_after = bright + misses * LOG_MISS, dim + misses * LOG_FAINT_MISS
        if max(evidence, max(bright_after, dim_after) + best[k]) < wanted:
            return 0, evidence, taken
        if frames.faint and misses == MAX_FAINT_MISSES:
            break
        h = g - 1 - k
        dt = times[h] - at
        if dt == 0.0:
            continue
        if -dt > rule.max_coast[h + 1]:
            if max(bright, dim) - evidence_near < MIN_BEHIND_GAP:
                break
            n_near, evidence_near, taken_near = n, max(bright, dim), taken
        grow(P, rate_of(w), rate_of(bend), dt)
        advance(u, w, bend, dt)
        at = times[h]
        slot = h % len(recent.largest)
        m, chi2, unlike = _nearest_free(
            u, P[0], scratch.brightness, detections, recent, slot, rule.gate2
        )
        if m == NONE:
            misses += 1
            continue
        area = 2 * np.pi * (P[0] + variances[m])
        gain = np.log(P_DETECTION / (frames.density[f - h] * area)) - 0.5 * chi2
        # A detection that adds less than the misses before it cost does not belong to the chain.
        if max(bright_after, dim_after + LOG_FAINT_HIT) + gain < evidence:
            misses += 1
            continue
        bright, dim, misses = bright_after + gain, dim_after + LOG_FAINT_HIT + gain, 0
        taken += 0.5 * unlike
        correct(u, w, bend, P, directions[m], variances[m])
        learn_brightness(scratch.brightness, detections.log_flux[m])
        scratch.members[n] = m
        n += 1
    if max(bright, dim) - evidence_near < MIN_BEHIND_GAP:
        return n_near, evidence_near, taken_near
    return n, max(bright, dim), taken


@kernel
def _fastest(best, class_rates, wanted, dt, pairs_sr, rule):
    """Return the maximum rate to search for [rad/s].

    Up to it, chains can reach the evidence `wanted`, and the number of pairs is within the limit.
    `best` (N_RATES, k) is that of `_Evidence`, class_rates (N_RATES + 1,) [rad/s] from
    `_class_rates`. `dt` [s] is the time between the frames. pairs_sr [1/sr], times the solid angle
    about a detection in which the other may lie, is the number of pairs.
    """
    top = 0.0
    for c in range(N_RATES):
        if best[c, 0] >= wanted:
            top = class_rates[c + 1]
    by_pairs = np.sqrt(rule.max_pairs / (np.pi * pairs_sr)) / abs(dt)
    return min(top, by_pairs, rule.max_rate)


@kernel
def _class_of(rate, max_rate):
    """Return the class of a rate [rad/s], 0 to N_RATES - 1, see `_class_rates`."""
    if rate < SLOWEST_RAD_S:
        return 0
    top = max(max_rate, 2 * SLOWEST_RAD_S)
    c = 1 + int((N_RATES - 1) * np.log(rate / SLOWEST_RAD_S) / np.log(top / SLOWEST_RAD_S))
    return min(c, N_RATES - 1)


@kernel
def _occurring_rates(f, g, detections, density, rule):
    """Return the classes of rate of the pairs of two frames, (N_RATES,) bool; all if many pairs.

    `density` [1/sr] is from `_free_density`.
    """
    offsets, track = detections.offsets, detections.track
    out = np.zeros(N_RATES, np.bool_)
    if density[0] * density[f - g] * rule.field_sr**2 > FEW_TO_CLASSIFY:
        out[:] = True
        return out
    dt = detections.times[f] - detections.times[g]
    for j in range(offsets[f], offsets[f + 1]):
        if track[j] != NONE:
            continue
        for i in range(offsets[g], offsets[g + 1]):
            if track[i] == NONE:
                chord2 = distance2(detections.directions[i], detections.directions[j])
                rate = np.sqrt(chord2) / dt
                if rate <= rule.max_rate:
                    out[_class_of(rate, rule.max_rate)] = True
    return out


@kernel
def _may_chain(pair, detections, recent, rule, scratch):
    """Return whether the frame before g has a free detection near the pair's prediction.

    A fast test that may pass too many pairs.
    """
    j, g, i, chord2, dt = pair.j, pair.g, pair.i, pair.chord2, pair.dt
    directions, variances, P = detections.directions, detections.variances, scratch.P
    dt_back = detections.times[g] - detections.times[g - 1]
    begin_covariance(np.sqrt(chord2) / dt, -dt, variances[j], variances[i], P)
    grow(P, np.sqrt(chord2) / dt, 0.0, -dt_back)
    _extrapolate(directions[j], directions[i], chord2, dt_back / dt, scratch.ahead)
    slot = (g - 1) % len(recent.largest)
    begin_brightness(scratch.brightness)
    m, _, _ = _nearest_free(
        scratch.ahead, P[0], scratch.brightness, detections, recent, slot, 1.02 * rule.gate2
    )
    return m != NONE


@kernel
def _try_pair(pair, detections, recent, rule, evidence, chains, scratch):
    """Follow a pair back; keep its chain if it is the strongest of detection j."""
    f, g, times = pair.f, pair.g, detections.times
    row = pair.j - detections.offsets[f]
    best = evidence.best[_class_of(np.sqrt(pair.chord2) / pair.dt, rule.max_rate)]
    wanted = evidence.log_pairs + max(rule.min_evidence, chains.strength[row])
    log_miss = LOG_FAINT_MISS if evidence.faint else LOG_MISS
    if best[0] + (f - g - 1) * log_miss < wanted:
        return
    # Most pairs are false. If a miss would rule a pair out, the next frame decides it quickly.
    if (
        (f - g) * log_miss + best[min(1, len(best) - 1)] < wanted
        and times[g] > times[g - 1]
        and not _may_chain(pair, detections, recent, rule, scratch)
    ):
        return
    n, gained, taken = _chain_back(pair, detections, recent, rule, evidence, best, wanted, scratch)
    strength = gained - taken - evidence.log_pairs
    if n >= rule.min_detections and gained > wanted and strength > chains.strength[row]:
        chains.length[row], chains.strength[row] = n, strength
        chains.members[row, :n] = scratch.members[:n]


@kernel
def _try_pairs(f, g, reach, detections, recent, rule, evidence, chains):
    """Follow all pairs of f and g within `reach` [rad]; keep in `chains`, the `_Chains`, the
    strongest chain of each detection of f."""
    directions, track = detections.directions, detections.track
    scratch = _ChainScratch(
        np.empty(3),
        np.empty(3),
        np.empty(3),
        np.empty(SIZE),
        np.empty(3),
        np.empty(BRIGHTNESS_SIZE),
        np.empty(chains.members.shape[1], np.int64),
    )
    start, items = recent.grids[2], recent.grids[3]
    dt, slot = detections.times[f] - detections.times[g], g % len(recent.largest)
    for j in range(detections.offsets[f], detections.offsets[f + 1]):
        if track[j] != NONE:
            continue
        x_from, x_to, y_from, y_to, side = window(recent.grids, slot, directions[j], reach)
        if x_from > x_to:
            continue
        for y in range(y_from, y_to + 1):
            for k in range(start[slot, y * side + x_from], start[slot, y * side + x_to + 1]):
                i = items[slot, k]
                chord2 = distance2(directions[i], directions[j])
                if track[i] == NONE and chord2 <= reach * reach:
                    pair = _Pair(f, j, g, i, chord2, dt)
                    _try_pair(pair, detections, recent, rule, evidence, chains, scratch)


@kernel
def _useful_depth(of_all, wanted):
    """Return the number of frames back in which a chain is followed.

    In these, the slowest object reaches the evidence `wanted` even with one miss. `of_all`
    (N_RATES, k) is from `_max_evidence`.
    """
    n_back = of_all.shape[1] - 1
    for k in range(1, n_back):
        last = of_all[0, k - 1] - of_all[0, k]
        if of_all[0, 0] - of_all[0, k] > wanted + last - LOG_MISS:
            return k
    return n_back


@kernel
def _of_first(n_back, of_all):
    """Return the maximum log-evidence of the first n_back frames before g, (N_RATES, n_back + 1).

    `of_all` (N_RATES, k) is that of all frames before g, from `_max_evidence`. Its columns are sums
    over a frame and all earlier ones: those too early are taken off.
    """
    out = np.empty((N_RATES, n_back + 1))
    for c in range(N_RATES):
        for k in range(n_back + 1):
            out[c, k] = of_all[c, k] - of_all[c, n_back]
    return out


@kernel
def _strongest_chains(f, depth, detections, recent, rule):
    """Return the strongest chain of each detection of frame f, as `_Chains`.

    Chains are followed over `depth` frames or more, f included, as far as there are frames.
    `recent` are the `RecentFrames`, f among them.
    """
    n, longest = detections.offsets[f + 1] - detections.offsets[f], len(recent.largest) - 1
    times, field_sr = detections.times, rule.field_sr
    chains = _Chains(np.zeros(n, np.int64), np.full(n, -np.inf), np.full((n, longest), NONE))
    density = _free_density(f, longest, detections, field_sr)
    faint = density[0] * field_sr <= MAX_FREE
    if not faint:
        density = density[: rule.min_detections + EXTRA_DETECTIONS]
    class_rates = _class_rates(rule.max_rate)
    variance = recent.smallest.min()
    for g in range(f - 1, max(f - 1 - (FAINT_APART if faint else APART), -1), -1):
        dt = times[f] - times[g]
        if dt <= 0.0 or dt > rule.max_coast[f] or g == 0 or n == 0:
            continue
        pairs_sr = density[0] * density[f - g] * field_sr
        wanted = np.log(pairs_sr * field_sr) + rule.min_evidence
        occurring = _occurring_rates(f, g, detections, density, rule)
        if not occurring.any():
            continue
        occurring[0] = True  # `_useful_depth` needs the slowest class
        of_all = _max_evidence(f, g, times, density, variance, class_rates, occurring)
        n_back = of_all.shape[1] - 1
        if not faint:
            n_back = max(_useful_depth(of_all, wanted), min(depth - (f - g) - 1, n_back))
        best = _of_first(n_back, of_all)
        rate = _fastest(best, class_rates, wanted, dt, pairs_sr, rule)
        if g < f - 1 and pairs_sr * np.pi * (rate * dt) ** 2 > FEW_PAIRS:
            continue
        # No chord is longer than its arc, so this reach holds everything up to that rate.
        evidence = _Evidence(density, best, wanted - rule.min_evidence, faint)
        _try_pairs(f, g, rate * dt, detections, recent, rule, evidence, chains)
    return chains


@kernel
def new_tracks(f, depth, n_tracks, detections, recent, rule):
    """Begin tracks from free detections; each ends in frame f.

    A chain becomes a track if it has at least `rule.min_detections` detections, and more evidence
    than false alarms in this number of pairs. The strongest come first. Each detection is used
    once. Writes `detections.track`, numbered from `n_tracks`. `depth` is the minimum of frames over
    which chains are followed.

    Returns
    -------
    began : (b,) int64
        Rows of frame f that begin a track, in the order of the track numbers.
    length, members : (n,) int64, (n, longest) int64
        Chains of all rows, see `_Chains`.
    """
    track = detections.track
    chains = _strongest_chains(f, depth, detections, recent, rule)
    began = np.empty(len(chains.length), np.int64)
    count = 0
    # A stable sort: the same order in every run.
    for row in np.argsort(-chains.strength, kind="mergesort"):
        if chains.length[row] == 0:
            break
        members = chains.members[row, : chains.length[row]]
        free = True
        for m in members:
            free = free and track[m] == NONE
        if free:
            for m in members:
                track[m] = n_tracks + count
            began[count] = row
            count += 1
    return began[:count], chains.length, chains.members
