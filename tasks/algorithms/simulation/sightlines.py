"""Lines of sight: light time, aberration, and the Earth in between."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.simulation.constants import EARTH_RADIUS_KM, LIGHT_KM_S

Array = npt.NDArray[np.float64]


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


def hidden_by_earth(
    r_sensor_km: Array, u: Array, distance_km: Array | float
) -> npt.NDArray[np.bool_]:
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
