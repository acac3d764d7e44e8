"""Odds of a hypothesis: one object against unrelated tracklets.

`score` adds four terms: the directions, which fit one point at a single instant or one orbit
through several (`arcs`); the magnitudes; the prior density of objects at that altitude; and which
sensors detect the object or miss it. A sensor counts as a miss only where the object is in its
field, apart from the other objects there, and the Earth is not in between.
"""

import numpy as np

from epipole.tasks.algorithms.association.arcs import arc_odds
from epipole.tasks.algorithms.association.views import (
    HALF,
    PLANE,
    REACH,
    TURN,
    X,
    Y,
    cells_near,
    error_sr,
    residual,
    residual_chi2,
)
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM, LN_2PI
from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel
from epipole.tasks.algorithms.symmetric_matrices import determinant3

MAX_RANGE_RATIO = 1.5  # of ranges: beyond it the object is 0.9 mag fainter and may not be detected
FIELD_SHARE = 0.98  # of half the field: misses are frequent nearer to its edge
# A point may lie this far outside a field and still have tracklets there; 3 to 12 make no
# difference in the scenes tried.
NEAR_SIGMA = 6.0
# Differences between magnitudes at one range, 1-sigma. Of one object, seen from the same direction,
# and per radian between the directions (to 5 degrees the simulators have 0.02 to 0.2 mag, to 20
# degrees 0.2 to 0.4 mag); of two objects (0.9 to 1.4 mag there).
SAME_MAG, MAG_PER_RAD, OTHER_MAG = 0.2, 1.4, 1.2
# Share of sensors that see an object much brighter or fainter, as flat parts make it; 0.03 and 0.3
# make no difference in the scenes tried.
FLASH_SHARE = 0.1


@borrowing_kernel
def blocked(r, x, radius):
    """Return whether the Earth, of this radius [km], is between r and x.

    `r` and `x` are positions (3,) [km], GCRF. `r` may be a row of `Views.camera`, which begins with
    one.
    """
    dot, length2, r2 = 0.0, 0.0, 0.0
    for a in range(3):
        d = x[a] - r[a]
        dot += r[a] * d
        length2 += d * d
        r2 += r[a] * r[a]
    return dot < 0.0 and -dot < length2 and r2 - dot * dot / length2 < radius * radius


@borrowing_kernel
def sees(r, R, half_field, x):
    """Return whether a sensor at r, with attitude R, has x in its field and in view.

    `r` and `x` (3,) [km], GCRF; `R` (3, 3), sensor from ICRS; `half_field` (2,), tangents of half
    the field. False at the edge of the field, behind the Earth, and where r or R is unknown (NaN).
    """
    d0, d1, d2 = x[0] - r[0], x[1] - r[1], x[2] - r[2]
    depth = R[2, 0] * d0 + R[2, 1] * d1 + R[2, 2] * d2
    if not depth > 0.0:
        return False
    for a in range(2):
        side = (R[a, 0] * d0 + R[a, 1] * d1 + R[a, 2] * d2) / depth
        if abs(side) > FIELD_SHARE * half_field[a]:
            return False
    return not blocked(r, x, EARTH_RADIUS_KM)


@kernel
def seeing(r, R, half_field, x, out):
    """Write for each sensor whether it has x in its field and in view, as in `sees`.

    `r` (s, 3), `R` (s, 3, 3) and `half_field` (s, 2) are of s sensors, `x` (3,) is one point [km],
    GCRF; `out` (s,) bool is written.
    """
    for s in range(len(out)):
        out[s] = sees(r[s], R[s], half_field[s], x)


@borrowing_kernel
def in_view(cam, x):
    """Return the same as `sees`, for a row of `Views.camera`.

    `cam` (34,) is the sensor at an instant, `x` (3,) a point [km], GCRF.
    """
    d0, d1, d2 = x[0] - cam[0], x[1] - cam[1], x[2] - cam[2]
    depth = cam[TURN + 6] * d0 + cam[TURN + 7] * d1 + cam[TURN + 8] * d2
    if not depth > 0.0:
        return False
    for a in range(2):
        t = TURN + 3 * a
        if (
            abs(cam[t] * d0 + cam[t + 1] * d1 + cam[t + 2] * d2)
            > FIELD_SHARE * cam[HALF + a] * depth
        ):
            return False
    return not blocked(cam, x, EARTH_RADIUS_KM)


@borrowing_kernel
def looks_at(views, s, X, seen_by):
    """Return whether sensor s has the points in its field at all solved instants.

    `X` (k, 3) [km], GCRF, and `seen_by` (k,) as in `InstantPoints`. False if no instant is solved.
    """
    looked = False
    for m in range(len(views.time_s)):
        if seen_by[m] < 2:
            continue
        if not in_view(views.camera[s, m], X[m]):
            return False
        looked = True
    return looked


@borrowing_kernel
def should_detect(views, s, points, nearest_km2):
    """Return whether a sensor without a tracklet of the object counts as a miss.

    It does if the points, `InstantPoints`, are in its field, not much fainter than for the members'
    sensors (`nearest_km2` is `nearest_range2` of these), and not in one spot with a tracklet.
    """
    if not looks_at(views, s, points.x_km, points.seen_by):
        return False
    for m in range(len(views.time_s)):
        if points.seen_by[m] >= 2:
            range2 = range2_of(views.camera, s, m, points.x_km[m])
            if range2 > MAX_RANGE_RATIO * MAX_RANGE_RATIO * nearest_km2:
                return False
            return not _blends(views, s, m, points.x_km[m])
    return True


@borrowing_kernel
def _blends(views, s, m, x):
    """Return whether sensor s has a tracklet so near the point x at instant m that both blend.

    `x` (3,) [km], GCRF, is in front of the sensor.
    """
    cam, side = views.camera, views.grid[s, m, 1]
    if side == 0 or not views.blend_rad[s] > 0.0:
        return False
    d0, d1, d2 = x[0] - cam[s, m, 0], x[1] - cam[s, m, 1], x[2] - cam[s, m, 2]
    depth = cam[s, m, PLANE + 6] * d0 + cam[s, m, PLANE + 7] * d1 + cam[s, m, PLANE + 8] * d2
    at0 = cam[s, m, PLANE] * d0 + cam[s, m, PLANE + 1] * d1 + cam[s, m, PLANE + 2] * d2
    at1 = cam[s, m, PLANE + 3] * d0 + cam[s, m, PLANE + 4] * d1 + cam[s, m, PLANE + 5] * d2
    at0, at1 = at0 / depth, at1 / depth
    reach = views.blend_rad[s] * (1.0 + at0 * at0 + at1 * at1)  # an angle on the plane, at most
    lo0, hi0, lo1, hi1 = cells_near(views, s, m, at0, at1, reach, reach)
    for g0 in range(lo0, hi0 + 1):
        row = views.grid[s, m, 0] + g0 * side
        for k in range(views.cell_start[row + lo1], views.cell_start[row + hi1 + 1]):
            c = views.cell_item[k]
            off0, off1 = views.sight[c, m, X] - at0, views.sight[c, m, Y] - at1
            if off0 * off0 + off1 * off1 < reach * reach:
                return True
    return False


@borrowing_kernel
def nearest_range2(views, members, points):
    """Return the shortest squared range [km^2] from which members see the first solved point.

    `members` (n,) are tracklets, `points` are `InstantPoints`; inf if no member sees that point.
    The limits of other sensors are not used: their cameras may be better.
    """
    nearest2 = np.inf
    for m in range(len(views.time_s)):
        if points.seen_by[m] < 2:
            continue
        for i in members:
            if views.seen[i, m]:
                range2 = range2_of(views.camera, views.sensor[i], m, points.x_km[m])
                nearest2 = min(nearest2, range2)
        break
    return nearest2


@borrowing_kernel
def range2_of(cam, s, m, x):
    """Return the squared range [km^2] from sensor s at instant m to the point x.

    `cam` (s, k, 34) is `Views.camera`, `x` (3,) [km], GCRF.
    """
    d0, d1, d2 = x[0] - cam[s, m, 0], x[1] - cam[s, m, 1], x[2] - cam[s, m, 2]
    return d0 * d0 + d1 * d1 + d2 * d2


@borrowing_kernel
def near_fields(views, points, sensors, near):
    """Write which of the sensors may have a point in their field at any solved instant.

    `sensors` (n,) are tested and `points` are `InstantPoints`. Those found are the first ones of
    `near` (n,) or longer; returns their number. A fast first test: within 6 sigma of the cone that
    holds the sensor's tracklets and field.
    """
    n, cam = 0, views.camera
    X, _, P, seen_by = points
    for s in sensors:
        for m in range(len(views.time_s)):
            if seen_by[m] < 2:
                continue
            d0, d1, d2 = X[m, 0] - cam[s, m, 0], X[m, 1] - cam[s, m, 1], X[m, 2] - cam[s, m, 2]
            n0, n1, n2 = cam[s, m, PLANE + 6], cam[s, m, PLANE + 7], cam[s, m, PLANE + 8]
            depth, reach = n0 * d0 + n1 * d1 + n2 * d2, cam[s, m, REACH]
            if not (reach > 0.0 and depth > 0.0):
                continue
            away2 = d0 * d0 + d1 * d1 + d2 * d2 - depth * depth
            slack = NEAR_SIGMA * np.sqrt(P[m, 0, 0] + P[m, 1, 1] + P[m, 2, 2])
            if away2 <= (reach * depth + slack) ** 2:
                near[n] = s
                n += 1
                break
    return n


# Odds


@borrowing_kernel
def score(space, work, members, near):
    """Return the log-odds of "one object" against "unrelated tracklets".

    An unrelated tracklet may lie anywhere in its field (`chance.density`), an object anywhere in
    view (`chance.objects_km3`, weighted by altitude with `shells`). Several instants are tied
    together by one orbit, see `arcs`. A sensor with the point in its field but without a tracklet
    of it is a miss, which lowers the odds: `work.missed` lists those.

    Parameters
    ----------
    space, work
        `SearchSpace`, and the `WorkSpace` with the solved points.
    near : (n,) int
        Sensors whose field may hold the points, see `near_fields`.

    Returns
    -------
    float, float
        The log-odds, and those that tracklets of one sensor are fragments of one object, whichever
        it is, see `arcs`.
    int
        The number of misses.
    """
    views, chance, points = space.views, space.chance, work.points
    m, instants, fragments = -1, 0, 0.0
    for k in range(len(views.time_s)):
        if points.seen_by[k] >= 2:
            m = k if m < 0 else m
            instants += 1
    if instants == 1:
        total = 1.5 * LN_2PI + 0.5 * np.log(determinant3(points.cov_km2[m]))
        for i in members:
            if views.seen[i, m]:
                residual(views, i, m, points.x_km[m], work.part)
                total -= np.log(chance.density[views.sensor[i]] * error_sr(views, i, m, work.part))
                total -= 0.5 * residual_chi2(work.part)
    else:
        total, fragments = arc_odds(views, chance, members, points)
    total += np.log(chance.objects_km3) + _altitude_weight(points.x_km[m], space.shells)
    total += _magnitude_odds(views, work, members)
    detections, n_missed = _detections(space, work, members, near)
    return total + detections, fragments, n_missed


@kernel
def _magnitude_odds(views, work, members):
    """Return the log-odds of one object against unrelated ones by the magnitudes of tracklets.

    `members` (n,) are the tracklets of the points of `work`. All magnitudes are reduced to one
    range. Each sensor's first one is compared with that of the sensor that sees the object
    from the nearest direction, of those before it: 0 if there is none. The order is that of the
    tracklets, so that the odds do not depend on which of them were the seed.
    """
    points, mark = work.points, next_mark(work.stamp)
    total, n, seen_from = 0.0, 0, np.empty((len(members), 4))
    for i in np.sort(members):
        s, m = views.sensor[i], 0
        while m < len(views.time_s) and not (points.seen_by[m] >= 2 and views.seen[i, m]):
            m += 1
        if m == len(views.time_s) or np.isnan(views.magnitude[i]) or work.stamp[s] == mark:
            continue
        work.stamp[s] = mark
        square, cosine, nearest = 0.0, -np.inf, 0
        for a in range(3):
            seen_from[n, a] = views.camera[s, m, a] - points.x_km[m, a]
            square += seen_from[n, a] ** 2
        seen_from[n, :3] /= np.sqrt(square)
        seen_from[n, 3] = views.magnitude[i] - 2.5 * np.log10(square)
        for k in range(n):
            here = 0.0
            for a in range(3):
                here += seen_from[k, a] * seen_from[n, a]
            if here > cosine:
                cosine, nearest = here, k
        if n > 0:
            total += _same_magnitude(seen_from[n, 3] - seen_from[nearest, 3], cosine)
        n += 1
    return total


@borrowing_kernel
def _same_magnitude(difference, cosine):
    """Return the log-odds that a difference of reduced magnitudes is that of one object.

    `cosine` is that of the angle between the directions from which it is seen.
    """
    angle = np.arccos(min(max(cosine, -1.0), 1.0))
    variance = min(SAME_MAG**2 + (MAG_PER_RAD * angle) ** 2, OTHER_MAG**2)
    square = difference * difference
    alike = np.exp(-0.5 * square * (1.0 / variance - 1.0 / OTHER_MAG**2))
    return np.log(FLASH_SHARE + (1.0 - FLASH_SHARE) * alike * OTHER_MAG / np.sqrt(variance))


@borrowing_kernel
def _detections(space, work, members, near):
    """Return the log-probability of which sensors detect the object and which miss it.

    `members` (n,) are its tracklets, `near` (m,) the sensors whose field may hold its points.
    Writes the list of those that miss it, `work.missed`; also returns their number.
    """
    views, detected = space.views, space.chance.detected
    total, n_missed = 0.0, 0
    nearest2 = nearest_range2(views, members, work.points)
    mark = next_mark(work.stamp)
    for i in members:
        s = views.sensor[i]
        if work.stamp[s] != mark:
            work.stamp[s] = mark
            total += np.log(detected[s])
    for s in near:
        if work.stamp[s] != mark and should_detect(views, s, work.points, nearest2):
            work.missed[n_missed] = s
            n_missed += 1
            total += np.log(1.0 - detected[s])
    return total, n_missed


@borrowing_kernel
def next_mark(stamp):
    """Return the number of a new list of sensors; `stamp` (s + 1,), see `WorkSpace`, counts it."""
    stamp[-1] += 1
    return stamp[-1]


@borrowing_kernel
def _altitude_weight(x, shells):
    """Return the log of the object density at this radius over the mean density.

    `x` (3,) is the position [km], GCRF. `shells` (j, 3) are rows of (lowest, highest radius [km],
    weight). Weights of overlapping shells add up. Without shells the density is uniform.
    """
    if len(shells) == 0:
        return 0.0
    radius, weight = np.sqrt(x[0] ** 2 + x[1] ** 2 + x[2] ** 2), 1e-9
    for k in range(len(shells)):
        if shells[k, 0] <= radius < shells[k, 1]:
            weight += shells[k, 2]
    return np.log(weight)
