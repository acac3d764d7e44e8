"""Growth: two tracklets become a hypothesis as other sensors' tracklets join them."""

import numpy as np
from numba import njit

from epipole.tasks.algorithms.association.candidates import best_of_sensor
from epipole.tasks.algorithms.association.instant_points import possible, residual, solve
from epipole.tasks.algorithms.association.odds import score
from epipole.tasks.algorithms.association.sight_lines import quantile
from epipole.tasks.algorithms.association.visibility import looks_at

FEW = 3  # sensors that must have looked before a hypothesis is given up
SPEAKS = 2.0  # log-odds at which a view of a well-known point is clearly of the object
CONTESTED = 3.0  # log-odds by which the best view of a sensor must lead the next one
REVIEWS = 2  # the first may still rest on a stray
ENOUGH = 4  # views that fix a point well enough to choose them all again
GIVEN_UP = -4.0  # log-odds of the sensors beside the seed's at which it is


@njit(cache=True, nogil=True)
def _holds(members, n, c):
    return (members[:n] == c).any()


@njit(cache=True, nogil=True)
def workspace(n_instants):
    """Return the arrays that `grow` works in, made once."""
    return np.zeros((n_instants, 3)), np.zeros((n_instants, 3, 3)), np.zeros(n_instants, np.int64)


@njit(cache=True, nogil=True)
def grow_all(
    views, chance, seeds, taken, lowest, farthest, gate_sigma, shells, least, sizes, scores,
    radius_km, grown,
):  # fmt: skip
    """Grow every seed; write sizes (0: fails, or scores below `least`), scores, where, members."""
    work = workspace(len(views.time_s))
    members = np.empty(len(views.sensor) + 2, np.int64)
    for q in range(len(seeds)):
        n, value = grow(
            views, chance, seeds[q, 0], seeds[q, 1], taken, lowest, farthest, gate_sigma, shells,
            members, work,
        )  # fmt: skip
        sizes[q], scores[q] = min(n, grown.shape[1]) if value > least else 0, value
        if sizes[q] > 0:
            x = work[0][np.argmax(work[2] >= 2)]
            radius_km[q] = np.sqrt(x[0] ** 2 + x[1] ** 2 + x[2] ** 2)
        for k in range(sizes[q]):
            grown[q, k] = members[k]


@njit(cache=True, nogil=True)
def grow(
    views, chance, seed_i, seed_j, taken, lowest, farthest, gate_sigma, shells, members, work
):  # fmt: skip
    """Grow two tracklets into a hypothesis; return its size and score, 0 where it fails.

    Sensor after sensor, the tracklet that adds most to the odds joins. A sensor that looks and
    has none counts against the hypothesis, which is given up as soon as its other sensors speak
    clearly against it (Wald's sequential test). The points are solved again as the hypothesis
    doubles, and at the end, when a member that no longer fits goes.
    """
    X, P, seen_by = work
    n_sensors = len(views.half_field)
    seen_by[:] = 0
    members[0], members[1] = seed_i, seed_j
    n, again = np.int64(2), 3  # a plain 2 is a type of its own to numba: all would compile twice
    chi2, dof = solve(views, members, n, X, P, seen_by)
    if not chi2 <= quantile(max(dof, 1), gate_sigma):
        return 0, -np.inf
    if not possible(views, members, n, X, P, seen_by, lowest, farthest):
        return 0, -np.inf
    a, b = views.sensor[seed_i], views.sensor[seed_j]
    evidence, looked, absent = 0.0, 0, np.log(1.0 - chance.detected)
    for turn in range(n_sensors + 2):
        # The seed's own sensors come last: they may hold another fragment of the object.
        s = (a + turn) % n_sensors
        if turn >= n_sensors:
            s = a if turn == n_sensors else b
        elif s in (a, b):
            continue
        found = False
        while True:
            c, gain, _ = best_of_sensor(
                views, chance, s, members, n, taken, X, P, seen_by, gate_sigma, absent
            )
            if c < 0:
                break
            found = True
            evidence += gain
            members[n] = c
            n += 1
            if n >= again:
                n, chi2 = _settle(views, members, n, X, P, seen_by, gate_sigma)
                again = n + max(n // 2, 1)
                if n < 2:
                    return 0, -np.inf
            # A sensor has one tracklet of an object at a time; one that was let go again would
            # only come back.
            if len(views.time_s) == 1 or not _holds(members, n, c):
                break
        if turn < n_sensors:
            looks = found or looks_at(views, s, X, seen_by)
            looked += looks
            if looks and not found:
                evidence += absent
            if looked >= FEW and evidence < GIVEN_UP:
                return 0, -np.inf
    n, chi2 = _settle(views, members, n, X, P, seen_by, gate_sigma)
    for _ in range(REVIEWS):
        if n >= ENOUGH:
            n = _review(views, chance, members, n, taken, X, P, seen_by, gate_sigma)
            n, chi2 = _settle(views, members, n, X, P, seen_by, gate_sigma)
    if n < 2 or not possible(views, members, n, X, P, seen_by, lowest, farthest):
        return 0, -np.inf
    return n, score(views, chance, members, n, X, P, seen_by, chi2, shells)


@njit(cache=True, nogil=True)
def _review(views, chance, members, n, taken, X, P, seen_by, gate_sigma):
    """Choose every sensor's tracklet again, now that the points are well known.

    The first members were chosen by points that two or three views gave. A stray does more harm
    than an absence: what does not speak for the object by itself stays out, and so does a
    sensor in which two tracklets do about equally. Returns the size.
    """
    before = members[:n].copy()
    n = 0
    for s in range(len(views.half_field)):
        while n < len(members):
            c, gain, second = best_of_sensor(
                views, chance, s, members, n, taken, X, P, seen_by, gate_sigma, SPEAKS
            )
            if c < 0 or (second > SPEAKS and gain - second < CONTESTED):
                break
            members[n] = c
            n += 1
            if len(views.time_s) == 1:
                break
    if n < ENOUGH - 1:
        n = len(before)
        members[:n] = before
    return n


@njit(cache=True, nogil=True)
def _settle(views, members, n, X, P, seen_by, gate_sigma):
    """Solve, and let go the member that fits worst until all fit; return size and chi-square.

    The seed is not spared. 0 members where fewer than two of them fit.
    """
    e, W = np.empty(2), np.empty(3)
    while n >= 2:
        chi2, dof = solve(views, members, n, X, P, seen_by)
        if dof > 0 and chi2 <= quantile(dof, gate_sigma):
            return n, chi2
        if n == 2:
            break
        worst, largest = 0, -1.0
        for q in range(n):
            own, shared = 0.0, 1e-9
            for m in range(len(views.time_s)):
                if seen_by[m] < 2 or not views.seen[members[q], m]:
                    continue
                if residual(views, members[q], m, X[m], e, W) == 0.0:
                    own = np.inf
                own += W[0] * e[0] ** 2 + 2 * W[1] * e[0] * e[1] + W[2] * e[1] ** 2
                shared += 1
            if own / shared > largest:
                worst, largest = q, own / shared
        for q in range(worst, n - 1):
            members[q] = members[q + 1]
        n -= 1
        seen_by[:] = 0
    return 0, np.inf
