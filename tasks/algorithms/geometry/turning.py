"""A sensor that turns: its rate from its attitudes, and directions turned by it."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from epipole.schemas.arrays import Array, Flags, Indices

# Attitudes farther apart than this in time, or by this angle, tell no rate [s, rad]. A sensor that
# turns faster than 11.5 deg/s has jumped.
MAX_APART_S, MAX_TURNED, MAX_RATE = 10.0, 0.5, 0.2
# Rates before and after a frame are averaged if they differ by less than this share, or by this
# [rad/s], which errors of attitudes cause at 10 Hz. Otherwise the sensor began to turn, or stopped.
SAME_SHARE, SAME_RATE = 0.5, 1e-3
ANY_RATE = 2e-2  # 1-sigma of a rate of which nothing is known, per axis [rad/s]


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


class FrameRates(NamedTuple):
    """What the stars of single frames tell of their rates; all is 0 with fewer than two stars.

    turn_rad, rate_rad_s : (F, 3) float
        Small turn of each frame from its attitude, and its rate, sensor axes.
    cov_alone, cov_rad2 : (F, 3, 3) float
        Covariances of the turn, if the rate is known, and with its error.
    n_fitted : (F,) float
        Unknowns that the stars determine, of six: of the rate less where the prior determines it.
    """

    turn_rad: Array
    rate_rad_s: Array
    cov_alone: Array
    cov_rad2: Array
    n_fitted: Array


def rates_within_frames(
    frame: Indices, u: Array, off: Array, late_s: Array, sigma_rad: Array, n_frames: int
) -> FrameRates:
    """Return the rates that n stars show whose rows are exposed at different times.

    Least squares of a small turn of each frame and its rate, with the prior `ANY_RATE`.

    Parameters
    ----------
    frame : (n,) int
        Number of each star's frame, from 0.
    u, off : (n, 3) float
        Predicted directions at the times of the frames, and measured ones minus these, sensor axes.
    late_s : (n,) float
        Times of the stars' rows after those of their frames.
    sigma_rad : (n,) float
        1-sigma errors of the measured directions, per axis.
    n_frames
        F of the result.
    """
    weight = 1.0 / sigma_rad**2
    across = weight[:, None, None] * (np.eye(3) - u[:, :, None] * u[:, None, :])
    moment = weight[:, None] * np.cross(u, off)
    A, b = np.zeros((n_frames, 6, 6)), np.zeros((n_frames, 6))
    for i in range(2):
        at = slice(3 * i, 3 * i + 3)
        np.add.at(b[:, at], frame, moment * (late_s**i)[:, None])
        for j in range(2):
            block = np.zeros((n_frames, 3, 3))
            np.add.at(block, frame, across * (late_s ** (i + j))[:, None, None])
            A[:, at, 3 * j : 3 * j + 3] = block
    enough = np.bincount(frame, minlength=n_frames) >= 2
    A, b = A[enough] + np.diag([0.0] * 3 + [ANY_RATE**-2] * 3), b[enough]
    vectors, matrices = np.zeros((2, n_frames, 3)), np.zeros((2, n_frames, 3, 3))
    found = FrameRates(vectors[0], vectors[1], matrices[0], matrices[1], np.zeros(n_frames))
    both = np.linalg.solve(A, b[:, :, None])[:, :, 0]
    found.turn_rad[enough], found.rate_rad_s[enough] = both[:, :3], both[:, 3:]
    found.cov_alone[enough] = np.linalg.inv(A[:, :3, :3])
    cov = np.linalg.inv(A)
    found.cov_rad2[enough] = cov[:, :3, :3]
    found.n_fitted[enough] = 6.0 - np.trace(cov[:, 3:, 3:], axis1=1, axis2=2) / ANY_RATE**2
    return found


def turned(u: Array, by: Array) -> Array:
    """Return unit vectors (n, 3) turned by rotation vectors (n, 3) [rad]."""
    return np.asarray(Rotation.from_rotvec(by).apply(u)) if len(u) else u
