"""Trails: the error of a fast object's centroid along its motion.

While a frame is exposed, a fast object draws a trail. Where along the trail its centroid comes to
lie depends on how evenly it shines, on how well the ends are seen, and on the true time of the
exposure. All of this is an error in time, the same for slow and fast objects: times the rate, it
is an error along the motion. Logs do not state it. The detections of fast tracklets show it, as
they scatter more along their motion than their sigmas say.
"""

from typing import NamedTuple

import numpy as np
from numpy.polynomial.chebyshev import chebder, chebval, chebvander

from epipole.schemas.arrays import Array

# Errors that are tried [s]: from what moves an object of 10 deg/s by half a second of arc, to half
# of an exposure of 0.1 s.
TRIED_S = np.geomspace(1e-5, 0.05, 75)
MIN_GAIN = 6.0  # of twice the log-likelihood: noise gives it in one of 200 sensors
LARGEST = 25.0  # squared residual over its variance that counts: a larger one is a wrong detection
# Degree of the polynomial that follows a passage: one for four detections. Passages in low
# orbits, of 2 to 30 s, leave 0.03 arcsec.
MIN_DEGREE, MAX_DEGREE, PER_DEGREE = 2, 5, 4
MAX_WARP = 0.8  # of time, of a passage that comes near head on
MIN_FREE = 0.1  # with less, a distance tells of its neighbours only


class AlongMotion(NamedTuple):
    """The detections of a tracklet along its motion.

    along : (n, 3) float, unit vectors, ICRS
    rate_rad_s : (n,) float
    miss_rad : (n,) float, distance from a smooth motion
    free : (n,) float, share of a detection's variance that this distance has: 1 minus its leverage
    weight : (n,) float, degrees of freedom of one distance: the fit makes them depend on each other
    """

    along: Array
    rate_rad_s: Array
    miss_rad: Array
    free: Array
    weight: Array


def along_motion(time_s: Array, u: Array) -> AlongMotion:
    """Return the motion of a tracklet's detections.

    A straight path at constant speed has the gnomonic coordinate (p + q t) / (1 + s t): it is
    linear in the warped time t / (1 + s t). A polynomial in it follows the real path.

    Parameters
    ----------
    time_s, u : (n,), (n, 3) float
        Times [s], in order, and unit vectors, ICRS; three at least, apart from each other.
    """
    n = len(time_s)
    pole = np.cross(u[0], u[-1])
    pole /= np.linalg.norm(pole)
    axis = u[n // 2] - (u[n // 2] @ pole) * pole
    axis /= np.linalg.norm(axis)
    x = (u @ np.cross(pole, axis)) / (u @ axis)
    half_s = (time_s[-1] - time_s[0]) / 2
    tau = (time_s - time_s[0]) / half_s - 1.0
    design = np.stack([np.ones(n), tau, -tau * x], axis=1)
    warp = float(np.clip(np.linalg.lstsq(design, x, rcond=None)[0][2], -MAX_WARP, MAX_WARP))
    warped = tau * (1.0 - warp**2) / (1.0 + warp * tau) + warp  # -1 to 1, as tau
    degree = int(np.clip(n // PER_DEGREE, MIN_DEGREE, min(MAX_DEGREE, n - 1)))
    Q, R = np.linalg.qr(chebvander(warped, degree))
    fitted = Q.T @ x
    slope = chebval(warped, chebder(np.linalg.solve(R, fitted)))
    to_angle = 1.0 / (1.0 + x * x)
    along = np.cross(pole, u)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return AlongMotion(
        along,
        np.abs(slope) * to_angle * (1.0 - warp**2) / (1.0 + warp * tau) ** 2 / half_s,
        (x - Q @ fitted) * to_angle,
        np.maximum(1.0 - (Q * Q).sum(axis=1), 0.0),
        np.full(n, 1.0 - (degree + 1) / n),
    )


def time_error(motion: AlongMotion, variance_rad2: Array) -> float:
    """Return the 1-sigma error in time [s] that residuals along the motion show; 0 if none.

    It is the likeliest one, if it explains the residuals clearly better than no error.

    Parameters
    ----------
    motion
        Of the detections of all fast tracklets of a sensor.
    variance_rad2 : (n,) float
        The stated variances of their directions.
    """
    used = motion.free > MIN_FREE
    _, rate, miss, free, weight = (values[used] for values in motion)
    stated = free * variance_rad2[used]
    cost = [_cost(miss, stated + free * (rate * tried_s) ** 2, weight) for tried_s in TRIED_S]
    best = int(np.argmin(cost))
    clear = cost[best] < _cost(miss, stated, weight) - MIN_GAIN
    return float(TRIED_S[best]) if clear else 0.0


def _cost(miss: Array, variance: Array, weight: Array) -> float:
    """Return -2 log-likelihood of residuals with these variances, (n,) each."""
    square = np.minimum(miss**2 / variance, LARGEST)
    return float((np.log(variance) + square) @ weight)
