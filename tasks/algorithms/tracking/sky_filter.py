"""Motion of an object on the sky: its bounds, a filter for it, and a grid to look up detections.

The state is a direction, its rate, and its acceleration along the great circle. Both axes across
the direction share one covariance P of six elements: direction, direction-rate, rate,
direction-acceleration, rate-acceleration, acceleration. The acceleration of a new track is
uncertain by what its rate allows. Between frames the covariance grows by the jerk that rate and
acceleration allow. After a few frames, predictions over half a minute are good as well. No
spherical coordinates are used, so there are no poles.
"""

import numpy as np

from epipole.tasks.algorithms.kernels import kernel

# Bounds on apparent motion, from the apparent rate
#
# Four causes change a rate. Geometry changes it by its square: an object that passes at range d
# with speed v has the rate v / d, which changes by up to (v / d)^2. While the range changes, the
# rate changes by twice the relative range rate times the rate. Gravity changes it by the rate
# times g / v of a low orbit. A sensor in a low orbit changes it by its acceleration over the
# range of a far object. Each further derivative has one more factor of the rate, of the relative
# range rate, or of the angular rate of a low orbit.
#
# The relative range rate is the rate times the cotangent of the angle between the line of sight
# and the relative velocity. So it is bounded by the rate as well: an object that is known to be
# slow cannot accelerate like a near one.

LOW_ORBIT_S = 1e-3  # [1/s] angular rate of a low orbit; also g / v there
APPROACH = 2.0  # relative range rate over apparent rate: real low orbits rarely exceed it
APPROACH_S = 0.1  # [1/s] largest relative range rate: 14 km/s at 140 km
FAR_RAD_S2 = 2.5e-7  # [rad/s^2] a low sensor's acceleration over the range of a far object
# 1-sigma acceleration, and each further derivative, per axis as a share of its bound: real orbits
# have 0.3 to 0.5.
BEND_SHARE = 0.5


@kernel
def approach(rate: float) -> float:
    """Return how fast [1/s] the range of an object at a rate [rad/s] may change, over the range."""
    return min(APPROACH * rate, APPROACH_S)


@kernel
def acceleration(rate: float) -> float:
    """Return how fast [rad/s^2] a rate [rad/s] may change."""
    return rate * rate + (LOW_ORBIT_S + 2 * approach(rate)) * rate + FAR_RAD_S2


@kernel
def jerk(rate: float) -> float:
    """Return how fast [rad/s^3] the acceleration at a rate [rad/s] may change."""
    return 2 * rate**3 + 6 * approach(rate) ** 2 * rate + LOW_ORBIT_S * acceleration(rate)


@kernel
def jerk_of(rate: float, bend: float) -> float:
    """Return how fast [rad/s^3] an acceleration `bend` [rad/s^2] at a rate [rad/s] may change.

    An object that approaches accelerates by twice its relative range rate times its rate. This
    acceleration changes by three times the relative range rate times itself.
    """
    geometry = (2 + 6 * APPROACH**2) * rate**3 + LOW_ORBIT_S * acceleration(rate)
    return geometry + 1.5 * bend * bend / max(rate, 1e-6)


@kernel
def cubic_span(rate: float, sigma: float) -> float:
    """Return the time [s] over which a cubic describes the motion to a standard deviation [rad].

    The best cubic misses a quartic s t^4 / 24 by an eighth of its value at the ends.
    """
    snap = 2 * (rate + LOW_ORBIT_S + 2 * approach(rate)) * jerk(rate)
    return float(2 * np.sqrt(np.sqrt(8 * 24 * sigma / snap)))


# Filter

SIZE = 6  # elements of a covariance

# u (3,) is a direction, w (3,) its rate [rad/s], `bend` (3,) its acceleration [rad/s^2], and P (6,)
# their covariance per axis [rad^2, rad^2/s ...]. Times dt and t are in seconds.


@kernel
def rate_of(w):
    """Return the length [rad/s] of a rate w (3,)."""
    return np.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2)


@kernel
def distance2(a, b):
    """Return the squared chord between two directions (3,): the squared angle, if small."""
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2


@kernel
def advance(u, w, bend, dt):
    """Move direction u and rate w by dt along their great circle, with the acceleration `bend`.

    u (3,), w (3,) [rad/s] and `bend` (3,) [rad/s^2] change in place; dt is in [s].
    """
    rate = rate_of(w)
    angle = rate * dt
    if angle != 0.0:
        cosine, sine = np.cos(angle), np.sin(angle)
        for a in range(3):
            old_u, old_w = u[a], w[a]
            u[a] = old_u * cosine + old_w / rate * sine
            w[a] = old_w * cosine - old_u * rate * sine
    for a in range(3):
        u[a] += 0.5 * dt * dt * bend[a]
        w[a] += dt * bend[a]
    _straighten(u, w, bend)


@kernel
def _straighten(u, w, bend):
    """Make u (3,) a unit vector, and w and bend (3,) perpendicular to it, in place."""
    norm = 0.0
    for a in range(3):
        norm += u[a] * u[a]
    norm = np.sqrt(norm)
    along_w, along_bend = 0.0, 0.0
    for a in range(3):
        u[a] /= norm
        along_w += w[a] * u[a]
        along_bend += bend[a] * u[a]
    for a in range(3):
        w[a] -= along_w * u[a]
        bend[a] -= along_bend * u[a]


@kernel
def grow(P, rate, bend, dt):
    """Let the covariance P (6,) grow over dt [s], which may be negative.

    `rate` [rad/s] is the apparent rate, `bend` the size of the estimated acceleration [rad/s^2].
    """
    j = jerk_of(rate, bend) * dt
    half = 0.5 * dt * dt
    P[0] += 2 * dt * P[1] + dt * dt * P[2] + 2 * half * P[3] + 2 * half * dt * P[4]
    P[0] += half * half * P[5] + (j * dt * dt / 6) ** 2
    P[1] += dt * P[2] + dt * P[3] + (half + dt * dt) * P[4] + half * dt * P[5]
    P[1] += j * j * dt * dt * dt / 12
    P[2] += 2 * dt * P[4] + dt * dt * P[5] + (j * dt / 2) ** 2
    P[3] += dt * P[4] + half * P[5] + j * j * dt * dt / 6
    P[4] += dt * P[5] + j * j * dt / 2
    P[5] += j * j


@kernel
def shrink(P, variance):
    """Update P (6,) by a measured direction of this variance [rad^2].

    Returns the gains of direction, rate [1/s] and acceleration [1/s^2] (Kalman).
    """
    s = P[0] + variance
    gain_u, gain_w, gain_bend = P[0] / s, P[1] / s, P[3] / s
    P[5] -= gain_bend * P[3]
    P[4] -= gain_w * P[3]
    P[3] -= gain_u * P[3]
    P[2] -= gain_w * P[1]
    P[1] -= gain_u * P[1]
    P[0] -= gain_u * P[0]
    return gain_u, gain_w, gain_bend


@kernel
def correct(u, w, bend, P, measured, variance):
    """Update u, w, bend (3,) and P (6,) in place by a direction `measured` (3,) of a variance
    [rad^2]."""
    gain_u, gain_w, gain_bend = shrink(P, variance)
    for a in range(3):
        difference = measured[a] - u[a]
        u[a] += gain_u * difference
        w[a] += gain_w * difference
        bend[a] += gain_bend * difference
    _straighten(u, w, bend)


@kernel
def begin_covariance(rate, dt, var_1, var_2, P):
    """Set P (6,) to the covariance at the second of two detections, dt [s] apart.

    `rate` [rad/s] bounds the acceleration; var_1 and var_2 [rad^2] are the detections' variances.
    """
    a = acceleration(rate)
    P[0] = var_2
    P[1] = var_2 / dt
    P[2] = (var_1 + var_2) / (dt * dt) + 0.25 * a * a * dt * dt
    P[3], P[4], P[5] = 0.0, 0.5 * a * a * dt, a * a


@kernel
def begin(u_1, t_1, var_1, u_2, t_2, var_2, u, w, bend, P):
    """Set u, w, bend, P to the state at the second of two detections.

    u_1, u_2 (3,) are the directions, t_1, t_2 [s] their times, var_1, var_2 [rad^2] their
    variances. The state is the direction u (3,), its rate w (3,) [rad/s], the acceleration `bend`
    (3,) [rad/s^2], here zero, and their covariance per axis P (6,).
    """
    dt = t_2 - t_1
    cosine = u_1[0] * u_2[0] + u_1[1] * u_2[1] + u_1[2] * u_2[2]
    chord = 0.0
    for a in range(3):
        u[a] = u_2[a]
        w[a] = u_2[a] * cosine - u_1[a]  # perpendicular to u_2, away from u_1
        chord += w[a] * w[a]
    chord = np.sqrt(chord)
    rate = np.arctan2(chord, cosine) / dt
    for a in range(3):
        w[a] *= rate / chord if chord > 0 else 0.0
        bend[a] = 0.0
    begin_covariance(abs(rate), dt, var_1, var_2, P)


# Grid of the detections of recent frames
#
# A frame is projected on the plane across its mean direction. That lengthens no distance, so all
# detections within a distance are in the cells that this distance touches. A grid is a tuple of
# arrays, as compiled code takes them. Slot k of each belongs to the frames k, k + size, ...

MAX_CELLS_PER_SIDE = 128  # 16,384 cells, about one detection each: bounds the memory of a grid


@kernel
def make_grids(size, max_detections):
    """Return arrays for `size` frames with at most `max_detections` detections each.

    The plane's axes (size, 2, 3); its bounds and scale (size, 4); the first item of each cell
    (size, side^2 + 1); the items, rows of the detections (size, max_detections).
    """
    side = max(min(int(np.sqrt(max_detections)), MAX_CELLS_PER_SIDE), 1)
    axes = np.zeros((size, 2, 3))
    shape = np.zeros((size, 4))  # lowest on both axes, cells per unit, cells along a side
    start = np.zeros((size, side * side + 1), np.int64)
    items = np.zeros((size, max(max_detections, 1)), np.int64)
    return axes, shape, start, items


@kernel
def _set_axes(directions, lo, hi, axes):
    """Write two unit vectors across the mean of directions[lo:hi] to `axes` (2, 3)."""
    mean = np.zeros(3)
    for j in range(lo, hi):
        for a in range(3):
            mean[a] += directions[j, a]
    flat = 0
    for a in range(1, 3):
        if abs(mean[a]) < abs(mean[flat]):
            flat = a
    second, third = (flat + 1) % 3, (flat + 2) % 3
    norm = np.sqrt(mean[second] ** 2 + mean[third] ** 2)
    axes[:] = 0.0
    if norm == 0.0:
        axes[0, second] = 1.0
        axes[1, flat] = 1.0
        return
    axes[0, second], axes[0, third] = mean[third] / norm, -mean[second] / norm
    total = np.sqrt(norm**2 + mean[flat] ** 2)
    axes[1, flat] = norm / total
    axes[1, second] = -mean[second] * mean[flat] / norm / total
    axes[1, third] = -mean[third] * mean[flat] / norm / total


@kernel
def _along(u, axis):
    """Return the component of u (3,) along an axis (3,)."""
    return u[0] * axis[0] + u[1] * axis[1] + u[2] * axis[2]


@kernel
def fill_grid(grids, slot, directions, lo, hi):
    """Enter the detections lo:hi of a frame, rows of `directions` (n, 3), into a slot.

    `grids` are from `make_grids`; their slot is written.
    """
    axes, shape, start, items = grids
    n = hi - lo
    side = max(min(int(np.sqrt(n)), int(np.sqrt(start.shape[1] - 1))), 1)
    start[slot, : side * side + 1] = 0
    shape[slot, 3] = side
    if n == 0:
        return
    _set_axes(directions, lo, hi, axes[slot])
    position = np.empty((n, 2))
    for k in range(n):
        position[k, 0] = _along(directions[lo + k], axes[slot, 0])
        position[k, 1] = _along(directions[lo + k], axes[slot, 1])
    low_0, low_1 = position[:, 0].min(), position[:, 1].min()
    extent = max(position[:, 0].max() - low_0, position[:, 1].max() - low_1, 1e-12)
    shape[slot, 0], shape[slot, 1], shape[slot, 2] = low_0, low_1, side / extent
    cell = np.empty(n, np.int64)
    for k in range(n):
        x = min(int((position[k, 0] - low_0) * shape[slot, 2]), side - 1)
        y = min(int((position[k, 1] - low_1) * shape[slot, 2]), side - 1)
        cell[k] = y * side + x
        start[slot, cell[k] + 1] += 1
    for c in range(side * side):
        start[slot, c + 1] += start[slot, c]
    at = start[slot, : side * side].copy()
    for k in range(n):
        items[slot, at[cell[k]]] = lo + k
        at[cell[k]] += 1


@kernel
def window(grids, slot, u, reach):
    """Return the cells within `reach` of a direction u (3,): x from, to, y from, to, side.

    `grids` are from `make_grids`; `reach` is a chord [rad]. The cells x from .. to of a row y hold
    the items start[y * side + x from] to start[y * side + x to + 1]. Empty (x from above x to)
    outside the grid.
    """
    axes, shape = grids[0], grids[1]
    side = int(shape[slot, 3])
    scale = shape[slot, 2]
    x = _along(u, axes[slot, 0]) - shape[slot, 0]
    y = _along(u, axes[slot, 1]) - shape[slot, 1]
    x_from, x_to = np.floor((x - reach) * scale), np.floor((x + reach) * scale)
    y_from, y_to = np.floor((y - reach) * scale), np.floor((y + reach) * scale)
    # The last cell holds its upper edge as well.
    if x_to < 0 or y_to < 0 or x_from > side or y_from > side:
        return 1, 0, 1, 0, side
    last = side - 1.0
    return (
        int(min(max(x_from, 0.0), last)), int(min(x_to, last)),
        int(min(max(y_from, 0.0), last)), int(min(y_to, last)), side,
    )  # fmt: skip
