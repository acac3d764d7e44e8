"""Grouping: tracklets that are one object, by the evidence of the orbit through all of them.

The evidence of a set of tracklets is the density of their attributables if they are one object of
the population, times the number of objects. So the log odds that two sets are one object, and not
two, are the difference of the log evidences.

1. The pair with the largest odds is joined first, if no rival contradicts it (`_join_all`).
2. Short tracklets say little in pairs, and enough by three or more: single tracklets join loosely.
3. Of loosely joined sets those stay that all others of the set support (`_confirm`).
4. What was released may join again, by the rule of step 1.
5. So may sets and single tracklets hours before or after a set, by its orbit (`_far_edges`).

Kernels share n `tracklets`, `alone` (n,), the log evidence of each by itself, and the orbit of each
set in the row of its root: `epoch_s` (n,) [s] and `states` (n, 6) [km, km/s], GCRF.
"""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.tasks.algorithms.earth_gravity import advance
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.orbit_linking.arc_fit import (
    STEP_S,
    Tracklets,
    fit_arc,
    fit_work,
    sort_rows,
)
from epipole.tasks.algorithms.orbit_linking.arc_search import (
    ArcEnds,
    all_near_tracklets,
    move,
    near_orbits,
    no_ends,
    sound_ends,
)
from epipole.tasks.algorithms.orbit_linking.height_search import later_pairs
from epipole.tasks.algorithms.orbit_linking.pair_search import (
    GATE,
    dot,
    join_pair,
    may_be_one,
    near_pairs,
    packed_tracklets,
)
from epipole.tasks.algorithms.orbit_linking.population import log_attributable_density

NONE = -1  # no tracklet
# Longest gap that pairs of any eccentricity are searched over; longer ones are `height_search`.
NEAR_S = 900.0
# Members of each set that the joint orbit is fitted to, those nearest in time to the other set:
# more of them do not change the answer, nor does half, and an orbit over hours needs more forces.
MAX_MEMBERS = 8
MAX_ARC_S = 1800.0  # the propagation is right to 5 m in this time, see `arc_fit.STEP_S`
# Members that support another are this near in time [s]: as near as the longest gap of a pair. With
# less, both sides of a long gap are never compared, and two objects of a shell may stay joined.
SUPPORT_S = 2400.0
# Chi-square by which the joint fit may be worse than both alone: quantile 1 - 1e-5 for 2, 4 and 6
# degrees of freedom (tracklet and tracklet, set and tracklet, set and set).
GATES = (23.03, 28.47, 33.38)
# Gate of a set's chi-square, in sigmas above its degrees of freedom. With half of it,
# bench_orbit_linking finds 1 to 2 of 100 objects less.
SET_SIGMA = 5.0
KEPT_LOG_ODDS = -8.0  # of a pair: a third tracklet may yet show that it is one object
# Of a join that further tracklets have to confirm. In a shell of 1,584 objects with 3 tracklets a
# second it raises the objects found from 57 to 81 of 100; with 2.0 to 78; none of them wrongly.
LOOSE_LOG_ODDS = 0.0
# Two tracklets alone that are this near in time need more log odds: in a shell, whose orbits are
# alike, neighbours meet more often than the population says. All nine wrong pairs in 60,000 links
# of simulated shells were less than a minute apart, with log odds of 7 to 9. With this rule three
# in 74,000 are wrong.
SHORT_S, SHORT_LOG_ODDS = 120.0, 2.0


class Edges(NamedTuple):
    """Pairs of tracklets that may be one object, best first.

    pair : (e, 2) int
    odds : (e,) float
        Log odds that they are one object.
    epoch_s, state : (e,), (e, 6) float
        Their orbit [km, km/s], GCRF.
    reach_s : (e,) float
        Members of both sets this near to the epoch are compared [s].
    offsets, row : (n + 1,), (2 e,) int
        The edges of tracklet k are ``row[offsets[k]:offsets[k + 1]]``, best first.
    """

    pair: Indices
    odds: Array
    epoch_s: Array
    state: Array
    reach_s: Array
    offsets: Indices
    row: Indices


class LinkedTracklets(NamedTuple):
    """Which tracklets are one object.

    label : (n,) int
        Row of one of the object's tracklets, the same for all of them.
    epoch_s, state : (n,), (n, 6) float
        In that row, if the object was joined: the orbit [km, km/s] of its last join, GCRF, and its
        epoch. Known objects of several tracklets may have one too. NaN in other rows.
    """

    label: Indices
    epoch_s: Array
    state: Array


class Sets(NamedTuple):
    """Sets of tracklets: `root` (n,) of each; the members of a set as a chain from its root."""

    root: Indices
    next: Indices
    last: Indices
    size: Indices


def link_tracklets(
    tracklets: Tracklets,
    known: Indices,
    *,
    max_gap_s: float,
    log_odds: float,
    max_orbit_gap_s: float = 0.0,
) -> LinkedTracklets:
    """Return which tracklets are one object.

    Forces: two bodies and J2. What they neglect is noise that grows with time (`arc_fit`).

    Parameters
    ----------
    tracklets
        Sorted by time.
    known : (n,) int
        Objects that are known already, from 0; -1 for tracklets of none.
    max_gap_s
        Longest time between two tracklets that are compared [s].
    log_odds
        Minimum log odds of a join, also against any that contradicts it.
    max_orbit_gap_s
        Longest time between a set of several tracklets and a set or tracklet compared with it [s].
    """
    n, known = len(known), np.array(known, np.int64)
    alone = log_attributable_density(tracklets.r_km, tracklets.v_km_s, tracklets.u, tracklets.w)
    edges = _edges(tracklets, known, alone, max_gap_s)
    sets = Sets(np.arange(n), np.full(n, NONE), np.arange(n), np.ones(n, np.int64))
    epoch_s, state = np.full(n, np.nan), np.full((n, 6), np.nan)
    _join_known(known, np.full(n, NONE), sets)
    is_loose = np.zeros(n, bool)
    _join_all(tracklets, alone, edges, log_odds, False, sets, is_loose, epoch_s, state)
    _join_all(tracklets, alone, edges, LOOSE_LOG_ODDS, True, sets, is_loose, epoch_s, state)
    _confirm(tracklets, alone, _stays(known), log_odds, sets, is_loose, epoch_s, state)
    _join_all(tracklets, alone, edges, log_odds, False, sets, is_loose, epoch_s, state)
    if max_orbit_gap_s > 0.0:
        _begin_known(tracklets, alone, sets, epoch_s, state)
        far = _far_edges(tracklets, alone, sets, epoch_s, state, max_orbit_gap_s)
        _join_all(tracklets, alone, far, log_odds, False, sets, is_loose, epoch_s, state)
    return LinkedTracklets(sets.root, epoch_s, state)


def _stays(known: Indices) -> Flags:
    """Return which tracklets belong to a known object of several: no join releases them."""
    count = np.bincount(np.maximum(known, 0), known >= 0)
    return np.asarray((known >= 0) & (count[np.maximum(known, 0)] > 1))


def _edges(tracklets: Tracklets, known: Indices, alone: Array, max_gap_s: float) -> Edges:
    packed = packed_tracklets(tracklets)
    near = near_pairs(tracklets, packed, known, min(max_gap_s, NEAR_S))
    later = later_pairs(tracklets, packed, known, max_gap_s)
    pairs, states = (np.concatenate(both) for both in zip(near, later, strict=True))
    odds, epoch_s = np.empty(len(pairs)), np.empty(len(pairs))
    _score(tracklets, alone, pairs, odds, epoch_s, states)
    gap_s = tracklets.time_s[pairs[:, 1]] - tracklets.time_s[pairs[:, 0]]
    reach_s = gap_s / 2 + MAX_ARC_S / 2
    return _best_first(len(known), pairs, odds, epoch_s, states, reach_s)


def _best_first(
    n: int, pairs: Indices, odds: Array, epoch_s: Array, states: Array, reach_s: Array
) -> Edges:
    """Return the edges of n tracklets, those that cannot become one object left out."""
    kept = np.flatnonzero(odds > KEPT_LOG_ODDS)
    # Best first; ties by time. A pair that was found with several orbits keeps the best.
    order = kept[np.lexsort((pairs[kept, 1], pairs[kept, 0], -odds[kept]))]
    _, once = np.unique(pairs[order] @ np.array([n, 1]), return_index=True)
    order = order[np.sort(once)]
    pairs = pairs[order]
    ends, row = pairs.T.ravel(), np.tile(np.arange(len(order)), 2)
    by_end = np.lexsort((row, ends))
    offsets = np.searchsorted(ends[by_end], np.arange(n + 1))
    return Edges(
        pairs, odds[order], epoch_s[order], states[order], reach_s[order], offsets, row[by_end]
    )


def _far_edges(
    tracklets: Tracklets, alone: Array, sets: Sets, epoch_s: Array, state: Array, max_gap_s: float
) -> Edges:
    """Return the edges from ends of sets to later sets, and to single tracklets and pairs."""
    n = len(sets.root)
    roots = np.flatnonzero((sets.root == np.arange(n)) & np.isfinite(epoch_s))
    heads, tails = no_ends(len(roots)), no_ends(len(roots))
    _fit_ends(tracklets, alone, sets, roots, epoch_s, state, heads, tails)
    heads, tails = sound_ends(heads), sound_ends(tails)
    pairs = near_orbits(tails, heads, max_gap_s)
    edges = [_between(tails, pairs[:, 0], heads.row[pairs[:, 1]], heads.time_s[pairs[:, 1]])]
    # After an hour the orbit of a pair is too uncertain to be compared with another orbit.
    free = np.flatnonzero(sets.size[sets.root] <= 2)
    for ends, way in ((tails, 1), (heads, -1)):
        end, k = all_near_tracklets(ends, tracklets, free, way, NEAR_S, max_gap_s).T
        edges.append(_between(ends, end, k, tracklets.time_s[k]))
    rows, middle_s, states, reach_s = (np.concatenate(each) for each in zip(*edges, strict=True))
    odds = np.empty(len(rows))
    _score_sets(tracklets, alone, sets, rows, middle_s, states, reach_s, odds)
    return _best_first(n, rows, odds, middle_s, states, reach_s)


def _between(
    ends: ArcEnds, end: Indices, row: Indices, time_s: Array
) -> tuple[Indices, Array, Array, Array]:
    """Return pairs of ends of arcs and other tracklets: rows, middle, orbit there, reach."""
    middle_s = (ends.time_s[end] + time_s) / 2
    states = ends.state[end]
    move(states, middle_s - ends.epoch_s[end])
    reach_s = np.abs(middle_s - time_s) + MAX_ARC_S / 2
    rows = np.sort(np.stack([ends.row[end], row], axis=1), axis=1)
    return rows, middle_s, states, reach_s


@kernel
def _fit_ends(tracklets, alone, sets, roots, epoch_s, states, heads, tails):
    """Write orbits of `roots` (s,) by first members to `heads`, by last to `tails`, if one fits."""
    work, rows = fit_work(), np.empty(MAX_MEMBERS, np.int64)
    for s in range(len(roots)):
        root = roots[s]
        first, last, k = root, root, root
        while k != NONE:
            if tracklets.time_s[k] < tracklets.time_s[first]:
                first = k
            if tracklets.time_s[k] > tracklets.time_s[last]:
                last = k
            k = sets.next[k]
        for side in range(2):
            ends, k = (heads, first) if side == 0 else (tails, last)
            at_s = tracklets.time_s[k]
            count = _nearest(tracklets, sets, root, at_s, MAX_ARC_S, NONE, rows)
            if count < 2:
                continue
            evidence, _, _, epoch, state = _sum(
                tracklets, alone, rows[:count], epoch_s[root], states[root], work
            )
            if np.isfinite(evidence):
                ends.row[s], ends.time_s[s], ends.epoch_s[s] = k, at_s, epoch
                ends.state[s] = state


@kernel
def _score_sets(tracklets, alone, sets, rows, epoch_s, states, reach_s, odds):
    """Write the log odds that the sets of two rows are one object; -inf where they cannot be.

    Arrays as in `Edges`, of p pairs, `rows` (p, 2). Writes `odds`; `states` become joint orbits.
    """
    work = fit_work()
    for p in range(len(rows)):
        a, b = sets.root[rows[p, 0]], sets.root[rows[p, 1]]
        odds[p] = -np.inf
        if _compatible(tracklets, sets, a, b):
            gain, orbit_s, orbit = _odds(
                tracklets, alone, sets, a, b, epoch_s[p], reach_s[p], epoch_s[p], states[p], work
            )
            if np.isfinite(gain):
                odds[p] = gain
                advance(orbit, epoch_s[p] - orbit_s, STEP_S, work.steps)
                for m in range(6):
                    states[p, m] = orbit[m]


@kernel
def _score(tracklets, alone, pairs, odds, epoch_s, states):
    """Write the `odds` (p,) of pairs (p, 2), NaN as -inf, and their orbits in the middle of both.

    `states` (p, 6) are at the earlier epoch before, then at `epoch_s` (p,), which is written too.
    """
    work = fit_work()
    for p in range(len(pairs)):
        i, j = pairs[p, 0], pairs[p, 1]
        epoch_s[p] = 0.5 * (tracklets.time_s[i] + tracklets.time_s[j])
        advance(states[p], epoch_s[p] - tracklets.time_s[i], STEP_S, work.steps)
        evidence, _ = fit_arc(tracklets, pairs[p], epoch_s[p], states[p], work)
        odds[p] = evidence - alone[i] - alone[j]
        if np.isnan(odds[p]):
            odds[p] = -np.inf


@kernel
def _unite(sets, a, b):
    """Append set b to set a, which are roots; the set's root is the smaller one."""
    if b < a:
        a, b = b, a
    sets.next[sets.last[a]] = b
    sets.last[a] = sets.last[b]
    sets.size[a] += sets.size[b]
    k = b
    while k != NONE:
        sets.root[k] = a
        k = sets.next[k]


@kernel
def _join_known(known, first, sets):
    """Unite the tracklets of each known object; `first` (n,) is scratch, of `NONE`."""
    for k in range(len(known)):
        if known[k] >= 0:
            if first[known[k]] == NONE:
                first[known[k]] = k
            else:
                _unite(sets, sets.root[first[known[k]]], k)


@kernel
def _begin_known(tracklets, alone, sets, epoch_s, states):
    """Write an orbit of each known set that nothing joined: that of the pair that fits it best."""
    work, rows = fit_work(), np.empty(MAX_MEMBERS, np.int64)
    begin, scratch = np.empty(6), np.empty((8, 3))
    for root in range(len(epoch_s)):
        if sets.root[root] != root or sets.size[root] < 2 or np.isfinite(epoch_s[root]):
            continue
        at_s, best = tracklets.time_s[root], -np.inf
        count = _nearest(tracklets, sets, root, at_s, MAX_ARC_S, NONE, rows)
        sort_rows(rows[:count])
        for a in range(count):
            for b in range(a + 1, count):
                i, j = rows[a], rows[b]
                first_km = np.sqrt(dot(tracklets.r_km[i], tracklets.r_km[i]))
                if not join_pair(tracklets, i, j, first_km, begin, scratch) < GATE:
                    continue
                evidence, _, _, epoch, state = _sum(
                    tracklets, alone, rows[:count], tracklets.time_s[i], begin, work
                )
                if evidence > best:
                    best, epoch_s[root] = evidence, epoch
                    states[root] = state


@kernel
def _nearest(tracklets, sets, root, at_s, reach_s, but, out):
    """Write at most MAX_MEMBERS members of a set that are nearest in time; return their number.

    To `out` (MAX_MEMBERS,), nearest to at_s first, within reach_s. Member `but` is left out.
    """
    count = 0
    k = root
    while k != NONE:
        gap = abs(tracklets.time_s[k] - at_s)
        if gap <= reach_s and k != but:
            at = count
            if count == MAX_MEMBERS:
                at = count - 1
                if gap >= abs(tracklets.time_s[out[at]] - at_s):
                    k = sets.next[k]
                    continue
            else:
                count += 1
            while at > 0 and gap < abs(tracklets.time_s[out[at - 1]] - at_s):
                out[at] = out[at - 1]
                at -= 1
            out[at] = k
        k = sets.next[k]
    return count


@kernel
def _compatible(tracklets, sets, a, b):
    """Return whether no sensor saw a member of each at one time."""
    i = a
    while i != NONE:
        j = b
        while j != NONE:
            if not may_be_one(tracklets, i, j):
                return False
            j = sets.next[j]
        i = sets.next[i]
    return True


@kernel
def _sum(tracklets, alone, members, start_s, start, work):
    """Return log evidence, chi-square and degrees of freedom of a set, and its epoch and orbit.

    `members` (m,) are sorted by time here. NaN: no orbit converges from `start` (6,) at `start_s`.
    """
    state = start.copy()
    if len(members) == 1:
        return alone[members[0]], 0.0, 0, start_s, state
    sort_rows(members)
    epoch = 0.0
    for k in members:
        epoch += tracklets.time_s[k] / len(members)
    advance(state, epoch - start_s, STEP_S, work.steps)
    evidence, chi2 = fit_arc(tracklets, members, epoch, state, work)
    return evidence, chi2, 4 * len(members) - 6, epoch, state


@kernel
def _gain(tracklets, alone, a, b, start_s, start, work):
    """Return the log odds that members a (i,) and b (j,) are one object, their epoch and orbit.

    -inf where one orbit does not fit both, NaN where a or b alone is not one object.
    """
    both = np.empty(len(a) + len(b), np.int64)
    for m in range(len(both)):
        both[m] = a[m] if m < len(a) else b[m - len(a)]
    joint, chi2, dof, epoch, state = _sum(tracklets, alone, both, start_s, start, work)
    if not np.isfinite(joint):
        return -np.inf, epoch, state
    gain, freedom = joint, dof
    for side in range(2):
        part = a if side == 0 else b
        evidence, of_part, dof_part, _, _ = _sum(tracklets, alone, part, epoch, state, work)
        if not np.isfinite(evidence):
            return np.nan, epoch, state
        if of_part > dof_part + SET_SIGMA * np.sqrt(2.0 * dof_part):
            return np.nan, epoch, state
        gain -= evidence
        chi2 -= of_part
        freedom -= dof_part
    if chi2 > GATES[min(max(freedom // 2 - 1, 0), 2)]:
        return -np.inf, epoch, state
    return gain, epoch, state


@kernel
def _odds(tracklets, alone, sets, a, b, at_s, reach_s, start_s, start, work):
    """Return `_gain` of the sets a and b, by their members within `reach_s` of `at_s` [s]."""
    rows_a, rows_b = np.empty(MAX_MEMBERS, np.int64), np.empty(MAX_MEMBERS, np.int64)
    n_a = _nearest(tracklets, sets, a, at_s, reach_s, NONE, rows_a)
    n_b = _nearest(tracklets, sets, b, at_s, reach_s, NONE, rows_b)
    if n_a == 0 or n_b == 0:
        return -np.inf, start_s, start.copy()
    return _gain(tracklets, alone, rows_a[:n_a], rows_b[:n_b], start_s, start, work)


@kernel
def _has_rival(tracklets, alone, edges, sets, edge, end, minimum, orbit_s, orbit, work):
    """Return whether one end of an edge fits a third tracklet that contradicts the other end."""
    i, j = edges.pair[edge, end], edges.pair[edge, 1 - end]
    a, b = sets.root[i], sets.root[j]
    for m in range(edges.offsets[i], edges.offsets[i + 1]):
        other = edges.row[m]
        if edges.odds[other] < minimum:
            break
        k = edges.pair[other, 0] + edges.pair[other, 1] - i
        c = sets.root[k]
        if c in (a, b):
            continue
        linked = False
        for q in range(edges.offsets[k], edges.offsets[k + 1]):
            third = edges.row[q]
            if edges.pair[third, 0] + edges.pair[third, 1] - k == j:
                linked = True
                break
        if linked:
            continue
        if not _compatible(tracklets, sets, b, c):
            return True
        at_s = tracklets.time_s[k]
        odds, _, _ = _odds(
            tracklets, alone, sets, b, c, at_s, edges.reach_s[edge], orbit_s, orbit, work
        )
        if not odds > KEPT_LOG_ODDS:
            return True
    return False


@kernel
def _support(tracklets, alone, sets, root, k, start_s, start, work):
    """Return the log odds that tracklet k of a set is one object with the others near its time."""
    rows, one = np.empty(MAX_MEMBERS, np.int64), np.full(1, k)
    count = _nearest(tracklets, sets, root, tracklets.time_s[k], SUPPORT_S, k, rows)
    if count == 0:
        return -np.inf
    return _gain(tracklets, alone, rows[:count], one, start_s, start, work)[0]


@kernel
def _weakest(tracklets, alone, stays, sets, root, log_odds, epoch_s, states, work):
    """Return the member of a set that the others support least, NONE if each has the log odds.

    Members that are flagged in `stays` (n,) are not asked.
    """
    weakest, lowest = NONE, log_odds
    k = root
    while k != NONE:
        if not stays[k]:
            gain = _support(tracklets, alone, sets, root, k, epoch_s[root], states[root], work)
            if not gain >= lowest:
                weakest, lowest = k, gain if np.isfinite(gain) else -np.inf
        k = sets.next[k]
    return weakest


@kernel
def _release(sets, root, k):
    """Take tracklet k out of a set of several; return the root of the others."""
    first = sets.next[k] if k == root else root
    j = root
    while j != NONE:
        after = sets.next[j]
        if j != k:
            sets.root[j] = first
            if after == k:
                sets.next[j] = sets.next[k]
                if sets.next[k] == NONE:
                    sets.last[root] = j
        j = after
    last, size = sets.last[root], sets.size[root]
    sets.last[first], sets.size[first] = last, size - 1
    sets.root[k], sets.next[k], sets.last[k], sets.size[k] = k, NONE, k, 1
    return first


@kernel
def _confirm(tracklets, alone, stays, log_odds, sets, is_loose, epoch_s, states):
    """Release the tracklets of loosely joined sets that the others of the set do not support.

    A loose pair is always released: if its odds suffice, a rival prevented the join.
    """
    work = fit_work()
    for label in range(len(stays)):
        root = label
        if not is_loose[root] or sets.root[root] != root:
            continue
        while sets.size[root] > 1:
            k = _weakest(tracklets, alone, stays, sets, root, log_odds, epoch_s, states, work)
            if k == NONE:
                if sets.size[root] > 2:
                    break
                k = root if not stays[root] else sets.next[root]
                if stays[k]:  # `_begin_known` finds its orbit again
                    epoch_s[root] = np.nan
                    break
            first = _release(sets, root, k)
            if first != root:
                epoch_s[first] = epoch_s[root]
                states[first] = states[root]
                epoch_s[root], root = np.nan, first
        if sets.size[root] == 1:
            epoch_s[root] = np.nan


@kernel
def _join_all(tracklets, alone, edges, log_odds, loosely, sets, is_loose, epoch_s, states):
    """Join sets, best pairs first, until nothing changes; write the orbit of each join.

    `loosely` joins single tracklets only, and marks the sets in `is_loose` (n,), by their roots.
    """
    work = fit_work()
    tried = np.full(len(edges.odds), NONE)  # size of both sets at the last attempt
    joined = True
    while joined:  # a join may make others possible
        joined = False
        for edge in range(len(edges.odds)):
            i, j = edges.pair[edge, 0], edges.pair[edge, 1]
            a, b = sets.root[i], sets.root[j]
            size = sets.size[a] + sets.size[b]
            if a == b or tried[edge] == size or (loosely and min(sets.size[a], sets.size[b]) > 1):
                continue
            tried[edge] = size
            if not _compatible(tracklets, sets, a, b):
                continue
            at_s, state, reach_s = edges.epoch_s[edge], edges.state[edge], edges.reach_s[edge]
            gain, orbit_s, orbit = _odds(
                tracklets, alone, sets, a, b, at_s, reach_s, at_s, state, work
            )
            wanted = log_odds
            if size == 2 and abs(tracklets.time_s[i] - tracklets.time_s[j]) < SHORT_S:
                wanted += SHORT_LOG_ODDS
            if not gain >= wanted:
                continue
            minimum = edges.odds[edge] - wanted
            rival = False
            for end in range(2):
                rival = rival or _has_rival(
                    tracklets, alone, edges, sets, edge, end, minimum, orbit_s, orbit, work
                )
            if rival:
                continue
            epoch_s[min(a, b)] = orbit_s
            for m in range(6):
                states[min(a, b), m] = orbit[m]
            is_loose[min(a, b)] = is_loose[a] or is_loose[b] or loosely
            _unite(sets, a, b)
            joined = True
