"""A filter on the sky: direction, rate and acceleration of an object along its great circle.

Both axes share one covariance P of six elements: direction, direction-rate, rate,
direction-acceleration, rate-acceleration, acceleration. A new track's acceleration is uncertain by
what its rate allows. Between frames the covariance grows by the jerk that the rate and the
acceleration allow. After a few frames, predictions over half a minute are good as well. There are
no coordinates, so no place on the sky is special.
"""

import numpy as np

from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.tracking.apparent_motion import acceleration, jerk_of

SIZE = 6  # elements of a covariance


@kernel
def rate_of(w):
    """Return the length of a rate vector."""
    return np.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2)


@kernel
def distance2(a, b):
    """Return the squared chord between two directions."""
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2


@kernel
def advance(u, w, bend, dt):
    """Move direction u and rate w by dt along their great circle, with the acceleration `bend`.

    All three change in place.
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
    """Make u a unit vector, and w and bend perpendicular to it, in place."""
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
    """Let the covariance grow over dt, which may be negative.

    `bend` is the size of the estimated acceleration [rad/s^2].
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
    """Update the covariance by a measured direction; return the gains of direction, rate, bend."""
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
    """Update u, w, bend and P in place by a measured direction."""
    gain_u, gain_w, gain_bend = shrink(P, variance)
    for a in range(3):
        difference = measured[a] - u[a]
        u[a] += gain_u * difference
        w[a] += gain_w * difference
        bend[a] += gain_bend * difference
    _straighten(u, w, bend)


@kernel
def begin_covariance(rate, dt, var_1, var_2, P):
    """Set P to the covariance at the second of two detections dt apart."""
    a = acceleration(rate)
    P[0] = var_2
    P[1] = var_2 / dt
    P[2] = (var_1 + var_2) / (dt * dt) + 0.25 * a * a * dt * dt
    P[3], P[4], P[5] = 0.0, 0.5 * a * a * dt, a * a


@kernel
def begin(u_1, t_1, var_1, u_2, t_2, var_2, u, w, bend, P):
    """Set u, w, bend, P to the state at the second of two detections."""
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
