"""Instant points: one point of a hypothesis at each instant that two of its tracklets share."""

import numpy as np

from epipole.tasks.algorithms.association.arcs import CONVERGED, ITERATIONS
from epipole.tasks.algorithms.association.odds import blocked
from epipole.tasks.algorithms.association.search.sight_lines import BEYOND, SLACK_SIGMA
from epipole.tasks.algorithms.association.views import SIGMA_KM, direction, residual
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM
from epipole.tasks.algorithms.kernels import borrowing_kernel
from epipole.tasks.algorithms.symmetric_matrices import invert_symmetric

# Two sensors are apart if the distance between them exceeds this number of its sigmas. Lines from
# the cameras of one satellite are parallel: alone they solve no instant.
APART_SIGMA = 3.0
RHS = 11  # offset of the right-hand side of the normal equations, after the residual


@borrowing_kernel
def n_seeing(views, members, m):
    """Return how many tracklets see the object at instant m; 1 where all are from one position.

    `members` (n,) are the tracklets.
    """
    count, first, apart = 0, -1, False
    for i in members:
        if not views.seen[i, m]:
            continue
        count += 1
        if first < 0:
            first = i
        elif not apart:
            s, f = views.sensor[i], views.sensor[first]
            distance2 = 0.0
            for a in range(3):
                distance2 += (views.camera[s, m, a] - views.camera[f, m, a]) ** 2
            variance = views.sight[i, m, SIGMA_KM] ** 2 + views.sight[first, m, SIGMA_KM] ** 2
            apart = distance2 > APART_SIGMA * APART_SIGMA * variance
    return count if apart else min(count, 1)


@borrowing_kernel
def _start(views, members, m, points, part):
    """Write the point nearest to the members' lines; return false where they are parallel.

    `members` (n,) are tracklets. The point is entered in `points`, `InstantPoints`, at instant m;
    their `normal` and `cov_km2` there are overwritten. `part` (14,) is work space.
    """
    x, N, inverse = points.x_km[m], points.normal[m], points.cov_km2[m]
    N[:] = 0.0
    part[RHS : RHS + 3] = 0.0
    count = 0
    for i in members:
        if not views.seen[i, m]:
            continue
        count += 1
        direction(views, i, m, part)
        for a in range(3):
            for b in range(3):
                p = (1.0 if a == b else 0.0) - part[a] * part[b]
                N[a, b] += p
                part[RHS + a] += p * views.camera[views.sensor[i], m, b]
    if invert_symmetric(N, inverse) < 1e-12 * count**3:
        return False
    for a in range(3):
        x[a] = inverse[a, 0] * part[RHS]
        x[a] += inverse[a, 1] * part[RHS + 1] + inverse[a, 2] * part[RHS + 2]
    return True


@borrowing_kernel
def _add_view(views, i, m, x, N, part):
    """Add a view to the normal equations `N` (3, 3) [km^-2] (upper half); return its chi-square.

    The view is that of tracklet i at instant m, for the point `x` (3,) [km], GCRF. `part` (14,)
    holds the residual, and the right-hand side from `RHS` on. NaN where the point is behind the
    sensor.
    """
    if residual(views, i, m, x, part) == 0.0:
        return np.nan
    g0 = part[8] * part[0] + part[9] * part[1]
    g1 = part[9] * part[0] + part[10] * part[1]
    for a in range(3):
        u, v = part[2 + a], part[5 + a]
        part[RHS + a] -= u * g0 + v * g1
        h0, h1 = part[8] * u + part[9] * v, part[9] * u + part[10] * v
        for b in range(a, 3):
            N[a, b] += h0 * part[2 + b] + h1 * part[5 + b]
    return part[0] * g0 + part[1] * g1


@borrowing_kernel
def _step(x, N, part, P):
    """Invert N into P and move x; return the decrease of chi-square, NaN where it diverges.

    `N` (3, 3) [km^-2], upper half, and the right-hand side in `part` (14,) are those of
    `_add_view`; `P` (3, 3) [km^2] becomes the covariance of `x` (3,) [km], GCRF.
    """
    if invert_symmetric(N, P) == 0.0:
        return np.nan
    gain = 0.0
    for a in range(3):
        move = P[a, 0] * part[RHS] + P[a, 1] * part[RHS + 1] + P[a, 2] * part[RHS + 2]
        x[a] += move
        gain += move * part[RHS + a]
    return gain if gain < 1e12 else np.nan  # nearly parallel


@borrowing_kernel
def solve(views, members, points, part):
    """Solve every instant that members share who are apart; return chi-square, degrees of freedom.

    `members` (n,) are tracklets; `points`, `InstantPoints`, are written; `part` (14,) is work
    space. An instant that was solved before (by `points.seen_by`) starts from its point. NaN where
    an instant has no solution, or none is solved.
    """
    X, N, P, seen_by = points
    total, dof = 0.0, 0
    for m in range(len(views.time_s)):
        count = n_seeing(views, members, m)
        solved = seen_by[m] >= 2
        seen_by[m] = count
        if count < 2:
            continue
        if not solved and not _start(views, members, m, points, part):
            return np.nan, 0
        chi2 = np.nan
        for _ in range(ITERATIONS):
            N[m] = 0.0
            part[RHS : RHS + 3] = 0.0
            chi2 = 0.0
            for i in members:
                if views.seen[i, m]:
                    chi2 += _add_view(views, i, m, X[m], N[m], part)
            gain = _step(X[m], N[m], part, P[m])
            chi2 -= gain
            if not gain >= CONVERGED:
                break
        if np.isnan(chi2):
            return np.nan, 0
        total += chi2
        dof += 2 * count - 3
    return total if dof > 0 else np.nan, dof


@borrowing_kernel
def join(views, c, points, part):
    """Update the solved points with tracklet c (Kalman); return false where it fails.

    `points`, `InstantPoints`, are changed; `part` (14,) is work space.
    """
    X, N, P, seen_by = points
    for m in range(len(views.time_s)):
        if not views.seen[c, m]:
            continue
        if seen_by[m] >= 2:
            part[RHS : RHS + 3] = 0.0
            chi2 = _add_view(views, c, m, X[m], N[m], part)
            if np.isnan(chi2 + _step(X[m], N[m], part, P[m])):
                return False
        seen_by[m] += seen_by[m] >= 2
    return True


@borrowing_kernel
def possible(space, members, points):
    """Return whether the points lie, within 3 sigma, where their sensors can see an object.

    `members` (n,) are the tracklets that see them, `points` are `InstantPoints`.
    """
    views, lowest, farthest = space.views, space.lowest_km, space.farthest_km
    X, _, P, seen_by = points
    for m in range(len(views.time_s)):
        if seen_by[m] < 2:
            continue
        radius = np.sqrt(X[m, 0] ** 2 + X[m, 1] ** 2 + X[m, 2] ** 2)
        slack = SLACK_SIGMA * np.sqrt(P[m, 0, 0] + P[m, 1, 1] + P[m, 2, 2])
        # A point far beyond the limit is impossible, even if its range is uncertain.
        if radius + slack < lowest or radius - min(slack, BEYOND * farthest) > farthest:
            return False
        for i in members:
            if views.seen[i, m] and blocked(
                views.camera[views.sensor[i], m], X[m], EARTH_RADIUS_KM - slack
            ):
                return False
    return True
