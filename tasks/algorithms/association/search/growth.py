"""Growth: a seed of two tracklets becomes a hypothesis as tracklets of other sensors join it.

For each seed, `grow_all` goes through these steps (2 to 5 are `_grow`):

1. The sensors that share space with both sensors of the seed are looked up.
2. The seed's points are solved, and the sensors that may see them are listed (`_begin`).
3. Sensor after sensor, the tracklet that adds most to the odds joins (`_join_others`). The seed is
   given up as soon as the other sensors make it improbable. Those of the seed come last.
4. Members that do not fit are dropped, the worst first (`_settle`).
5. The first members were chosen with inaccurate points: they are chosen again (`_review`).
6. The hypothesis is scored, and taken at once if it is clear (`_is_clear`).
"""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.tasks.algorithms.association.odds import (
    near_fields,
    nearest_range2,
    next_mark,
    score,
    should_detect,
)
from epipole.tasks.algorithms.association.search.candidates import best_of_sensor, lasts_throughout
from epipole.tasks.algorithms.association.search.field_index import sensors_sharing
from epipole.tasks.algorithms.association.search.instant_points import (
    join,
    n_seeing,
    possible,
    solve,
)
from epipole.tasks.algorithms.association.search.search_space import doubled
from epipole.tasks.algorithms.association.search.sight_lines import quantile
from epipole.tasks.algorithms.association.views import error_sr, residual, residual_chi2
from epipole.tasks.algorithms.kernels import borrowing_kernel, inlined_kernel, kernel

# A seed is given up if the other sensors add less than these log-odds, and its points are in the
# fields of at least this number of them. With one sensor, or -2, small scenes of bench_association
# come out with other odds; with six, or -8, they do not.
GIVE_UP_LOG_ODDS, MIN_LOOKS = -4.0, 3
MIN_GAIN = 2.0  # minimum log-odds that a view adds to a well-known point, to join it
MIN_LEAD = 5.0  # minimum difference of the log-odds of a sensor's best view and the next one
MIN_REVIEWED = 4  # minimum number of views of a hypothesis that is reviewed
WELL_KNOWN = 8  # number of views from which points are well known: choices need no review
MIN_COMPLETENESS = 0.85  # minimum share of the expected detections that a clear hypothesis has
REVIEWS = 2  # with a single one, a false member may still distort the points
DROPPED_TOGETHER = 64  # drop 1 + n // 64 of n members per pass


class Grown(NamedTuple):
    """The h hypotheses that seeds have grown into.

    seed : (h,) int
        The seed of each.
    score : (h,) float
        Log-odds.
    taken : (h,) bool
        It is clear, and its tracklets are entered in `SearchSpace.taken`.
    x_km : (h, 3) float
        Position at the first solved instant [km], GCRF.
    first_member, member : (h + 1,), (n,) int
        Tracklets of hypothesis q are ``member[first_member[q]:first_member[q + 1]]``, in order.
    first_missed, missed : (h + 1,), (m,) int
        The same for the sensors that miss it.
    """

    seed: Indices
    score: Array
    taken: Flags
    x_km: Array
    first_member: Indices
    member: Indices
    first_missed: Indices
    missed: Indices


@kernel
def grow_all(space, work, seeds, clear, min_score):
    """Return the hypotheses that the seeds grow into, as `Grown`.

    Parameters
    ----------
    space, work
        `SearchSpace` and `WorkSpace`.
    seeds : (n, 2) int
        Pairs of tracklets. A pair of which one was taken since is skipped.
    clear : float
        Log-odds at which a hypothesis is taken at once, see `_is_clear`. Its tracklets are
        entered in `space.taken`.
    min_score : float
        Minimum log-odds of a hypothesis that is returned.
    """
    sensor, taken, members = space.views.sensor, space.taken, work.members
    h, n_nearby, a, b = 0, 0, -1, -1
    grown = Grown(
        np.empty(4, np.int64), np.empty(4), np.empty(4, np.bool_), np.empty((4, 3)),
        np.zeros(5, np.int64), np.empty(64, np.int64),
        np.zeros(5, np.int64), np.empty(64, np.int64),
    )  # fmt: skip
    for q in range(len(seeds)):
        if taken[seeds[q, 0]] or taken[seeds[q, 1]]:
            continue
        members[0], members[1] = seeds[q, 0], seeds[q, 1]
        if sensor[members[0]] != a or sensor[members[1]] != b:
            a, b = sensor[members[0]], sensor[members[1]]
            n_nearby = sensors_sharing(
                space.fields, a, b, work.stamp, next_mark(work.stamp), work.nearby
            )
            work.nearby[:n_nearby].sort()
        n, n_near = _grow(space, work, members, work.nearby[:n_nearby])
        if n < 2 or not possible(space, members[:n], work.points):
            continue
        value, _, n_missed = score(space, work, members[:n], work.near[:n_near])
        if not value > min_score:
            continue
        is_clear = _is_clear(space, work, members[:n], n_missed, value, clear)
        grown = _with_space(grown, h, n, n_missed)
        grown.seed[h], grown.score[h], grown.taken[h] = q, value, is_clear
        _enter(grown, h, work, n, n_missed)
        h += 1
        if is_clear:
            for i in members[:n]:
                taken[i] = True
    return Grown(
        grown.seed[:h], grown.score[:h], grown.taken[:h], grown.x_km[:h],
        grown.first_member[: h + 1], grown.member[: grown.first_member[h]],
        grown.first_missed[: h + 1], grown.missed[: grown.first_missed[h]],
    )  # fmt: skip


@kernel
def _with_space(grown, h, n, n_missed):
    """Return `grown` with space for hypothesis h, of n members and `n_missed` sensors.

    Where its arrays are full, those returned are longer ones with the same first values.
    """
    seed, value, taken, x_km, first_member, member, first_missed, missed = grown
    if h == len(seed):
        seed, value, taken, x_km = (
            doubled(seed, h), doubled(value, h), doubled(taken, h), doubled(x_km, h),
        )  # fmt: skip
        first_member, first_missed = doubled(first_member, h + 1), doubled(first_missed, h + 1)
    while first_member[h] + n > len(member):
        member = doubled(member, first_member[h])
    while first_missed[h] + n_missed > len(missed):
        missed = doubled(missed, first_missed[h])
    return Grown(seed, value, taken, x_km, first_member, member, first_missed, missed)


@kernel
def _enter(grown, h, work, n, n_missed):
    """Enter the hypothesis of `work` as number h: its point, its members, the sensors it misses.

    They are the first n of `work.members` and the first `n_missed` of `work.missed`.
    """
    at, at_missed = grown.first_member[h], grown.first_missed[h]
    grown.first_member[h + 1], grown.first_missed[h + 1] = at + n, at_missed + n_missed
    grown.x_km[h] = work.points.x_km[np.argmax(work.points.seen_by >= 2)]
    of_it = grown.member[at : at + n]
    of_it[:] = work.members[:n]
    of_it.sort()
    grown.missed[at_missed : at_missed + n_missed] = work.missed[:n_missed]


@borrowing_kernel
def _grow(space, work, members, nearby):
    """Grow the first two members; return the size and the number of sensors in `work.near`.

    The size is 0 if the seed is given up. `members` (t + 2,) is changed in place; `nearby` (n,) are
    the sensors that share space with those of the seed, in order.
    """
    sensor = space.views.sensor
    seed_sensors = sensor[members[0]], sensor[members[1]]
    n, n_near, n_early = _join_others(space, work, members, nearby)
    if n < 2:
        return np.int64(0), np.int64(0)
    for s in seed_sensors:  # they may have another fragment of the object
        before = n
        n, _, _ = _join_sensor(space, work, s, members, n, 0.0)
        if n < 0:
            return np.int64(0), np.int64(0)
        if n > before and before < WELL_KNOWN:
            n_early = min(n, np.int64(WELL_KNOWN))
    if n < 2 * WELL_KNOWN:
        n = _settle(space, work, members, n)
    for _ in range(REVIEWS if n < 2 * WELL_KNOWN else 1):
        if n >= MIN_REVIEWED:
            n = _review(space, work, members, n, n_early)
    return n, n_near


@inlined_kernel
def _join_others(space, work, members, nearby):
    """Give each sensor near the seed's points a turn, but not the two sensors of the seed.

    The tracklets of a sensor that add most to the odds join, and a miss lowers them. The seed is
    given up as soon as these log-odds are below `GIVE_UP_LOG_ODDS` (Wald's sequential test). The
    turns begin at the first sensor of the seed, and go round.

    Returns the size, 0 if the seed is given up; the number of sensors in `work.near`; and the
    number of early members, which joined before the points were well known. Arguments as in
    `_grow`.
    """
    views, near, had_turn = space.views, work.near, next_mark(work.stamp)
    n = np.int64(2)  # for numba a literal 2 has another type: all would be compiled twice
    n_early = np.int64(0)
    n_near = _begin(space, work, members[:n], nearby)
    if n_near < 0:
        return np.int64(0), n_near, n_early
    a, b = views.sensor[members[0]], views.sensor[members[1]]
    work.stamp[a] = work.stamp[b] = had_turn
    evidence, n_looked = 0.0, 0  # log-odds that the sensors add, and how many should detect it
    while True:
        first = np.searchsorted(near[:n_near], a)
        nearest2 = nearest_range2(views, members[:n], work.points)
        for turn in range(n_near):
            s = near[(first + turn) % n_near]
            if work.stamp[s] == had_turn:
                continue
            work.stamp[s] = had_turn
            before = n
            n, evidence, detected = _join_sensor(space, work, s, members, n, evidence)
            if n < 0:
                return np.int64(0), n_near, n_early
            if n > before and before < WELL_KNOWN:
                n_early = min(n, np.int64(WELL_KNOWN))
                nearest2 = nearest_range2(views, members[:n], work.points)
            elif n > before:  # the points hardly move
                nearest2 = min(nearest2, nearest_range2(views, members[before:n], work.points))
            expected = detected or should_detect(views, s, work.points, nearest2)
            n_looked += expected
            if expected and not detected:
                evidence += np.log(1.0 - space.chance.detected[s])
            if n_looked >= MIN_LOOKS and evidence < GIVE_UP_LOG_ODDS:
                return np.int64(0), n_near, n_early
        if n == 2 or not _has_unsolved_instant(views, members[:n], work.points.seen_by):
            return n, n_near, n_early
        # With more points, other sensors may be near: those that had no turn get one.
        n = _settle(space, work, members, n)
        if n < 2:
            return n, n_near, n_early
        n_near = np.int64(near_fields(views, work.points, nearby, near))


@borrowing_kernel
def _begin(space, work, members, nearby):
    """Solve the points of a seed; return the number of sensors near them, -1 if impossible.

    `members` (2,) are its tracklets, `nearby` (n,) the sensors that may be near. Writes
    `work.points`, and the sensors to `work.near`.
    """
    points = work.points
    points.seen_by[:] = 0
    chi2, dof = solve(space.views, members, points, work.part)
    if not chi2 <= quantile(max(dof, 1), space.gate_sigma):
        return np.int64(-1)
    if not possible(space, members, points):
        return np.int64(-1)
    return np.int64(near_fields(space.views, points, nearby, work.near))


@borrowing_kernel
def _has_unsolved_instant(views, members, seen_by):
    """Return whether two members share an instant that is not solved.

    At first only those of the seed are solved. Other sensors may see the object at others.
    `members` (n,) are tracklets, `seen_by` (k,) as in `InstantPoints`.
    """
    unsolved = False
    for m in range(len(seen_by)):
        unsolved |= seen_by[m] < 2 and n_seeing(views, members, m) >= 2
    return unsolved


@inlined_kernel
def _join_sensor(space, work, s, members, n, evidence):
    """Add the tracklets of sensor s that fit to the members, the first n of `members` (t + 2,).

    Updates `work.points`. Returns the new size (-1 if a point can no longer be solved), the
    log-odds `evidence` with what the tracklets add, and whether the sensor detects the object. It
    also does if two tracklets fit about equally well, so that neither joins.
    """
    views, detected, n_same = space.views, False, 0
    for i in members[:2]:
        if views.sensor[i] == s:
            work.same_sensor[n_same] = i
            n_same += 1
    while n < len(members):
        known = n >= WELL_KNOWN
        min_score = MIN_GAIN if known else np.log(1.0 - space.chance.detected[s])
        c, gain, second = best_of_sensor(space, work, s, work.same_sensor[:n_same], min_score)
        if c < 0 or (known and second > MIN_GAIN and gain - second < MIN_LEAD):
            detected |= c >= 0
            break
        detected = True
        evidence += gain
        members[n], work.same_sensor[n_same] = c, c
        n += 1
        n_same += 1
        if not join(views, c, work.points, work.part):
            return np.int64(-1), evidence, detected
        # A sensor has only one tracklet of an object at a time.
        if lasts_throughout(views, c, work.points.seen_by):
            break
    return n, evidence, detected


@borrowing_kernel
def _settle(space, work, members, n):
    """Solve the points and drop the members that fit worst, until all fit; return the size.

    Changes the first n of `members` (t + 2,), and `work.points`. The seed's tracklets may be
    dropped too. Large hypotheses drop several at a time, so the cost does not grow with the square
    of their size. The size is 0 if no two members fit.
    """
    views, part = space.views, work.part
    X, _, _, seen_by = work.points
    while n >= 2:
        chi2, dof = solve(views, members[:n], work.points, part)
        if dof > 0 and chi2 <= quantile(dof, space.gate_sigma):
            return n
        if n == 2:
            break
        for q in range(n):
            total, shared = 0.0, 1e-9  # a member without a solved instant has chi-square 0
            for m in range(len(views.time_s)):
                if seen_by[m] < 2 or not views.seen[members[q], m]:
                    continue
                if residual(views, members[q], m, X[m], part) == 0.0:  # behind the sensor
                    total = np.inf
                total += residual_chi2(part)
                shared += 1
            work.member_chi2[q] = total / shared
        for _ in range(1 + n // DROPPED_TOGETHER):
            worst = 0
            for q in range(n):
                worst = q if work.member_chi2[q] > work.member_chi2[worst] else worst
            for q in range(worst, n - 1):
                members[q], work.member_chi2[q] = members[q + 1], work.member_chi2[q + 1]
            n -= 1
        if np.isnan(chi2):
            seen_by[:] = 0  # start again: these points are invalid
    return np.int64(0)


@borrowing_kernel
def _review(space, work, members, n, n_early):
    """Choose anew among the tracklets of the early members' sensors; return the size.

    Changes `members` (t + 2,), of which the first n count. The first `n_early` were chosen with
    points from few views; now the points are well known. A false member does more harm than a miss.
    So a tracklet joins only if it adds at least `MIN_GAIN`, and leads the sensor's next best one by
    `MIN_LEAD` if that one adds as much. All other members stay if they still fit. If fewer than
    `MIN_REVIEWED` - 1 would be left, all stay that fit.
    """
    views, before, reviewed = space.views, work.before, next_mark(work.stamp)
    n_reviewed = _list_sensors(views, work, members[: min(n_early, n)], reviewed)
    for q in range(n):
        before[q] = members[q]
    kept = np.int64(0)
    for i in before[:n]:
        if work.stamp[views.sensor[i]] != reviewed and _still_fits(space, work, i):
            members[kept] = i
            kept += 1
    for s in work.reviewed[:n_reviewed]:
        n_same = 0
        while kept < len(members):
            c, gain, second = best_of_sensor(space, work, s, work.same_sensor[:n_same], MIN_GAIN)
            if c < 0 or (second > MIN_GAIN and gain - second < MIN_LEAD):
                break
            members[kept], work.same_sensor[n_same] = c, c
            kept += 1
            n_same += 1
            if lasts_throughout(views, c, work.points.seen_by):
                break
    if kept < MIN_REVIEWED - 1:
        kept = n
        for q in range(n):
            members[q] = before[q]
    return _settle(space, work, members, kept)


@borrowing_kernel
def _list_sensors(views, work, members, mark):
    """Write the sensors of `members` (n,), in increasing order, to `work.reviewed`.

    Returns their number. Each gets the `mark` in `work.stamp`.
    """
    listed, stamp, n = work.reviewed, work.stamp, 0
    for i in members:
        s = views.sensor[i]
        if stamp[s] == mark:
            continue
        stamp[s] = mark
        slot = n
        while slot > 0 and listed[slot - 1] > s:
            listed[slot] = listed[slot - 1]
            slot -= 1
        listed[slot] = s
        n += 1
    return n


@borrowing_kernel
def _still_fits(space, work, i):
    """Return whether member i still adds `MIN_GAIN` log-odds, at the first shared instant."""
    views, chance, points, part = space.views, space.chance, work.points, work.part
    for m in range(len(views.time_s)):
        if points.seen_by[m] >= 2 and views.seen[i, m]:
            s = views.sensor[i]
            if residual(views, i, m, points.x_km[m], part) == 0.0:
                return False
            odds = np.log(chance.detected[s] / (chance.density[s] * error_sr(views, i, m, part)))
            return odds - 0.5 * residual_chi2(part) >= MIN_GAIN
    return True


@borrowing_kernel
def _is_clear(space, work, members, n_missed, value, clear):
    """Return whether a hypothesis may be taken at once.

    It needs many views, and about the expected number of detections by the sensors that have it in
    their field. A mixture of two objects' tracklets fits only some of these sensors. `members` (n,)
    are its tracklets, the first `n_missed` of `work.missed` the sensors that miss it; its log-odds
    `value` must exceed `clear`.
    """
    if not (value > clear and len(members) >= WELL_KNOWN):
        return False
    views, detected = space.views, space.chance.detected
    n_detecting, expected, mark = 0, 0.0, next_mark(work.stamp)
    for i in members:
        s = views.sensor[i]
        if work.stamp[s] != mark:
            work.stamp[s] = mark
            n_detecting += 1
            expected += detected[s]
    for s in work.missed[:n_missed]:
        expected += detected[s]
    return n_detecting >= MIN_COMPLETENESS * expected
