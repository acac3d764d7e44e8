"""A filter on the sky: direction and rate of an object along its great circle.

Both axes share one covariance P = (direction, cross, rate). Between frames it grows with the
acceleration that the rate allows. There are no coordinates, so no place on the sky is special.
"""

import numpy as np

from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.tracking.apparent_motion import acceleration


@kernel
def rate_of(w):
    """Return the length of a rate vector."""
    return np.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2)


@kernel
def distance2(a, b):
    """Return the squared chord between two directions."""
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2


@kernel
def advance(u, w, dt):
    """Turn direction u and rate w (both changed in place) by dt along their great circle."""
    rate = rate_of(w)
    angle = rate * dt
    if angle == 0.0:
        return
    cosine, sine = np.cos(angle), np.sin(angle)
    for a in range(3):
        old_u, old_w = u[a], w[a]
        u[a] = old_u * cosine + old_w / rate * sine
        w[a] = old_w * cosine - old_u * rate * sine


@kernel
def grow(P, rate, dt):
    """Let the covariance grow over dt, which may be negative."""
    a = acceleration(rate)
    step = abs(dt)
    P[0] += 2 * dt * P[1] + dt * dt * P[2] + 0.25 * a * a * step**4
    P[1] += dt * P[2] + 0.5 * a * a * dt * step**2
    P[2] += a * a * step * step


@kernel
def shrink(P, variance):
    """Update the covariance by a measured direction; return the gains of direction and rate."""
    s = P[0] + variance
    gain_u, gain_w = P[0] / s, P[1] / s
    P[2] -= gain_w * P[1]
    P[1] -= gain_u * P[1]
    P[0] -= gain_u * P[0]
    return gain_u, gain_w


@kernel
def correct(u, w, P, measured, variance):
    """Update u, w and P in place by a measured direction."""
    gain_u, gain_w = shrink(P, variance)
    norm = 0.0
    for a in range(3):
        difference = measured[a] - u[a]
        u[a] += gain_u * difference
        w[a] += gain_w * difference
        norm += u[a] * u[a]
    norm = np.sqrt(norm)
    along = 0.0
    for a in range(3):
        u[a] /= norm
        along += w[a] * u[a]
    for a in range(3):
        w[a] -= along * u[a]  # a rate stays perpendicular to its direction


@kernel
def begin_covariance(rate, dt, var_1, var_2, P):
    """Set P to the covariance at the second of two detections dt apart."""
    a = acceleration(rate)
    P[0] = var_2
    P[1] = var_2 / dt
    P[2] = (var_1 + var_2) / (dt * dt) + 0.25 * a * a * dt * dt


@kernel
def begin(u_1, t_1, var_1, u_2, t_2, var_2, u, w, P):
    """Set u, w, P to the state at the second of two detections."""
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
    begin_covariance(abs(rate), dt, var_1, var_2, P)
