"""Epipolar geometry of two sensors, on directions instead of pixels.

The baseline and a direction seen by one sensor span a plane: the epipolar plane. The direction
of the same object from the other sensor lies in it. In an image the plane is the epipolar line.
"""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Indices
from epipole.tasks.algorithms.geometry.directions import lengths, tangent_basis
from epipole.tasks.algorithms.kernels import kernel


class UncertainSight(NamedTuple):
    """A line of sight with its errors.

    r_km : (..., 3) float
        Sensor position [km].
    u : (..., 3) float
        Unit vector from the sensor to the object.
    cov : (..., 2, 2) float
        Covariance of the direction [rad^2] on `tangent_basis(u)`.
    sigma_km : (...) float
        1-sigma error of the position, per axis [km].
    """

    r_km: Array
    u: Array
    cov: Array
    sigma_km: Array


def epipolar_angle(r_1_km: Array, u_1: Array, r_2_km: Array, u_2: Array) -> Array:
    """Return how far the second direction lies from the first one's epipolar plane [rad].

    Parameters
    ----------
    r_1_km, r_2_km : (..., 3) float
        Sensor positions [km], any one frame.
    u_1, u_2 : (..., 3) float
        Unit vectors from the sensors to the object, same axes, aberration removed.

    Returns
    -------
    (...) float
        Signed angle; times the focal length in pixels it is the distance to the epipolar line.
        0 if the first direction lies along the baseline: the plane is undefined.

    References
    ----------
    Huang, Zhang, Feng: Space target synchronization association method under distributed star
    sensor, doi 10.19650/j.cnki.cjsi.J1905157. There it is |p_2' F p_1| over the norm of the
    line; on the unit sphere it holds for any camera.
    """
    baseline = r_2_km - r_1_km
    normal = np.cross(baseline, u_1)
    length = lengths(normal)
    defined = length > 1e-12 * lengths(baseline)  # below, it is rounding
    sine = np.einsum("...i,...i->...", normal, u_2) / np.where(defined, length, np.inf)
    return np.arcsin(np.clip(sine, -1.0, 1.0))


def epipolar_sigma(first: UncertainSight, second: UncertainSight, x_km: Array) -> Array:
    """Return the standard deviation of `epipolar_angle` [rad] for an object at x.

    Parameters
    ----------
    first, second
        The two lines of sight, in the same axes.
    x_km : (..., 3) float
        The object's position [km]. The error of the first direction is scaled by the ratio of the
        ranges.
    """
    normal = np.cross(first.u, second.u)
    length = lengths(normal)[..., None]
    normal = normal / np.where(length > 0, length, 1.0)
    variance_km2 = sum(
        _variance_along(normal, sight) * lengths(x_km - sight.r_km) ** 2 + sight.sigma_km**2
        for sight in (first, second)
    )
    return np.asarray(np.sqrt(variance_km2) / lengths(x_km - second.r_km))


def _variance_along(axis: Array, sight: UncertainSight) -> Array:
    """Return the variance of directions along unit vectors (..., 3) at right angles to them."""
    a, b = np.moveaxis(np.einsum("...ai,...i->...a", tangent_basis(sight.u), axis), -1, 0)
    aa, ab, bb = (sight.cov[..., i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    return np.asarray(a * a * aa + 2 * a * b * ab + b * b * bb)


@kernel
def _mean_squares(offsets, ranked, max_others, r, u, out):
    """Write the mean square of each view's angles to the epipolar planes of others to `out`.

    Arguments as in `epipolar_rms`; `r` (n, 3) [km], `u` (n, 3), `out` (n,) [rad^2].
    """
    for g in range(len(offsets) - 1):
        lo, hi = offsets[g], offsets[g + 1]
        for b in range(lo, hi):
            total, count = 0.0, 0
            for k in range(lo, hi):
                a = ranked[k]
                if a == b:
                    continue
                if count == max_others:
                    break
                count += 1
                x, y, z = r[b, 0] - r[a, 0], r[b, 1] - r[a, 1], r[b, 2] - r[a, 2]
                n0 = y * u[a, 2] - z * u[a, 1]
                n1 = z * u[a, 0] - x * u[a, 2]
                n2 = x * u[a, 1] - y * u[a, 0]
                length = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
                if length > 1e-12 * np.sqrt(x * x + y * y + z * z):
                    sine = (n0 * u[b, 0] + n1 * u[b, 1] + n2 * u[b, 2]) / length
                    total += np.arcsin(min(max(sine, -1.0), 1.0)) ** 2
            out[b] = total / max(count, 1)


def epipolar_rms(
    offsets: Indices, ranked: Indices, max_others: int, r_km: Array, u: Array
) -> Array:
    """Return each view's rms distance to the epipolar planes of others of its group [rad].

    Parameters
    ----------
    offsets : (g + 1,) int
        Group k has the views ``offsets[k]:offsets[k + 1]``.
    ranked : (n,) int
        The views of each group, the best first, as rows of `u`.
    max_others
        Maximum number of others, the best ones: so the cost does not grow with the square of the
        number of sensors.
    r_km, u : (n, 3) float
        Sensor positions [km] and directions; see `epipolar_angle`.
    """
    out = np.empty(len(u))
    _mean_squares(
        np.array(offsets, np.int64), np.array(ranked, np.int64), int(max_others),
        np.array(r_km, float, order="C"), np.array(u, float, order="C"), out,
    )  # fmt: skip
    return np.sqrt(out)
