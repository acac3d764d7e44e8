"""Pairs of lines of sight: whether they meet where an object can be."""

import numpy as np

from epipole.tasks.algorithms.association.views import (
    DX,
    DY,
    HAS_RATE,
    PLANE,
    SIGMA_KM,
    V_KM_S,
    XX,
    XY,
    YY,
    X,
    Y,
    direction,
)
from epipole.tasks.algorithms.constants import SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.kernels import borrowing_kernel

BEYOND = 0.2  # share of the farthest distance by which a point may lie beyond it
SLACK_SIGMA = 3.0  # a point may lie this far outside the limits


@borrowing_kernel
def quantile(dof, sigma):
    """Return the chi-square with `dof` degrees of freedom that is as improbable as `sigma`.

    Wilson and Hilferty (1931): its cube root is close to normal.
    """
    a = 2.0 / (9.0 * dof)
    return dof * (1.0 - a + sigma * np.sqrt(a)) ** 3


@borrowing_kernel
def pair_miss(views, i, j, m, lowest, farthest, ui, uj):
    """Return the squared gap of two lines of sight over its variance; NaN if they cannot meet.

    They cannot if they are parallel, or meet behind a sensor or, by 3 sigma, outside the limits
    [km from the Earth's centre]. `ui`, `uj` (3,) are work space.
    """
    direction(views, i, m, ui)
    direction(views, j, m, uj)
    ri, rj = views.camera[views.sensor[i], m], views.camera[views.sensor[j], m]
    n0 = ui[1] * uj[2] - ui[2] * uj[1]
    n1 = ui[2] * uj[0] - ui[0] * uj[2]
    n2 = ui[0] * uj[1] - ui[1] * uj[0]
    sine2 = n0 * n0 + n1 * n1 + n2 * n2
    if sine2 < 1e-14:  # 0.02 arcsec: parallel for any sensor
        return np.nan
    b0, b1, b2 = rj[0] - ri[0], rj[1] - ri[1], rj[2] - ri[2]
    along_i = b0 * ui[0] + b1 * ui[1] + b2 * ui[2]
    along_j = b0 * uj[0] + b1 * uj[1] + b2 * uj[2]
    cosine = ui[0] * uj[0] + ui[1] * uj[1] + ui[2] * uj[2]
    range_i = (along_i - cosine * along_j) / sine2
    range_j = (cosine * along_i - along_j) / sine2
    if range_i <= 0.0 or range_j <= 0.0:
        return np.nan
    sine = np.sqrt(sine2)
    radius2 = 0.0
    for a in range(3):
        radius2 += (ri[a] + range_i * ui[a]) ** 2
    si, sj = views.sight[i, m, SIGMA_KM], views.sight[j, m, SIGMA_KM]
    spread = range_i**2 * _spread(views, i, m) + range_j**2 * _spread(views, j, m)
    slack = SLACK_SIGMA * np.sqrt(spread + 2 * (si * si + sj * sj)) / sine
    radius = np.sqrt(radius2)
    if radius + slack < lowest or radius - min(slack, BEYOND * farthest) > farthest:
        return np.nan
    variance = si * si + sj * sj
    variance += range_i**2 * _across(views, i, m, n0 / sine, n1 / sine, n2 / sine)
    variance += range_j**2 * _across(views, j, m, n0 / sine, n1 / sine, n2 / sine)
    miss = (b0 * n0 + b1 * n1 + b2 * n2) / sine
    # Light takes longer to the farther sensor, which sees the object at an earlier position.
    if views.sight[j, m, HAS_RATE] > 0.0:
        speed = _speed(views, j, m, range_j, n0 / sine, n1 / sine, n2 / sine)
    else:
        speed = _speed(views, i, m, range_i, n0 / sine, n1 / sine, n2 / sine)
    miss += speed * (range_j - range_i) / SPEED_OF_LIGHT_KM_S
    return miss * miss / variance


@borrowing_kernel
def nearest_ranges(r_a, u_a, r_b, u_b):
    """Return the cosine between two lines of sight, and the ranges [km] of their nearest points.

    `r_a` and `r_b` are positions (3,) [km], GCRF, or begin with one, as rows of `Views.camera` do;
    `u_a` and `u_b` (3,) are unit vectors, ICRS. The ranges of parallel lines are inf or NaN.
    """
    cosine, along_a, along_b = 0.0, 0.0, 0.0
    for k in range(3):
        d = r_b[k] - r_a[k]
        cosine += u_a[k] * u_b[k]
        along_a += d * u_a[k]
        along_b += d * u_b[k]
    sine2 = 1.0 - cosine * cosine
    return cosine, (along_a - cosine * along_b) / sine2, (cosine * along_a - along_b) / sine2


@borrowing_kernel
def meeting_point(views, i, j, m, work, x):
    """Write to x (3,) [km], GCRF, the point of line i that is nearest to line j, at instant m.

    The lines of sight of two tracklets meet, see `pair_miss`; `work` (2, 3) is work space.
    """
    r_i, u_i, u_j = views.camera[views.sensor[i], m], work[0], work[1]
    direction(views, i, m, u_i)
    direction(views, j, m, u_j)
    _, reach, _ = nearest_ranges(r_i, u_i, views.camera[views.sensor[j], m], u_j)
    for a in range(3):
        x[a] = r_i[a] + reach * u_i[a]


@borrowing_kernel
def _speed(views, i, m, range_km, n0, n1, n2):
    """Return the object's velocity [km/s] along a unit vector, from the rate of tracklet i.

    The vector (`n0`, `n1`, `n2`), ICRS, is perpendicular to the line of sight. 0 where the rate is
    unknown.
    """
    cam, see = views.camera[views.sensor[i], m], views.sight[i, m]
    if see[HAS_RATE] == 0.0:
        return 0.0
    a = cam[PLANE] * n0 + cam[PLANE + 1] * n1 + cam[PLANE + 2] * n2
    b = cam[PLANE + 3] * n0 + cam[PLANE + 4] * n1 + cam[PLANE + 5] * n2
    turning = (see[DX] * a + see[DY] * b) / np.sqrt(1.0 + see[X] ** 2 + see[Y] ** 2)
    sensor_speed = cam[V_KM_S] * n0 + cam[V_KM_S + 1] * n1 + cam[V_KM_S + 2] * n2
    return sensor_speed + range_km * turning


@borrowing_kernel
def _spread(views, i, m):
    """Return the trace of the covariance of tracklet i on its sensor's plane [rad^2]."""
    return views.sight[i, m, XX] + views.sight[i, m, YY]


@borrowing_kernel
def _across(views, i, m, n0, n1, n2):
    """Return the variance [rad^2] of a direction along a unit vector across it.

    The direction is that of tracklet i at instant m, the vector (`n0`, `n1`, `n2`), ICRS.
    """
    cam, see = views.camera[views.sensor[i], m], views.sight[i, m]
    a = cam[PLANE] * n0 + cam[PLANE + 1] * n1 + cam[PLANE + 2] * n2
    b = cam[PLANE + 3] * n0 + cam[PLANE + 4] * n1 + cam[PLANE + 5] * n2
    total = a * a * see[XX] + 2 * a * b * see[XY] + b * b * see[YY]
    return total / (1.0 + see[X] ** 2 + see[Y] ** 2)
