"""Track initiation: detections that no track has claimed begin one where chance is ruled out.

Pairs of a detection in the newest frame and one in the two frames before it are followed back in
time. Each further detection adds to the evidence: the more, the better its place was predicted and
the fewer false alarms there are. A pair's rate limits the evidence that it can reach. Pairs that
cannot reach enough are not followed. These are most pairs in dense frames, and no track is lost.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.kernels import kernel
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

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

NONE = -1
P_DETECTION = 0.9  # probability that an object in the field is detected in a frame
MISSED = np.log(1.0 - P_DETECTION)
N_RATES = 24  # classes of the rate, for which the best evidence is tabulated
SLOWEST_RAD_S = 1e-6  # upper end of the first class
MAX_PAIRS = 500_000  # per frame, however few frames there are
FEW_TO_ASK = 1_000  # up to so many pairs, only the classes of rate that they have are tabulated
FEW_PAIRS = 50_000  # up to so many, pairs that are two frames apart are tried as well


class Detections(NamedTuple):
    """Detections of one sensor; frame k has the rows offsets[k]:offsets[k + 1].

    times, offsets : (f,) float, (f + 1,) int64, of frames
    frame_of, directions, variances : (n,) int64, (n, 3), (n,) float, of detections
    track : (n,) int64, the track of each detection, NONE while it has none; kernels write it
    """

    times: Array
    offsets: Indices
    frame_of: Indices
    directions: Array
    variances: Array
    track: Indices


class RecentFrames(NamedTuple):
    """The newest frames, frame f in slot f modulo their number.

    grids : see `frame_grid.make_grids`
    smallest, largest : (slots,) float, of the variances in each frame
    """

    grids: tuple[Array, Array, Indices, Indices]
    smallest: Array
    largest: Array


class TrackRule(NamedTuple):
    """What makes a track, and what ends one.

    max_rate : fastest motion [rad/s]
    max_coast, max_missed : longest time [s], and most frames in a row, without a detection
    need : fewest detections that begin a track
    gate2 : squared distance in sigmas within which a detection continues a track
    field_sr : solid angle of the field
    enough : evidence (ln) beyond the number of pairs tried that begins a track
    most_pairs : per frame; where more are possible, the fastest objects are not searched for
    """

    max_rate: float
    max_coast: float
    max_missed: int
    need: int
    gate2: float
    field_sr: float
    enough: float
    most_pairs: float


class _Pair(NamedTuple):
    """Detection j of frame f and detection i of the earlier frame g.

    chord2, dt : squared chord between them, and time between the frames
    """

    f: int
    j: int
    g: int
    i: int
    chord2: float
    dt: float


class _Evidence(NamedTuple):
    """What pairs of two frames are judged by.

    density : (depth,) float, free detections per steradian in the newest frame and those before
    best : (N_RATES, k) float, the evidence that can still be added, see `_best_evidence`
    tries : ln of the number of pairs that chance has
    """

    density: Array
    best: Array
    tries: float


class _Chains(NamedTuple):
    """The strongest chain of each detection of the newest frame.

    held, strength : (n,) int64 and float, number of detections and evidence
    members : (n, longest) int64, detections, newest first
    """

    held: Indices
    strength: Array
    members: Indices


class _ChainScratch(NamedTuple):
    """Room for one chain: the filter's state, a predicted direction, detections.

    u, w, bend, P : see `sky_filter`
    """

    u: Array
    w: Array
    bend: Array
    P: Array
    ahead: Array
    members: Indices


@kernel
def _free_density(f, depth, detections, field_sr):
    """Return free detections per steradian in frame f and the frames before it; at least one
    detection is counted in each."""
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
    """Return the lower ends of the classes of rate, and the end of the last."""
    out = np.zeros(N_RATES + 1)
    top = max(max_rate, 2 * SLOWEST_RAD_S)
    for c in range(1, N_RATES + 1):
        out[c] = SLOWEST_RAD_S * (top / SLOWEST_RAD_S) ** ((c - 1) / (N_RATES - 1))
    return out


@kernel
def _best_evidence(f, g, times, density, variance, class_rates, asked):
    """Return the most evidence that frames before g can still add, (N_RATES, frames + 1).

    Only for the classes of rate that are asked for; none in the others.

    Row c is for a class of rate, column k for the frames g - 1 - k and before. Predictions are best
    for a chain without a miss, and for the slowest of a class, which bends least. So no chain of
    the class can gain more.
    """
    n_back = len(density) - (f - g) - 1
    out = np.zeros((N_RATES, n_back + 1))
    P = np.empty(SIZE)
    for c in range(N_RATES):
        if not asked[c]:
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
            spot = 2 * np.pi * (P[0] + variance)
            out[c, k] = max(np.log(P_DETECTION / (density[f - h] * spot)), 0.0)
            shrink(P, variance)
        for k in range(n_back - 1, -1, -1):
            out[c, k] += out[c, k + 1]
    return out


@kernel
def _nearest_free(u, variance, detections, recent, slot, gate2):
    """Return the free detection of a frame that is nearest to u in sigmas, and its chi-square."""
    directions, variances, track = detections.directions, detections.variances, detections.track
    start, items = recent.grids[2], recent.grids[3]
    reach = np.sqrt(gate2 * (variance + recent.largest[slot]))
    x_from, x_to, y_from, y_to, side = window(recent.grids, slot, u, reach)
    best, best_chi2 = NONE, gate2
    if x_from > x_to:
        return best, best_chi2
    for y in range(y_from, y_to + 1):
        for k in range(start[slot, y * side + x_from], start[slot, y * side + x_to + 1]):
            j = items[slot, k]
            if track[j] != NONE:
                continue
            chi2 = distance2(directions[j], u) / (variance + variances[j])
            if chi2 < best_chi2:
                best, best_chi2 = j, chi2
    return best, best_chi2


@kernel
def _foretell(u_f, u_g, chord2, ratio, out):
    """Write the direction that the great circle from u_f over u_g reaches after `ratio` steps.

    Series instead of trigonometric functions, for steps of some degrees. Where something is found
    there, the exact chain is followed.
    """
    angle2 = chord2 * (1 + chord2 / 12)
    x2 = ratio * ratio * angle2
    cosine = 1 - x2 / 2 + x2 * x2 / 24
    sines = ratio * (1 - x2 / 6 + x2 * x2 / 120) / (1 - angle2 / 6 + angle2 * angle2 / 120)
    along = 1 - 0.5 * chord2
    for a in range(3):
        out[a] = u_g[a] * (cosine + along * sines) - u_f[a] * sines


@kernel
def _chain_back(pair, detections, recent, rule, density, best, wanted, room):
    """Follow a pair back in time; return the number of its detections and its evidence.

    Writes the detections, newest first, to `room.members`. The evidence is the log likelihood
    ratio of one moving object against false alarms of that density, for all detections but the
    first two. Where it can no longer reach what is wanted, the chain is given up.
    """
    f, j, g, i = pair.f, pair.j, pair.g, pair.i
    times, directions, variances = detections.times, detections.directions, detections.variances
    u, w, bend, P = room.u, room.w, room.bend, room.P
    begin(
        directions[j], times[f], variances[j], directions[i], times[g], variances[i], u, w, bend, P
    )
    room.members[0], room.members[1] = j, i
    n, evidence, at = 2, (f - g - 1) * MISSED, times[g]
    waiting = 0.0  # misses before the oldest detection so far: the object may have entered there
    for k in range(len(best) - 1):
        if max(evidence, evidence + waiting + best[k]) < wanted:
            return 0, evidence
        h = g - 1 - k
        dt = times[h] - at
        if dt == 0.0:
            continue
        grow(P, rate_of(w), rate_of(bend), dt)
        advance(u, w, bend, dt)
        at = times[h]
        slot = h % len(recent.largest)
        m, chi2 = _nearest_free(u, P[0], detections, recent, slot, rule.gate2)
        if m == NONE:
            waiting += MISSED
            continue
        spot = 2 * np.pi * (P[0] + variances[m])
        gain = np.log(P_DETECTION / (density[f - h] * spot)) - 0.5 * chi2 + waiting
        if gain < 0.0:
            waiting += MISSED
            continue
        evidence, waiting = evidence + gain, 0.0
        correct(u, w, bend, P, directions[m], variances[m])
        room.members[n] = m
        n += 1
    return n, evidence


@kernel
def _fastest(best, class_rates, wanted, dt, pairs_sr, rule):
    """Return the highest rate to search for: chains can reach the evidence wanted, and the pairs
    are not too many."""
    top = 0.0
    for c in range(N_RATES):
        if best[c, 0] >= wanted:
            top = class_rates[c + 1]
    most = np.sqrt(rule.most_pairs / (np.pi * pairs_sr)) / abs(dt)
    return min(top, most, rule.max_rate)


@kernel
def _class_of(rate, max_rate):
    if rate < SLOWEST_RAD_S:
        return 0
    top = max(max_rate, 2 * SLOWEST_RAD_S)
    c = 1 + int((N_RATES - 1) * np.log(rate / SLOWEST_RAD_S) / np.log(top / SLOWEST_RAD_S))
    return min(c, N_RATES - 1)


@kernel
def _asked_rates(f, g, detections, density, rule):
    """Return which classes of rate the pairs of two frames may have: all where they are many."""
    offsets, track = detections.offsets, detections.track
    out = np.zeros(N_RATES, np.bool_)
    if density[0] * density[f - g] * rule.field_sr**2 > FEW_TO_ASK:
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
def _may_chain(pair, detections, recent, rule, room):
    """Return whether the frame before a pair has a detection where the pair leads; quickly."""
    j, g, i, chord2, dt = pair.j, pair.g, pair.i, pair.chord2, pair.dt
    directions, variances, P = detections.directions, detections.variances, room.P
    dt_back = detections.times[g] - detections.times[g - 1]
    begin_covariance(np.sqrt(chord2) / dt, -dt, variances[j], variances[i], P)
    grow(P, np.sqrt(chord2) / dt, 0.0, -dt_back)
    _foretell(directions[j], directions[i], chord2, dt_back / dt, room.ahead)
    slot = (g - 1) % len(recent.largest)
    m, _ = _nearest_free(room.ahead, P[0], detections, recent, slot, 1.02 * rule.gate2)
    return m != NONE


@kernel
def _try_pair(pair, detections, recent, rule, evidence, chains, room):
    """Follow a pair back; keep its chain where it is the strongest of its detection."""
    f, g, times = pair.f, pair.g, detections.times
    row = pair.j - detections.offsets[f]
    best = evidence.best[_class_of(np.sqrt(pair.chord2) / pair.dt, rule.max_rate)]
    wanted = evidence.tries + max(rule.enough, chains.strength[row])
    if best[0] + (f - g - 1) * MISSED < wanted:
        return
    # Most pairs lead nowhere. Where a pair cannot afford a miss, one look ahead settles that.
    if (
        (f - g) * MISSED + best[min(1, len(best) - 1)] < wanted
        and times[g] > times[g - 1]
        and not _may_chain(pair, detections, recent, rule, room)
    ):
        return
    n, gained = _chain_back(pair, detections, recent, rule, evidence.density, best, wanted, room)
    if n >= rule.need and gained > wanted:
        chains.held[row], chains.strength[row] = n, gained - evidence.tries
        chains.members[row, :n] = room.members[:n]


@kernel
def _try_pairs(f, g, reach, detections, recent, rule, evidence, chains):
    """Follow all pairs within reach; keep the strongest chain of each detection of frame f."""
    directions, track = detections.directions, detections.track
    room = _ChainScratch(
        np.empty(3),
        np.empty(3),
        np.empty(3),
        np.empty(SIZE),
        np.empty(3),
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
                    _try_pair(pair, detections, recent, rule, evidence, chains, room)


@kernel
def _useful_depth(best, wanted):
    """Return how many frames back a chain is followed: enough for the slowest, with one miss."""
    n_back = best.shape[1] - 1
    for k in range(1, n_back):
        last = best[0, k - 1] - best[0, k]
        if best[0, 0] - best[0, k] > wanted + last - MISSED:
            return k
    return n_back


@kernel
def _strongest_chains(f, depth, detections, recent, rule):
    """Return the strongest chain of each detection of frame f."""
    n, longest = detections.offsets[f + 1] - detections.offsets[f], len(recent.largest) - 1
    times, field_sr = detections.times, rule.field_sr
    chains = _Chains(np.zeros(n, np.int64), np.full(n, -np.inf), np.full((n, longest), NONE))
    density = _free_density(f, longest, detections, field_sr)
    class_rates = _class_rates(rule.max_rate)
    variance = recent.smallest.min()
    for g in range(f - 1, max(f - 3, -1), -1):
        dt = times[f] - times[g]
        if dt <= 0.0 or dt > rule.max_coast or g == 0 or n == 0:
            continue
        pairs_sr = density[0] * density[f - g] * field_sr
        wanted = np.log(pairs_sr * field_sr) + rule.enough
        asked = _asked_rates(f, g, detections, density, rule)
        if not asked.any():
            continue
        asked[0] = True  # tells how far back a chain is followed
        best = _best_evidence(f, g, times, density, variance, class_rates, asked)
        n_back = max(_useful_depth(best, wanted), min(depth - (f - g) - 1, best.shape[1] - 1))
        for c in range(N_RATES):
            best[c] -= best[c, n_back]
        best = best[:, : n_back + 1].copy()
        rate = _fastest(best, class_rates, wanted, dt, pairs_sr, rule)
        if g < f - 1 and pairs_sr * np.pi * (rate * dt) ** 2 > FEW_PAIRS:
            continue
        # No chord is longer than its arc, so this reach holds everything up to that rate.
        evidence = _Evidence(density, best, wanted - rule.enough)
        _try_pairs(f, g, rate * dt, detections, recent, rule, evidence, chains)
    return chains


@kernel
def new_tracks(f, depth, n_tracks, detections, recent, rule):
    """Begin tracks that end in frame f from detections that no track has claimed.

    A chain begins a track if it has `rule.need` detections and more evidence than chance reaches
    in so many pairs. The strongest come first, and a detection serves once. Returns the rows of
    frame f that begin a track, in the order of the tracks' numbers, and for all rows the counts of
    detections and the chains. Fills in `detections.track`.
    """
    track = detections.track
    chains = _strongest_chains(f, depth, detections, recent, rule)
    begun = np.empty(len(chains.held), np.int64)
    count = 0
    # A stable sort: the same order in every run.
    for row in np.argsort(-chains.strength, kind="mergesort"):
        if chains.held[row] == 0:
            break
        members = chains.members[row, : chains.held[row]]
        free = True
        for m in members:
            free = free and track[m] == NONE
        if free:
            for m in members:
                track[m] = n_tracks + count
            begun[count] = row
            count += 1
    return begun[:count], chains.held, chains.members
