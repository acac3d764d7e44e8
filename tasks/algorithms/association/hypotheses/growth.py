"""Growth: two tracklets become a hypothesis as tracklets of other sensors join them."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.association.evidence.odds import score
from epipole.tasks.algorithms.association.evidence.visibility import near_fields, should_detect
from epipole.tasks.algorithms.association.hypotheses.candidates import best_of_sensor
from epipole.tasks.algorithms.association.hypotheses.instant_points import join, possible, solve
from epipole.tasks.algorithms.association.hypotheses.search_space import work_space
from epipole.tasks.algorithms.association.hypotheses.sight_lines import quantile
from epipole.tasks.algorithms.association.sampling.views import SPOT_SR, misfit, residual
from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel

FEW = 3  # sensors that must have looked before a hypothesis is given up
GIVEN_UP = -4.0  # log-odds of the sensors beside the seed's at which it is given up
SPEAKS = 2.0  # log-odds at which a view of a well-known point is clearly of the object
CONTESTED = 5.0  # log-odds by which the best view of a sensor must lead the next one
ENOUGH = 4  # views that fix a point well enough to choose them all again
WELL_KNOWN = 8  # views after which a sensor's choice needs no review
COMPLETE = 0.85  # of the expected detections, those of a clear hypothesis
REVIEWS = 2  # the first may still rest on a false member


class GrownSeeds(NamedTuple):
    """What n seeds have grown into.

    size : (n,) int
        Number of members; 0 where the hypothesis failed.
    score : (n,) float
        Log-odds.
    x_km : (n, 3) float
        Position at the first instant.
    outcomes : (n, s) int
        Detections (1) and misses (-1) of the sensors, see `odds`.
    members : (n, m) int
        Tracklets; the first `size` columns count.
    """

    size: npt.NDArray[np.int64]
    score: npt.NDArray[np.float64]
    x_km: npt.NDArray[np.float64]
    outcomes: npt.NDArray[np.int8]
    members: npt.NDArray[np.int64]


@kernel
def grow_all(space, seeds, clear, out):
    """Grow every seed and write the result to `out` (`GrownSeeds`).

    Parameters
    ----------
    seeds : (n, 2) int
        Pairs of tracklets. A pair of which one was taken since is skipped.
    clear : float
        Log-odds at which a hypothesis is taken at once, see `clear_of_doubt`. Its tracklets are
        entered in `space.taken`.
    """
    views, chance, taken = space.views, space.chance, space.taken
    work = work_space(len(views.time_s), views.camera.shape[0])
    points = work.points
    members = np.empty(len(views.sensor) + 2, np.int64)
    for q in range(len(seeds)):
        out.size[q] = 0
        if taken[seeds[q, 0]] or taken[seeds[q, 1]]:
            continue
        members[0], members[1] = seeds[q, 0], seeds[q, 1]
        n = _grow(space, work, members)
        if n < 2 or not possible(space, members[:n], points):
            continue
        value = score(
            views, chance, members[:n], points, space.shells, work.near, out.outcomes[q], work.part
        )
        out.score[q] = value
        out.size[q] = min(n, out.members.shape[1])
        out.x_km[q] = points.x_km[np.argmax(points.seen_by >= 2)]
        out.members[q, : out.size[q]] = members[: out.size[q]]
        if clear_of_doubt(chance, out.outcomes[q], n, value, clear):
            for i in members[:n]:
                taken[i] = True


@borrowing_kernel
def clear_of_doubt(chance, outcomes, n, value, clear):
    """Return whether a hypothesis may be taken at once.

    It has many views, and of the sensors that have it in their field about as many detect it
    as usual. A mixture of two objects' tracklets fits in some of the sensors only.
    """
    has, usual = 0, 0.0
    for s in range(len(outcomes)):
        has += outcomes[s] > 0
        usual += chance.detected[s] * (outcomes[s] != 0)
    return value > clear and n >= WELL_KNOWN and has >= COMPLETE * usual


@borrowing_kernel
def _grow(space, work, members):
    """Grow the first two members; return the size, 0 where the hypothesis fails.

    Sensor after sensor, the tracklet that adds most to the odds joins. A miss counts against
    the hypothesis. It is given up as soon as the other sensors speak clearly against it (Wald's
    sequential test).
    """
    views = space.views
    n = np.int64(2)  # a plain 2 is a type of its own to numba: all would compile twice
    if not _begin(space, work, members[:n]):
        return np.int64(0)
    n_sensors = views.camera.shape[0]
    a, b = views.sensor[members[0]], views.sensor[members[1]]
    evidence, looked, early = 0.0, 0, np.int64(0)
    for turn in range(n_sensors + 2):
        # The seed's own sensors come last: they may hold another fragment of the object.
        s = (a + turn) % n_sensors
        if turn >= n_sensors:
            s = a if turn == n_sensors else b
        elif s in (a, b) or not work.near[s]:
            continue
        before = n
        n, evidence, detected = _join_sensor(space, work, s, members, n, evidence)
        if n < 0:
            return np.int64(0)
        if n > before and before < WELL_KNOWN:
            early = min(n, np.int64(WELL_KNOWN))
        if turn < n_sensors:
            expected = detected or should_detect(views, members[:n], s, work.points)
            looked += expected
            if expected and not detected:
                evidence += np.log(1.0 - space.chance.detected[s])
            if looked >= FEW and evidence < GIVEN_UP:
                return np.int64(0)
    if n < 2 * WELL_KNOWN:
        n = _settle(space, work, members, n)
    for _ in range(REVIEWS if n < 2 * WELL_KNOWN else 1):
        if n >= ENOUGH:
            n = _review(space, work, members, n, early)
    return n


@borrowing_kernel
def _begin(space, work, members):
    """Solve the points of a seed; return whether an object can be there."""
    points = work.points
    points.seen_by[:] = 0
    chi2, dof = solve(space.views, members, points, work.part)
    if not chi2 <= quantile(max(dof, 1), space.gate_sigma):
        return False
    if not possible(space, members, points):
        return False
    near_fields(space.views, points.x_km, points.cov_km2, points.seen_by, work.near)
    return True


@borrowing_kernel
def _join_sensor(space, work, s, members, n, evidence):
    """Add the tracklets of sensor s that fit to the members.

    Returns the new size (-1 where a point cannot be solved any more), the log-odds `evidence`
    with what they add, and whether the sensor detects the object: it does also where two
    tracklets are about equal and none joins.
    """
    detected = False
    while n < len(members):
        known = n >= WELL_KNOWN
        least = SPEAKS if known else np.log(1.0 - space.chance.detected[s])
        c, gain, second = best_of_sensor(space, work, s, members[:n], least)
        if c < 0 or (known and second > SPEAKS and gain - second < CONTESTED):
            detected |= c >= 0
            break
        detected = True
        evidence += gain
        members[n] = c
        n += 1
        if not join(space.views, c, work.points, work.part):
            return np.int64(-1), evidence, detected
        # A sensor has one tracklet of an object at a time.
        if len(space.views.time_s) == 1:
            break
    return n, evidence, detected


@kernel
def _review(space, work, members, n, early):
    """Choose the early members again, now that the points are well known; return the size.

    They were chosen by points from a few views only. A false member does more harm than a miss:
    a tracklet joins only where it clearly speaks for the object, and a sensor with two such
    tracklets that are about equal contributes none.
    """
    views = space.views
    before = members[:n].copy()
    again = np.zeros(views.camera.shape[0], np.bool_)
    for q in range(min(early, n)):
        again[views.sensor[members[q]]] = True
    kept = np.int64(0)
    for i in before:
        if not again[views.sensor[i]] and _speaks(space, work, i):
            members[kept] = i
            kept += 1
    for s in range(len(again)):
        while again[s] and kept < len(members):
            c, gain, second = best_of_sensor(space, work, s, members[:kept], SPEAKS)
            if c < 0 or (second > SPEAKS and gain - second < CONTESTED):
                break
            members[kept] = c
            kept += 1
            if len(views.time_s) == 1:
                break
    if kept < ENOUGH - 1:
        kept = n
        members[:n] = before
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
def _settle(space, work, members, n):
    """Solve, and drop the member that fits worst until all fit; return the size.

    The seed's tracklets may be dropped too. 0 where fewer than two are left.
    """
    views, part = space.views, work.part
    X, _, _, seen_by = work.points
    while n >= 2:
        chi2, dof = solve(views, members[:n], work.points, part)
        if dof > 0 and chi2 <= quantile(dof, space.gate_sigma):
            return n
        if n == 2:
            break
        worst, largest = 0, -1.0
        for q in range(n):
            total, shared = 0.0, 1e-9
            for m in range(len(views.time_s)):
                if seen_by[m] < 2 or not views.seen[members[q], m]:
                    continue
                if residual(views, members[q], m, X[m], part) == 0.0:
                    total = np.inf
                total += misfit(part)
                shared += 1
            if total / shared > largest:
                worst, largest = q, total / shared
        for q in range(worst, n - 1):
            members[q] = members[q + 1]
        n -= 1
        seen_by[:] = 0
    return np.int64(0)
