"""A sensor that turns: its rate from its attitudes, and directions turned by it."""

import numpy as np
from scipy.spatial.transform import Rotation

from epipole.schemas.arrays import Array, Flags

# Attitudes farther apart than this in time, or by this angle, tell no rate [s, rad]. A sensor that
# turns faster than 11.5 deg/s has jumped.
MAX_APART_S, MAX_TURNED, MAX_RATE = 10.0, 0.5, 0.2
# Rates before and after a frame are averaged if they differ by less than this share, or by this
# [rad/s], which errors of attitudes cause at 10 Hz. Otherwise the sensor began to turn, or stopped.
SAME_SHARE, SAME_RATE = 0.5, 1e-3


def angular_rates(t_s: Array, R: Array, known: Flags) -> Array:
    """Return the rates (F, 3) at which directions turn in a sensor's frames [rad/s, sensor axes].

    Directions of stars change by the cross product of the rate with them. The rate of a frame is
    that between the attitudes before and after; between frames that have one it is interpolated. It
    is 0 where nothing tells it.

    Parameters
    ----------
    t_s : (F,) float
        Times, ascending.
    R : (F, 3, 3) float
        Attitudes, sensor from any inertial axes.
    known : (F,) bool
        Which frames have one.
    """
    rates, at = np.zeros((len(t_s), 3)), np.flatnonzero(known)
    if len(at) < 2:
        return rates
    apart_s = np.diff(t_s[at])
    turn = Rotation.from_matrix(R[at[1:]] @ np.swapaxes(R[at[:-1]], 1, 2)).as_rotvec()
    angle = np.linalg.norm(turn, axis=1)
    fit = (apart_s > 0) & (apart_s <= MAX_APART_S) & (angle < MAX_TURNED)
    fit &= angle < MAX_RATE * apart_s
    between = np.where(fit[:, None], turn / np.where(fit, apart_s, 1.0)[:, None], np.nan)
    beyond = np.full((1, 3), np.nan)
    before, after = np.concatenate([beyond, between]), np.concatenate([between, beyond])
    rate = _of_both(before, after, np.append(np.nan, apart_s), np.append(apart_s, np.nan))
    has_rate = np.isfinite(rate[:, 0])
    if has_rate.any():
        for axis in range(3):
            rates[:, axis] = np.interp(t_s, t_s[at[has_rate]], rate[has_rate, axis])
    return rates


def _of_both(before: Array, after: Array, before_s: Array, after_s: Array) -> Array:
    """Return rates (n, 3) from those before and after, which hold for some seconds each; NaN
    without both."""
    fast_before, fast_after = np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)
    fastest = np.fmax(fast_before, fast_after)
    near = np.linalg.norm(after - before, axis=1) < SAME_SHARE * fastest + SAME_RATE
    total_s = np.where(near, before_s + after_s, 1.0)
    # Of two rates, the one over the shorter time is nearer to that of the frame.
    mean = (before * (after_s / total_s)[:, None]) + after * (before_s / total_s)[:, None]
    of_before = ~(fast_before > fast_after) & np.isfinite(fast_before)
    one = np.where(of_before[:, None], before, after)  # the slower one, or the only one
    return np.where(near[:, None], mean, one)


def turned(u: Array, by: Array) -> Array:
    """Return unit vectors (n, 3) turned by rotation vectors (n, 3) [rad]."""
    return np.asarray(Rotation.from_rotvec(by).apply(u)) if len(u) else u
