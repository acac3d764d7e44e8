"""Visibility: whether a sensor could see a point at all."""

from numba import njit

EARTH_RADIUS_KM = 6378.137
INSIDE = 0.98  # of the half field: nearer to the edge a sensor may well miss an object


@njit(cache=True, nogil=True)
def blocked(r, x, radius):
    """Return whether the Earth stands between r and x."""
    dot, length2, r2 = 0.0, 0.0, 0.0
    for a in range(3):
        d = x[a] - r[a]
        dot += r[a] * d
        length2 += d * d
        r2 += r[a] * r[a]
    return dot < 0.0 and -dot < length2 and r2 - dot * dot / length2 < radius * radius


@njit(cache=True, nogil=True)
def sees(r, R, half_field, x):
    """Return whether a sensor at r has x in its field, not at the edge, the Earth not between.

    False where the sensor's place or attitude is unknown (NaN).
    """
    d0, d1, d2 = x[0] - r[0], x[1] - r[1], x[2] - r[2]
    depth = R[2, 0] * d0 + R[2, 1] * d1 + R[2, 2] * d2
    if not depth > 0.0:
        return False
    for a in range(2):
        side = (R[a, 0] * d0 + R[a, 1] * d1 + R[a, 2] * d2) / depth
        if abs(side) > INSIDE * half_field[a]:
            return False
    return not blocked(r, x, EARTH_RADIUS_KM)


@njit(cache=True, nogil=True)
def looks_at(views, s, X, seen_by):
    """Return whether sensor s has the point in its field at every solved instant."""
    looked = False
    for m in range(len(views.time_s)):
        if seen_by[m] < 2:
            continue
        if not sees(views.r_km[s, m], views.attitude[s, m], views.half_field[s], X[m]):
            return False
        looked = True
    return looked
