"""Growth: two tracklets become a hypothesis as other sensors' tracklets join them."""

import numpy as np

from epipole.tasks.algorithms.association.evidence.odds import score
from epipole.tasks.algorithms.association.evidence.visibility import looks_at, near_fields
from epipole.tasks.algorithms.association.hypotheses.candidates import best_of_sensor
from epipole.tasks.algorithms.association.hypotheses.instant_points import join, possible, solve
from epipole.tasks.algorithms.association.hypotheses.sight_lines import quantile
from epipole.tasks.algorithms.association.sampling.views import SPOT_SR, misfit, residual
from epipole.tasks.algorithms.kernels import kernel

FEW = 3  # sensors that must have looked before a hypothesis is given up
GIVEN_UP = -4.0  # log-odds of the sensors beside the seed's at which it is
SPEAKS = 2.0  # log-odds at which a view of a well-known point is clearly of the object
CONTESTED = 5.0  # log-odds by which the best view of a sensor must lead the next one
ENOUGH = 4  # views that fix a point well enough to choose them all again
WELL_KNOWN = 8  # views after which a sensor's choice needs no review
COMPLETE = 0.85  # of the views that are usual, those of a clear hypothesis
REVIEWS = 2  # the first may still rest on a stray


@kernel
def grow_all(views, chance, seeds, taken, limits, gate_sigma, shells, clear, found):
    """Grow every seed and write what comes of it.

    Parameters
    ----------
    seeds : (n, 2) int
        Pairs of tracklets; one that was taken meanwhile is passed over.
    taken : (t,) bool
        Tracklets of known objects; those of clear hypotheses are added.
    limits : (2,) float
        Lowest and farthest distance from the Earth's centre [km].
    clear
        Log-odds at which a hypothesis is taken at once, see `clear_of_doubt`.
    found
        To write to: sizes (0: fails), scores, places at the first instant [km], who looks (see
        `odds`), members.
    """
    sizes, scores, x_km, looks, grown = found
    k = len(views.time_s)
    points = np.zeros((k, 3)), np.zeros((k, 3, 3)), np.zeros((k, 3, 3)), np.zeros(k, np.int64)
    part = np.empty(11)
    predicted, near = np.empty((k, 7)), np.empty(views.camera.shape[0], np.bool_)
    members = np.empty(len(views.sensor) + 2, np.int64)
    for q in range(len(seeds)):
        sizes[q] = 0
        if taken[seeds[q, 0]] or taken[seeds[q, 1]]:
            continue
        members[0], members[1] = seeds[q, 0], seeds[q, 1]
        n = _grow(views, chance, members, taken, limits, gate_sigma, points, part, predicted, near)
        if n < 2 or not possible(views, members, n, points, limits[0], limits[1]):
            continue
        scores[q] = score(views, chance, members, n, points, part, shells, near, looks[q])
        sizes[q] = min(n, grown.shape[1])
        x_km[q] = points[0][np.argmax(points[3] >= 2)]
        grown[q, : sizes[q]] = members[: sizes[q]]
        if clear_of_doubt(chance, looks[q], n, scores[q], clear):
            for i in members[:n]:
                taken[i] = True


@kernel
def clear_of_doubt(chance, looks, n, value, clear):
    """Return whether a hypothesis may be taken at once.

    It has many views, and nearly as many of the sensors that look have it as usually do: two
    objects' tracklets, mixed, fit in a part of the sensors only.
    """
    has, usual = 0, 0.0
    for s in range(len(looks)):
        has += looks[s] > 0
        usual += chance.detected[s] * (looks[s] != 0)
    return value > clear and n >= WELL_KNOWN and has >= COMPLETE * usual


@kernel
def _grow(views, chance, members, taken, limits, gate_sigma, points, part, predicted, near):
    """Grow the first two members; return the size, 0 where it fails.

    Sensor after sensor, the tracklet that adds most to the odds joins. A sensor that looks and
    has none counts against the hypothesis, which is given up as soon as its other sensors speak
    clearly against it (Wald's sequential test).
    """
    n_sensors = views.camera.shape[0]
    points[3][:] = 0
    n = np.int64(2)  # a plain 2 is a type of its own to numba: all would compile twice
    chi2, dof = solve(views, members, n, points, part)
    if not chi2 <= quantile(max(dof, 1), gate_sigma):
        return 0
    if not possible(views, members, n, points, limits[0], limits[1]):
        return 0
    near_fields(views, points[0], points[2], points[3], near)
    a, b = views.sensor[members[0]], views.sensor[members[1]]
    evidence, looked, early = 0.0, 0, np.int64(0)
    for turn in range(n_sensors + 2):
        # The seed's own sensors come last: they may hold another fragment of the object.
        s = (a + turn) % n_sensors
        if turn >= n_sensors:
            s = a if turn == n_sensors else b
        elif s in (a, b) or not near[s]:
            continue
        absent = np.log(1.0 - chance.detected[s])
        found = False
        while n < len(members):
            known = n >= WELL_KNOWN
            least = SPEAKS if known else absent
            c, gain, second = best_of_sensor(
                views, chance, s, members, n, taken, points, predicted, gate_sigma, least
            )
            if c < 0 or (known and second > SPEAKS and gain - second < CONTESTED):
                found |= c >= 0
                break
            found = True
            evidence += gain
            members[n] = c
            n += 1
            early = n if n <= WELL_KNOWN else early
            if not join(views, c, points, part):
                return 0
            # A sensor has one tracklet of an object at a time.
            if len(views.time_s) == 1:
                break
        if turn < n_sensors:
            looks = found or looks_at(views, s, points[0], points[3])
            looked += looks
            if looks and not found:
                evidence += absent
            if looked >= FEW and evidence < GIVEN_UP:
                return 0
    if n < 2 * WELL_KNOWN:
        n = _settle(views, members, n, points, part, gate_sigma)
    for _ in range(REVIEWS if n < 2 * WELL_KNOWN else 1):
        if n >= ENOUGH:
            n = _review(
                views, chance, members, n, early, taken, points, part, predicted, gate_sigma
            )
    return n


@kernel
def _review(views, chance, members, n, early, taken, points, part, predicted, gate_sigma):
    """Choose the early members again, now that the points are well known; return the size.

    They were chosen by points that a few views gave. A stray does more harm than an absence:
    what does not speak for the object by itself stays out, and so does a sensor in which two
    tracklets do about equally.
    """
    before = members[:n].copy()
    again = np.zeros(views.camera.shape[0], np.bool_)
    for q in range(min(early, n)):
        again[views.sensor[members[q]]] = True
    kept = np.int64(0)
    for q in range(n):
        if not again[views.sensor[before[q]]] and _speaks(views, chance, before[q], points, part):
            members[kept] = before[q]
            kept += 1
    for s in range(len(again)):
        while again[s] and kept < len(members):
            c, gain, second = best_of_sensor(
                views, chance, s, members, kept, taken, points, predicted, gate_sigma, SPEAKS
            )
            if c < 0 or (second > SPEAKS and gain - second < CONTESTED):
                break
            members[kept] = c
            kept += 1
            if len(views.time_s) == 1:
                break
    if kept < ENOUGH - 1:
        kept = n
        members[:n] = before
    return _settle(views, members, kept, points, part, gate_sigma)


@kernel
def _speaks(views, chance, i, points, part):
    """Return whether a member still speaks for the object, by the first instant it shares."""
    for m in range(len(views.time_s)):
        if points[3][m] >= 2 and views.seen[i, m]:
            s, spot = views.sensor[i], views.sight[i, m, SPOT_SR]
            if residual(views, i, m, points[0][m], part) == 0.0:
                return False
            odds = np.log(chance.detected[s] / (chance.density[s] * spot))
            return odds - 0.5 * misfit(part) >= SPEAKS
    return True


@kernel
def _settle(views, members, n, points, part, gate_sigma):
    """Solve, and let go the member that fits worst until all fit; return the size.

    The seed is not spared. 0 where fewer than two of them fit.
    """
    X, _, _, seen_by = points
    while n >= 2:
        chi2, dof = solve(views, members, n, points, part)
        if dof > 0 and chi2 <= quantile(dof, gate_sigma):
            return n
        if n == 2:
            break
        worst, largest = 0, -1.0
        for q in range(n):
            own, shared = 0.0, 1e-9
            for m in range(len(views.time_s)):
                if seen_by[m] < 2 or not views.seen[members[q], m]:
                    continue
                if residual(views, members[q], m, X[m], part) == 0.0:
                    own = np.inf
                own += misfit(part)
                shared += 1
            if own / shared > largest:
                worst, largest = q, own / shared
        for q in range(worst, n - 1):
            members[q] = members[q + 1]
        n -= 1
        seen_by[:] = 0
    return np.int64(0)
