"""Growth: a seed of two tracklets becomes a hypothesis as tracklets of other sensors join it.

For each seed, `grow_all` goes through these steps (2 to 5 are `_grow`):

1. The sensors that share space with both sensors of the seed are looked up.
2. The seed's points are solved, and the sensors that may see them are listed (`_begin`).
3. Sensor after sensor, the tracklet that adds most to the odds joins (`_join_sensor`). The seed is
   given up as soon as the other sensors are clearly against it.
4. Members that do not fit are dropped, the worst first (`_settle`).
5. The first members were chosen by inaccurate points: they are chosen again (`_review`).
6. The hypothesis is scored, and taken at once if it is clear (`_clear_of_doubt`).
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.association.odds import (
    farthest_range2,
    near_fields,
    next_mark,
    score,
    should_detect,
)
from epipole.tasks.algorithms.association.search.candidates import best_of_sensor, fills
from epipole.tasks.algorithms.association.search.field_index import sensors_sharing
from epipole.tasks.algorithms.association.search.instant_points import join, possible, solve
from epipole.tasks.algorithms.association.search.sight_lines import quantile
from epipole.tasks.algorithms.association.views import SPOT_SR, misfit, residual
from epipole.tasks.algorithms.kernels import borrowing_kernel, inlined_kernel, kernel

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

FEW = 3  # sensors that must have looked before a hypothesis is given up
GIVEN_UP = -4.0  # log-odds of the sensors beside the seed's at which it is given up
SPEAKS = 2.0  # log-odds at which a view of a well-known point is clearly of the object
CONTESTED = 5.0  # log-odds by which the best view of a sensor must lead the next one
ENOUGH = 4  # views that fix a point well enough to choose them all again
WELL_KNOWN = 8  # views after which a sensor's choice needs no review
COMPLETE = 0.85  # of the expected detections, those of a clear hypothesis
REVIEWS = 2  # the first may still rest on a false member
DROPPED_TOGETHER = 64  # 1 + n // 64 of n members are dropped per pass


class Grown(NamedTuple):
    """The h hypotheses that seeds have grown into.

    seed : (h,) int
        The seed of each.
    score : (h,) float
        Log-odds.
    taken : (h,) bool
        It is clear, and its tracklets are entered in `SearchSpace.taken`.
    x_km : (h, 3) float
        Position at the first instant.
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
def grow_all(space, work, seeds, clear, least):
    """Return what the seeds grow into, as `Grown`.

    Parameters
    ----------
    space, work
        `SearchSpace` and `WorkSpace`.
    seeds : (n, 2) int
        Pairs of tracklets. A pair of which one was taken since is skipped.
    clear : float
        Log-odds at which a hypothesis is taken at once, see `_clear_of_doubt`. Its tracklets are
        entered in `space.taken`.
    least : float
        Hypotheses of lower log-odds are left out.
    """
    views, taken = space.views, space.taken
    members = work.members
    h, n_nearby, a, b = 0, 0, -1, -1
    seed, value_of, clears = np.empty(4, np.int64), np.empty(4), np.empty(4, np.bool_)
    x_km, member, missed = np.empty((4, 3)), np.empty(64, np.int64), np.empty(64, np.int64)
    first_member, first_missed = np.zeros(5, np.int64), np.zeros(5, np.int64)
    for q in range(len(seeds)):
        if taken[seeds[q, 0]] or taken[seeds[q, 1]]:
            continue
        members[0], members[1] = seeds[q, 0], seeds[q, 1]
        if views.sensor[members[0]] != a or views.sensor[members[1]] != b:
            a, b = views.sensor[members[0]], views.sensor[members[1]]
            n_nearby = sensors_sharing(
                space.fields, a, b, work.stamp, next_mark(work.stamp), work.nearby
            )
            work.nearby[:n_nearby].sort()
        n, n_near = _grow(space, work, members, work.nearby[:n_nearby])
        if n < 2 or not possible(space, members[:n], work.points):
            continue
        value, n_missed = score(space, work, members[:n], work.near[:n_near])
        if not value > least:
            continue
        if h == len(seed):
            seed, value_of, clears = _more(seed, h), _more(value_of, h), _more(clears, h)
            x_km = _more(x_km, h)
            first_member, first_missed = _more(first_member, h + 1), _more(first_missed, h + 1)
        begin, skip = first_member[h], first_missed[h]
        member, missed = _room(member, begin, n), _room(missed, skip, n_missed)
        member[begin : begin + n] = members[:n]
        missed[skip : skip + n_missed] = work.missed[:n_missed]
        x_km[h] = work.points.x_km[np.argmax(work.points.seen_by >= 2)]
        member[begin : begin + n].sort()
        is_clear = _clear_of_doubt(space, work, members[:n], n_missed, value, clear)
        seed[h], value_of[h], clears[h] = q, value, is_clear
        h += 1
        first_member[h], first_missed[h] = begin + n, skip + n_missed
        if is_clear:
            for i in members[:n]:
                taken[i] = True
    return Grown(
        seed[:h], value_of[:h], clears[:h], x_km[:h],
        first_member[: h + 1], member[: first_member[h]],
        first_missed[: h + 1], missed[: first_missed[h]],
    )  # fmt: skip


@borrowing_kernel
def _grow(space, work, members, nearby):
    """Grow the first two members; return the size and the number of sensors in `work.near`.

    The size is 0 where the hypothesis fails. Sensor after sensor, the tracklet that adds most to
    the odds joins. A miss counts against the hypothesis. It is given up as soon as the other
    sensors speak clearly against it (Wald's sequential test).
    """
    views, near = space.views, work.near
    n = np.int64(2)  # a plain 2 is a type of its own to numba: all would compile twice
    n_near = _begin(space, work, members[:n], nearby)
    if n_near < 0:
        return np.int64(0), np.int64(0)
    a, b = views.sensor[members[0]], views.sensor[members[1]]
    evidence, looked, early = 0.0, 0, np.int64(0)
    farthest2 = farthest_range2(views, members[:n], work.points)
    begin = 0
    while begin < n_near and near[begin] < a:
        begin += 1
    for turn in range(n_near + 2):
        # The seed's own sensors come last: they may hold another fragment of the object.
        if turn < n_near:
            s = near[(begin + turn) % n_near]
            if s in (a, b):
                continue
        else:
            s = a if turn == n_near else b
        before = n
        n, evidence, detected = _join_sensor(space, work, s, members, n, evidence)
        if n < 0:
            return np.int64(0), np.int64(0)
        if n > before and before < WELL_KNOWN:
            early = min(n, np.int64(WELL_KNOWN))
            farthest2 = farthest_range2(views, members[:n], work.points)
        elif n > before:
            more = farthest_range2(views, members[before:n], work.points)
            farthest2 = max(farthest2, more)
        if turn < n_near:
            expected = detected or should_detect(views, s, work.points, farthest2)
            looked += expected
            if expected and not detected:
                evidence += np.log(1.0 - space.chance.detected[s])
            if looked >= FEW and evidence < GIVEN_UP:
                return np.int64(0), np.int64(0)
    if n < 2 * WELL_KNOWN:
        n = _settle(space, work, members, n)
    for _ in range(REVIEWS if n < 2 * WELL_KNOWN else 1):
        if n >= ENOUGH:
            n = _review(space, work, members, n, early)
    return n, n_near


@borrowing_kernel
def _begin(space, work, members, nearby):
    """Solve the points of a seed; return how many sensors may see them, -1 if none can be there."""
    points = work.points
    points.seen_by[:] = 0
    chi2, dof = solve(space.views, members, points, work.part)
    if not chi2 <= quantile(max(dof, 1), space.gate_sigma):
        return np.int64(-1)
    if not possible(space, members, points):
        return np.int64(-1)
    return np.int64(near_fields(space.views, points, nearby, work.near))


@inlined_kernel
def _join_sensor(space, work, s, members, n, evidence):
    """Add the tracklets of sensor s that fit to the members.

    Returns the new size (-1 where a point cannot be solved any more), the log-odds `evidence`
    with what they add, and whether the sensor detects the object: it does also where two
    tracklets are about equal and none joins.
    """
    views, detected, n_own = space.views, False, 0
    for i in members[:2]:
        if views.sensor[i] == s:
            work.own[n_own] = i
            n_own += 1
    while n < len(members):
        known = n >= WELL_KNOWN
        least = SPEAKS if known else np.log(1.0 - space.chance.detected[s])
        c, gain, second = best_of_sensor(space, work, s, work.own[:n_own], least)
        if c < 0 or (known and second > SPEAKS and gain - second < CONTESTED):
            detected |= c >= 0
            break
        detected = True
        evidence += gain
        members[n], work.own[n_own] = c, c
        n += 1
        n_own += 1
        if not join(views, c, work.points, work.part):
            return np.int64(-1), evidence, detected
        # A sensor has one tracklet of an object at a time.
        if fills(views, c, work.points.seen_by):
            break
    return n, evidence, detected


@borrowing_kernel
def _settle(space, work, members, n):
    """Solve, and drop the members that fit worst until all fit; return the size.

    The seed's tracklets may be dropped too. One is dropped at a time, of many a share: so the work
    goes with their number. 0 where fewer than two are left.
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
            total, shared = 0.0, 1e-9
            for m in range(len(views.time_s)):
                if seen_by[m] < 2 or not views.seen[members[q], m]:
                    continue
                if residual(views, members[q], m, X[m], part) == 0.0:
                    total = np.inf
                total += misfit(part)
                shared += 1
            work.misfit[q] = total / shared
        for _ in range(1 + n // DROPPED_TOGETHER):
            worst = 0
            for q in range(n):
                worst = q if work.misfit[q] > work.misfit[worst] else worst
            for q in range(worst, n - 1):
                members[q], work.misfit[q] = members[q + 1], work.misfit[q + 1]
            n -= 1
        if np.isnan(chi2):
            seen_by[:] = 0  # such points are no start
    return np.int64(0)


@borrowing_kernel
def _review(space, work, members, n, early):
    """Choose the early members again, now that the points are well known; return the size.

    They were chosen by points from a few views only. A false member does more harm than a miss:
    a tracklet joins only where it clearly speaks for the object, and a sensor with two such
    tracklets that are about equal contributes none.
    """
    views, stamp, early = space.views, work.stamp, min(early, n)
    mark = next_mark(stamp)
    n_again = 0  # the sensors of the early members, in order, in `work.missed`
    for i in members[:early]:
        s = views.sensor[i]
        if stamp[s] != mark:
            stamp[s] = mark
            place = n_again
            while place > 0 and work.missed[place - 1] > s:
                work.missed[place] = work.missed[place - 1]
                place -= 1
            work.missed[place] = s
            n_again += 1
    before = work.before
    for q in range(n):
        before[q] = members[q]
    kept = np.int64(0)
    for i in before[:n]:
        if stamp[views.sensor[i]] != mark and _speaks(space, work, i):
            members[kept] = i
            kept += 1
    for s in work.missed[:n_again]:
        n_own = 0
        while kept < len(members):
            c, gain, second = best_of_sensor(space, work, s, work.own[:n_own], SPEAKS)
            if c < 0 or (second > SPEAKS and gain - second < CONTESTED):
                break
            members[kept], work.own[n_own] = c, c
            kept += 1
            n_own += 1
            if fills(views, c, work.points.seen_by):
                break
    if kept < ENOUGH - 1:
        kept = n
        for q in range(n):
            members[q] = before[q]
    return _settle(space, work, members, kept)


@borrowing_kernel
def _speaks(space, work, i):
    """Return whether a member still speaks for the object, by the first instant they share."""
    views, chance, points, part = space.views, space.chance, work.points, work.part
    for m in range(len(views.time_s)):
        if points.seen_by[m] >= 2 and views.seen[i, m]:
            s, spot = views.sensor[i], views.sight[i, m, SPOT_SR]
            if residual(views, i, m, points.x_km[m], part) == 0.0:
                return False
            odds = np.log(chance.detected[s] / (chance.density[s] * spot))
            return odds - 0.5 * misfit(part) >= SPEAKS
    return True


@borrowing_kernel
def _clear_of_doubt(space, work, members, n_missed, value, clear):
    """Return whether a hypothesis may be taken at once.

    It has many views, and of the sensors that have it in their field about as many detect it
    as usual. A mixture of two objects' tracklets fits in some of the sensors only.
    """
    if not (value > clear and len(members) >= WELL_KNOWN):
        return False
    views, detected = space.views, space.chance.detected
    has, usual, mark = 0, 0.0, next_mark(work.stamp)
    for i in members:
        s = views.sensor[i]
        if work.stamp[s] != mark:
            work.stamp[s] = mark
            has += 1
            usual += detected[s]
    for s in work.missed[:n_missed]:
        usual += detected[s]
    return has >= COMPLETE * usual


@kernel
def _more(values, n):
    """Return an array twice as long with the same first n rows."""
    out = np.empty((2 * len(values), *values.shape[1:]), values.dtype)
    out[:n] = values[:n]
    return out


@kernel
def _room(values, n, more):
    """Return the array, or a longer one with the same first n values and room for more."""
    while n + more > len(values):
        values = _more(values, n)
    return values
