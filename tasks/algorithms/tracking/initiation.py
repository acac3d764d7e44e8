"""Track initiation: detections that no track has claimed begin one where they can be no chance.

Pairs of the newest frame and one of the two before it are followed back. Each further
detection adds to the evidence, more so the smaller the place it was foretold for and the fewer
strays there are. What evidence a pair can reach at best is known from its rate before it is
followed: in dense frames most pairs are never looked at, and no track is lost by that.
"""

import numpy as np

from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.tracking.frame_grid import window
from epipole.tasks.algorithms.tracking.sky_filter import (
    advance,
    begin,
    begin_covariance,
    correct,
    distance2,
    grow,
    rate_of,
    shrink,
)

NONE = -1
SEEN = 0.9  # probability that a frame shows an object it looks at
MISSED = np.log(1.0 - SEEN)
N_RATES = 24  # classes of the rate, for which the best evidence is tabulated
SLOWEST_RAD_S = 1e-6  # upper end of the first class
MOST_PAIRS = 500_000  # a frame: where more are possible, the fastest are not looked for
FEW_PAIRS = 50_000  # up to which pairs two frames apart are tried as well


@kernel
def free_density(f, depth, offsets, track, field_sr):
    """Return free detections a steradian in frame f and the frames before it, at least one."""
    out = np.empty(min(depth, f + 1))
    for back in range(len(out)):
        free = 0
        for j in range(offsets[f - back], offsets[f - back + 1]):
            free += track[j] == NONE
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
def _best_evidence(f, g, times, density, variance, class_rates):
    """Return, a class of rate, the most evidence that frames h < g can still add: [class, h'].

    Entry k is for the frames g - 1 - k and before. A chain that hits in every frame is foretold
    best, and the slowest of a class bends least: no chain of the class can gain more.
    """
    n_back = len(density) - (f - g) - 1
    out = np.zeros((N_RATES, n_back + 1))
    P = np.empty(3)
    for c in range(N_RATES):
        rate = class_rates[c]
        begin_covariance(rate, times[g] - times[f], variance, variance, P)
        at = times[g]
        for k in range(n_back):
            h = g - 1 - k
            dt = times[h] - at
            if dt == 0.0:
                continue
            grow(P, rate, dt)
            at = times[h]
            spot = 2 * np.pi * (P[0] + variance)
            out[c, k] = max(np.log(SEEN / (density[f - h] * spot)), 0.0)
            shrink(P, variance)
        for k in range(n_back - 1, -1, -1):
            out[c, k] += out[c, k + 1]
    return out


@kernel
def _nearest_free(u, variance, directions, variances, largest, grids, slot, track, gate2):
    """Return the free detection of a frame that is nearest to u in sigmas, and its chi-square."""
    start, items = grids[2], grids[3]
    reach = np.sqrt(gate2 * (variance + largest))
    x_from, x_to, y_from, y_to, side = window(grids, slot, u, reach)
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
    """Set out to where the great circle from u_f over u_g leads, `ratio` steps on; no trig.

    The series serve steps of some degrees; the exact chain follows where this finds something.
    """
    angle2 = chord2 * (1 + chord2 / 12)
    x2 = ratio * ratio * angle2
    cosine = 1 - x2 / 2 + x2 * x2 / 24
    sines = ratio * (1 - x2 / 6 + x2 * x2 / 120) / (1 - angle2 / 6 + angle2 * angle2 / 120)
    along = 1 - 0.5 * chord2
    for a in range(3):
        out[a] = u_g[a] * (cosine + along * sines) - u_f[a] * sines


@kernel
def _chain_back(
    f, g, i, j, directions, variances, largest, times, grids, n_slots, track, density, gate2,
    best, wanted, u, w, P, members,
):  # fmt: skip
    """Follow the pair (j of frame f, i of frame g) back; return its detections and evidence.

    `members` receives the detections, newest first. The evidence is the log of how much
    likelier one moving object makes the further detections than strays of that density do.
    It is given up where it can no longer become what is wanted.
    """
    begin(directions[j], times[f], variances[j], directions[i], times[g], variances[i], u, w, P)
    members[0], members[1] = j, i
    n, evidence, at = 2, (f - g - 1) * MISSED, times[g]
    waiting = 0.0  # frames missed before the oldest detection so far: it may have entered there
    for k in range(len(best) - 1):
        if max(evidence, evidence + waiting + best[k]) < wanted:
            return 0, evidence
        h = g - 1 - k
        dt = times[h] - at
        if dt == 0.0:
            continue
        grow(P, rate_of(w), dt)
        advance(u, w, dt)
        at = times[h]
        m, chi2 = _nearest_free(
            u, P[0], directions, variances, largest[h % n_slots], grids, h % n_slots, track, gate2
        )
        if m == NONE:
            waiting += MISSED
            continue
        spot = 2 * np.pi * (P[0] + variances[m])
        gain = np.log(SEEN / (density[f - h] * spot)) - 0.5 * chi2 + waiting
        if gain < 0.0:
            waiting += MISSED
            continue
        evidence, waiting = evidence + gain, 0.0
        correct(u, w, P, directions[m], variances[m])
        members[n] = m
        n += 1
    return n, evidence


@kernel
def _fastest(best, class_rates, wanted, dt, pairs_sr, max_rate):
    """Return the highest rate looked for: of use, and with no more pairs than are allowed."""
    top = 0.0
    for c in range(N_RATES):
        if best[c, 0] >= wanted:
            top = class_rates[c + 1]
    most = np.sqrt(MOST_PAIRS / (np.pi * pairs_sr)) / abs(dt)
    return min(top, most, max_rate)


@kernel
def _class_of(rate, max_rate):
    if rate < SLOWEST_RAD_S:
        return 0
    top = max(max_rate, 2 * SLOWEST_RAD_S)
    c = 1 + int((N_RATES - 1) * np.log(rate / SLOWEST_RAD_S) / np.log(top / SLOWEST_RAD_S))
    return min(c, N_RATES - 1)


@kernel
def _may_chain(
    u_f, u_g, var_f, var_g, chord2, dt, dt_back, directions, variances, largest, grids, slot,
    track, gate2, P, ahead,
):  # fmt: skip
    """Return whether the frame before a pair shows something where the pair leads; quickly."""
    begin_covariance(np.sqrt(chord2) / dt, -dt, var_f, var_g, P)
    grow(P, np.sqrt(chord2) / dt, -dt_back)
    _foretell(u_f, u_g, chord2, dt_back / dt, ahead)
    j, _ = _nearest_free(
        ahead, P[0], directions, variances, largest, grids, slot, track, 1.02 * gate2
    )
    return j != NONE


@kernel
def _try_pairs(
    f, g, reach, times, offsets, directions, variances, largest, grids, n_slots, track, density,
    gate2, need, tries, enough, best, max_rate, held, strength, chains,
):  # fmt: skip
    """Follow all pairs within reach; keep the strongest chain of each detection of frame f."""
    u, w, P, ahead = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    members = np.empty(chains.shape[1], np.int64)
    start, items = grids[2], grids[3]
    dt, slot = times[f] - times[g], g % n_slots
    for row in range(len(held)):
        j = offsets[f] + row
        if track[j] != NONE:
            continue
        x_from, x_to, y_from, y_to, side = window(grids, slot, directions[j], reach)
        if x_from > x_to:
            continue
        for y in range(y_from, y_to + 1):
            for k in range(start[slot, y * side + x_from], start[slot, y * side + x_to + 1]):
                i = items[slot, k]
                chord2 = distance2(directions[i], directions[j])
                if track[i] != NONE or chord2 > reach * reach:
                    continue
                bound = best[_class_of(np.sqrt(chord2) / dt, max_rate)]
                wanted = tries + max(enough, strength[row])
                if bound[0] + (f - g - 1) * MISSED < wanted:
                    continue
                # Most pairs lead nowhere; where they cannot afford a miss, that settles it.
                if (
                    (f - g) * MISSED + bound[min(1, len(bound) - 1)] < wanted
                    and times[g] > times[g - 1]
                    and not _may_chain(
                        directions[j], directions[i], variances[j], variances[i], chord2, dt,
                        times[g] - times[g - 1], directions, variances,
                        largest[(g - 1) % n_slots], grids, (g - 1) % n_slots, track, gate2, P,
                        ahead,
                    )
                ):  # fmt: skip
                    continue
                got, evidence = _chain_back(
                    f, g, i, j, directions, variances, largest, times, grids, n_slots, track,
                    density, gate2, bound, wanted, u, w, P, members,
                )  # fmt: skip
                if got >= need and evidence > wanted:
                    held[row], strength[row] = got, evidence - tries
                    chains[row, :got] = members[:got]


@kernel
def _useful_depth(best, wanted):
    """Return how many frames back are worth following: enough for the slowest, with a miss."""
    n_back = best.shape[1] - 1
    for k in range(1, n_back):
        last = best[0, k - 1] - best[0, k]
        if best[0, 0] - best[0, k] > wanted + last - MISSED:
            return k
    return n_back


@kernel
def new_tracks(
    f, depth, deepest, times, offsets, directions, variances, smallest, largest, grids, n_slots,
    track, n_tracks, max_rate, max_coast, need, gate2, field_sr, enough,
):  # fmt: skip
    """Begin tracks that end in frame f from detections no track has claimed.

    A chain begins a track if it gathers `need` detections and more evidence than the number of
    pairs tried lets chance have. The strongest come first; a detection serves once. Returns
    the rows of frame f that begin one, in the order of their numbers, with all rows' counts of
    detections and chains; `track` is filled in.
    """
    n = offsets[f + 1] - offsets[f]
    held, strength = np.zeros(n, np.int64), np.full(n, -np.inf)
    chains = np.full((n, deepest), NONE)
    density = free_density(f, deepest, offsets, track, field_sr)
    class_rates = _class_rates(max_rate)
    variance = smallest.min()
    for g in range(f - 1, max(f - 3, -1), -1):
        dt = times[f] - times[g]
        if dt <= 0.0 or dt > max_coast or g == 0 or n == 0:
            continue
        pairs_sr = density[0] * density[f - g] * field_sr
        wanted = np.log(pairs_sr * field_sr) + enough
        best = _best_evidence(f, g, times, density, variance, class_rates)
        n_back = max(_useful_depth(best, wanted), min(depth - (f - g) - 1, best.shape[1] - 1))
        for c in range(N_RATES):
            best[c] -= best[c, n_back]
        best = best[:, : n_back + 1].copy()
        rate = _fastest(best, class_rates, wanted, dt, pairs_sr, max_rate)
        if g < f - 1 and pairs_sr * np.pi * (rate * dt) ** 2 > FEW_PAIRS:
            continue
        # No chord is longer than the arc, so this reach holds all that is slow enough.
        _try_pairs(
            f, g, rate * dt, times, offsets, directions, variances, largest, grids, n_slots,
            track, density, gate2, need, wanted - enough, enough, best, max_rate, held, strength,
            chains,
        )  # fmt: skip
    begun = np.empty(n, np.int64)
    count = 0
    # A stable sort: the same order on every run.
    for row in np.argsort(-strength, kind="mergesort"):
        if held[row] == 0:
            break
        free = True
        for m in range(held[row]):
            free = free and track[chains[row, m]] == NONE
        if free:
            for m in range(held[row]):
                track[chains[row, m]] = n_tracks + count
            begun[count] = row
            count += 1
    return begun[:count], held, chains
