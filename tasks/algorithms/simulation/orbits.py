"""Two-body orbits about the Earth."""

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.simulation.constants import GM_KM3_S2

Array = npt.NDArray[np.float64]


def eccentric_anomaly(mean: Array, e: Array) -> Array:
    """Return the eccentric anomalies [rad] of mean anomalies [rad], by Newton's method."""
    mean = np.remainder(mean + np.pi, 2 * np.pi) - np.pi
    E = mean + e * np.sin(mean)
    for _ in range(50):
        step = (E - e * np.sin(E) - mean) / (1 - e * np.cos(E))
        E = E - step
        if not np.any(np.abs(step) > 1e-14):
            break
    return E


def perifocal_axes(elements: Array) -> tuple[Array, Array]:
    """Return the unit vectors to perigee and along the motion there, (..., 3), GCRF."""
    _, _, i, raan, argp, _ = np.moveaxis(np.asarray(elements, float), -1, 0)
    co, so, ci, si = np.cos(raan), np.sin(raan), np.cos(i), np.sin(i)
    cw, sw = np.cos(argp), np.sin(argp)
    to_perigee = np.stack([co * cw - so * sw * ci, so * cw + co * sw * ci, sw * si], axis=-1)
    along = np.stack([-co * sw - so * cw * ci, -so * sw + co * cw * ci, cw * si], axis=-1)
    return to_perigee, along


def state_at(elements: Array, t_s: Array) -> tuple[Array, Array]:
    """Return positions [km] and velocities [km/s], GCRF, at times since the elements' epoch.

    Parameters
    ----------
    elements : (..., 6) float
        a [km], e, i, RAAN, argument of perigee, mean anomaly at the epoch [rad]; e < 1.
    t_s : (...) float
        Seconds since the epoch; the shapes of both are broadcast.

    References
    ----------
    Vallado (2013), Fundamentals of Astrodynamics and Applications, section 2.
    """
    elements = np.asarray(elements, float)
    a, e, mean0 = elements[..., 0], elements[..., 1], elements[..., 5]
    motion = np.sqrt(GM_KM3_S2 / a**3)
    E = eccentric_anomaly(mean0 + motion * t_s, e)
    cos_E, sin_E = np.cos(E), np.sin(E)
    minor = np.sqrt(1 - e * e)
    rate = motion * a / (1 - e * cos_E)
    p, q = perifocal_axes(elements)
    r = p * (a * (cos_E - e))[..., None] + q * (a * minor * sin_E)[..., None]
    v = p * (-rate * sin_E)[..., None] + q * (rate * minor * cos_E)[..., None]
    return r, v


def mean_from_true_anomaly(true: float, e: float) -> float:
    """Return the mean anomaly [rad] of a true anomaly [rad]."""
    E = 2 * np.arctan2(np.sqrt(1 - e) * np.sin(true / 2), np.sqrt(1 + e) * np.cos(true / 2))
    return float(E - e * np.sin(E))


def circular_velocity(r_km: Array) -> Array:
    """Return the velocity [km/s] of an eastward circular orbit through a position (3,)."""
    east = np.cross([0.0, 0.0, 1.0], r_km)
    return east / np.linalg.norm(east) * np.sqrt(GM_KM3_S2 / np.linalg.norm(r_km))


def elements_from_state(r_km: Array, v_km_s: Array) -> Array:
    """Return the (6,) elements of a state (3,), (3,); its instant is their epoch.

    The perigee of a circular orbit is put at its node, the node of an equatorial orbit on the x
    axis.
    """
    r, speed2 = float(np.linalg.norm(r_km)), float(v_km_s @ v_km_s)
    h = np.cross(r_km, v_km_s)
    h_unit = h / np.linalg.norm(h)
    a = 1 / (2 / r - speed2 / GM_KM3_S2)
    e_vector = np.cross(v_km_s, h) / GM_KM3_S2 - r_km / r
    e = float(np.linalg.norm(e_vector))
    node = np.array([-h[1], h[0], 0.0])
    # An inclination or eccentricity below 1e-11 is rounding: its direction is arbitrary.
    flat = np.linalg.norm(node) < 1e-11 * np.linalg.norm(h)
    node = np.array([1.0, 0.0, 0.0]) if flat else node / np.linalg.norm(node)
    across = np.cross(h_unit, node)
    i = np.arctan2(np.hypot(h_unit[0], h_unit[1]), h_unit[2])
    raan = np.arctan2(node[1], node[0])
    argp = 0.0 if e < 1e-11 else np.arctan2(e_vector @ across, e_vector @ node)
    latitude = np.arctan2(r_km @ across, r_km @ node)
    mean = mean_from_true_anomaly(float(latitude - argp), e)
    return np.array([a, e, i, raan, argp, mean])
