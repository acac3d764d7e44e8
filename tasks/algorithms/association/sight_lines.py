"""Lines of sight, two at a time: whether they meet, and where an object can be."""

import numpy as np
from numba import njit

BEYOND = 0.2  # share of the farthest distance
SLACK_SIGMA = 3.0  # a point may lie this far outside where objects can be


@njit(cache=True, nogil=True)
def quantile(dof, sigma):
    """Return the chi-square with `dof` degrees of freedom that is as rare as `sigma`.

    Wilson and Hilferty (1931): its cube root is close to normal.
    """
    a = 2.0 / (9.0 * dof)
    return dof * (1.0 - a + sigma * np.sqrt(a)) ** 3


@njit(cache=True, nogil=True)
def pair_miss(views, i, j, m, lowest, farthest):
    """Return the squared miss of two lines of sight over its variance; NaN where impossible.

    Impossible: parallel, meeting behind a sensor, or not, by 3 sigma of the range, between the
    lowest and the farthest place of an object.
    """
    ui, uj = views.u[i, m], views.u[j, m]
    ri, rj = views.r_km[views.sensor[i], m], views.r_km[views.sensor[j], m]
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
    ci, cj = views.cov[i, m], views.cov[j, m]
    radius2 = 0.0
    for a in range(3):
        radius2 += (ri[a] + range_i * ui[a]) ** 2
    si, sj = views.sigma_km[i, m], views.sigma_km[j, m]
    spread = range_i * range_i * (ci[0, 0] + ci[1, 1]) + range_j * range_j * (cj[0, 0] + cj[1, 1])
    slack = SLACK_SIGMA * np.sqrt(spread + 2 * (si * si + sj * sj)) / sine
    radius = np.sqrt(radius2)
    if radius + slack < lowest or radius - min(slack, BEYOND * farthest) > farthest:
        return np.nan
    variance = si * si + sj * sj
    bi, bj = views.basis[i, m], views.basis[j, m]
    p0 = (bi[0, 0] * n0 + bi[0, 1] * n1 + bi[0, 2] * n2) / sine * range_i
    p1 = (bi[1, 0] * n0 + bi[1, 1] * n1 + bi[1, 2] * n2) / sine * range_i
    q0 = (bj[0, 0] * n0 + bj[0, 1] * n1 + bj[0, 2] * n2) / sine * range_j
    q1 = (bj[1, 0] * n0 + bj[1, 1] * n1 + bj[1, 2] * n2) / sine * range_j
    variance += p0 * p0 * ci[0, 0] + 2 * p0 * p1 * ci[0, 1] + p1 * p1 * ci[1, 1]
    variance += q0 * q0 * cj[0, 0] + 2 * q0 * q1 * cj[0, 1] + q1 * q1 * cj[1, 1]
    miss = (b0 * n0 + b1 * n1 + b2 * n2) / sine
    return miss * miss / variance
