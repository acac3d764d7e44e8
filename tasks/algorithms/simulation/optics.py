"""The true lines of sight and the true camera: where an object appears in the image."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Flags
from epipole.tasks.algorithms.simulation.constants import EARTH_RADIUS_KM, LIGHT_KM_S

# The camera: directions in the sensor frame to pixel positions.


class TrueOptics(NamedTuple):
    """Pinhole and lens [px; the coefficients have no unit], and the time from row to row [s]."""

    width: int
    height: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    fisheye: bool = False
    line_time_s: float = 0.0


def bend(optics: TrueOptics, x: Array, y: Array) -> tuple[Array, Array]:
    """Return normalised coordinates behind a Brown-Conrady lens.

    (x, y) are those of a pinhole; a fisheye's have the angle from the boresight for its tangent.
    """
    r2 = x**2 + y**2
    radial = 1 + optics.k1 * r2 + optics.k2 * r2**2 + optics.k3 * r2**3 + optics.k4 * r2**4
    xy = 2 * x * y
    return (
        radial * x + optics.p1 * xy + optics.p2 * (r2 + 2 * x**2),
        radial * y + optics.p2 * xy + optics.p1 * (r2 + 2 * y**2),
    )


def image_position(optics: TrueOptics, u: Array) -> tuple[Array, Array]:
    """Return columns and rows [px] of (n, 3) sensor-frame directions with z > 0."""
    x, y = u[:, 0] / u[:, 2], u[:, 1] / u[:, 2]
    if optics.fisheye:
        across = np.hypot(u[:, 0], u[:, 1])
        angle = np.arctan2(across, u[:, 2])
        x, y = (angle * part / np.where(across > 0, across, 1.0) for part in (u[:, 0], u[:, 1]))
    x, y = bend(optics, x, y)
    return optics.fx_px * x + optics.cx_px, optics.fy_px * y + optics.cy_px


def on_image(optics: TrueOptics, x_px: Array, y_px: Array) -> Flags:
    """Return which positions are on the image; a pixel extends half a pixel about its centre."""
    return (np.abs(x_px - (optics.width - 1) / 2) < optics.width / 2) & (
        np.abs(y_px - (optics.height - 1) / 2) < optics.height / 2
    )


def field_radius(optics: TrueOptics) -> float:
    """Return the angle [rad] from the boresight to the farthest corner, plus 1 %.

    Of a lens that folds before the corners it is the angle where it folds: farther directions have
    the pixel positions of nearer ones.
    """
    columns = np.linspace(-0.5, optics.width - 0.5, 9)
    rows = np.linspace(-0.5, optics.height - 0.5, 9)
    x, y = (v.ravel() for v in np.meshgrid(columns, rows))
    x, y = (x - optics.cx_px) / optics.fx_px, (y - optics.cy_px) / optics.fy_px
    wanted_x, wanted_y, fold = x, y, _fold_radius(optics)
    for _ in range(30):  # a fixed-point iteration: the distortion is small
        got_x, got_y = bend(optics, x, y)
        x, y = x + wanted_x - got_x, y + wanted_y - got_y
        shrink = np.minimum(1.0, fold / np.maximum(np.hypot(x, y), 1e-12))
        x, y = x * shrink, y * shrink
    farthest = float(np.max(np.hypot(x, y)))
    angle = farthest if optics.fisheye else float(np.arctan(farthest))
    folds = farthest > fold * (1 - 1e-9)
    return angle if folds else angle * 1.01 + 1e-4


def _fold_radius(optics: TrueOptics) -> float:
    """Return the undistorted radius from which on the radial distortion folds the image."""
    # The slope of the distorted radius, a polynomial in the squared radius.
    slope = [9 * optics.k4, 7 * optics.k3, 5 * optics.k2, 3 * optics.k1, 1.0]
    roots = np.roots(slope)
    real = roots.real[(np.abs(roots.imag) < 1e-12) & (roots.real > 0)]
    return float(np.sqrt(real.min())) if len(real) else np.inf


# Lines of sight: light time, aberration, and the Earth in between.


def boost(n: Array, v_km_s: Array) -> Array:
    """Return the apparent directions towards light sources for an observer moving at v.

    The photon's four-momentum (1, -n) is transformed to the observer's frame (Lorentz boost).

    Parameters
    ----------
    n : (n, 3) float
        Unit vectors towards the sources for an observer at rest in the frame of v.
    v_km_s : (n, 3) float
        Velocity of the observer.
    """
    beta = v_km_s / LIGHT_KM_S
    beta2 = np.einsum("ij,ij->i", beta, beta)
    gamma = 1 / np.sqrt(1 - beta2)
    along = np.einsum("ij,ij->i", n, beta)
    # (gamma - 1) / beta^2, without cancellation at small speeds.
    apparent = n + (gamma * gamma / (gamma + 1) * along + gamma)[:, None] * beta
    return apparent / np.linalg.norm(apparent, axis=1, keepdims=True)


def received_from(
    states_at: Callable[[Array], tuple[Array, Array]],
    t_s: Array,
    r_sensor_km: Array,
    v_earth_km_s: Array,
) -> tuple[Array, Array]:
    """Return barycentric vectors from sensors to objects at the emission of the received light.

    In the barycentric frame the Earth moves on while the light is under way.

    Parameters
    ----------
    states_at : callable
        Geocentric positions [km] and velocities [km/s] of the n objects, (n, 3), at (n,) times.
    t_s : (n,) float
        Reception, on the same time scale as `states_at`.
    r_sensor_km : (n, 3) float
        Geocentric position of the sensor at reception, GCRF.
    v_earth_km_s : (n, 3) float
        Barycentric velocity of the Earth at reception.

    Returns
    -------
    d_km : (n, 3) float
        Object at emission minus sensor at reception, both barycentric.
    r_km : (n, 3) float
        Geocentric position of the object at emission.
    """
    r, v = states_at(t_s)
    tau = np.linalg.norm(r - r_sensor_km, axis=1) / LIGHT_KM_S
    sent = tau
    r, v = states_at(t_s - sent)
    for _ in range(3):
        # Motion is linear to 1e-6 km over the remaining 1e-5 s, and the Earth's over 0.3 s.
        r_sent = r - v * (tau - sent)[:, None]
        d = r_sent - r_sensor_km - v_earth_km_s * tau[:, None]
        tau = np.linalg.norm(d, axis=1) / LIGHT_KM_S
    return d, r_sent


def hidden_by_earth(r_sensor_km: Array, u: Array, distance_km: Array | float) -> Flags:
    """Return which lines of sight meet the Earth before they end.

    Parameters
    ----------
    r_sensor_km, u : (n, 3) float
        Geocentric positions of the sensors, and unit vectors of the geometric directions.
    distance_km : (n,) float or float
        Lengths of the lines; infinity for stars.
    """
    along = -np.einsum("ij,ij->i", r_sensor_km, u)
    miss2 = np.einsum("ij,ij->i", r_sensor_km, r_sensor_km) - along * along
    return (along > 0) & (along < distance_km) & (miss2 < EARTH_RADIUS_KM**2)
