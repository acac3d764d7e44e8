"""Draw the orbits of a scene: elements, positions, random ones, and objects near them."""

import math

import numpy as np
import numpy.typing as npt

from epipole.schemas.errors import SceneError
from epipole.schemas.simulation.orbit import Orbit
from epipole.tasks.algorithms.simulation.constants import GM_KM3_S2
from epipole.tasks.algorithms.simulation.orbits import (
    circular_velocity,
    elements_from_state,
    mean_from_true_anomaly,
    state_at,
)

Array = npt.NDArray[np.float64]


def draw_elements(orbit: Orbit, rng: np.random.Generator) -> Array:
    """Return the (6,) elements of an orbit. Only a random orbit draws from `rng`."""
    if orbit.random is not None:
        return _random_elements(orbit.random, rng)
    if orbit.position_km is not None:
        r_km = np.array(orbit.position_km)
        v = orbit.velocity_km_s
        v_km_s = circular_velocity(r_km) if v is None else np.array(v)
        if v_km_s @ v_km_s >= 2 * GM_KM3_S2 / np.linalg.norm(r_km):
            raise SceneError(f"velocity_km_s {v}: faster than escape velocity")
        return elements_from_state(r_km, v_km_s)
    angles = np.radians([orbit.i_deg, orbit.raan_deg, orbit.argp_deg])
    if orbit.true_anomaly_deg is not None:
        mean = mean_from_true_anomaly(math.radians(orbit.true_anomaly_deg), orbit.e)
    else:
        mean = math.radians(orbit.mean_anomaly_deg or 0.0)
    return np.array([orbit.a_km, orbit.e, *angles, mean], float)


def _random_elements(kind: str, rng: np.random.Generator) -> Array:
    a_low, a_high, e, tilt = {
        "leo": (6900.0, 7600.0, 0.002, np.radians(100.0)),
        "meo": (20000.0, 30000.0, 0.02, np.radians(65.0)),
        "geo": (42120.0, 42210.0, 0.0005, np.radians(8.0)),
    }[kind]
    u = rng.random(6)
    i = tilt * u[2] if kind != "leo" else np.radians(30.0) + (tilt - np.radians(30.0)) * u[2]
    return np.array([a_low + (a_high - a_low) * u[0], e * u[1], i, *(2 * np.pi * u[3:])])


def draw_near(orbit: Orbit, spread_km: float, rng: np.random.Generator) -> Array:
    """Return the (6,) elements of a body about the place that an orbit has at the start."""
    elements = draw_elements(orbit, rng)
    if not spread_km:
        return elements
    r_km, v_km_s = state_at(elements, np.zeros(()))
    moved = r_km + rng.standard_normal(3) * spread_km
    # The same direction of motion, but horizontal and circular at the new position.
    level = v_km_s - moved * (v_km_s @ moved) / (moved @ moved)
    speed = np.linalg.norm(circular_velocity(moved))
    return elements_from_state(moved, level / np.linalg.norm(level) * speed)
