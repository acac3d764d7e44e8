"""Screening: the satellites of a large catalogue that may be at a place, at little cost.

States of the whole catalogue are computed every half hour. A place is compared with the planes,
then the radii, then the places of two-body orbits from these states; what passes is computed
exactly.
"""

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.constants import GM_KM3_S2
from epipole.tasks.algorithms.known_objects.prediction import Satellites, predict

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

NODE_NS = 1_800_000_000_000
# What two bodies leave out in a quarter of an hour: 0.005 of the radius is twice what was found.
ROOM = 0.005
KEPLER_STEPS = 6


class Screen:
    """A catalogue whose satellites near a place and time can be asked for.

    Parameters
    ----------
    satellites
        n of them.
    """

    def __init__(self, satellites: Satellites) -> None:
        self._satellites = satellites
        self._nodes: dict[int, Array] = {}

    def near(self, r_km: Array, time_ns: int, reach_km: Array) -> Indices:
        """Return the satellites that may be within `reach_km` (n,) of a (3,) place, GCRF."""
        node = (time_ns + NODE_NS // 2) // NODE_NS
        if node not in self._nodes:
            self._nodes[node] = predict(self._satellites, np.array([node * NODE_NS]))[:, 0]
        states = self._nodes[node]
        gate = reach_km + ROOM * np.linalg.norm(r_km)
        found = _in_plane_and_shell(states, r_km, gate)
        there = two_body(states[found], (time_ns - node * NODE_NS) / 1e9)
        return found[np.linalg.norm(there - r_km, axis=1) < gate[found]]


def _in_plane_and_shell(states: Array, r_km: Array, gate: Array) -> Indices:
    """Return the rows of states whose orbits pass the place within the gate."""
    r, v = states[:, :3], states[:, 3:]
    momentum = np.cross(r, v)
    off_plane = np.abs(momentum @ r_km) / np.linalg.norm(momentum, axis=1)
    distance = np.linalg.norm(r, axis=1)
    a = 1.0 / (2.0 / distance - np.sum(v * v, axis=1) / GM_KM3_S2)
    e2 = 1.0 - np.sum(momentum * momentum, axis=1) / (GM_KM3_S2 * a)
    e = np.sqrt(np.maximum(e2, 0.0))
    at = np.linalg.norm(r_km)
    in_shell = (at > a * (1 - e) - gate) & (at < a * (1 + e) + gate)
    return np.flatnonzero((off_plane < gate) & in_shell)  # NaN: neither


def two_body(states: Array, dt_s: float) -> Array:
    """Return (n, 3) places of (n, 6) elliptic states after a time, for two bodies."""
    r, v = states[:, :3], states[:, 3:]
    distance = np.linalg.norm(r, axis=1)
    a = 1.0 / (2.0 / distance - np.sum(v * v, axis=1) / GM_KM3_S2)
    n = np.sqrt(GM_KM3_S2 / a**3)
    s = np.sum(r * v, axis=1) / np.sqrt(GM_KM3_S2 * a)  # e sin E
    c = 1.0 - distance / a  # e cos E
    x = n * dt_s  # difference of eccentric anomalies
    for _ in range(KEPLER_STEPS):
        f = x - c * np.sin(x) + s * (1 - np.cos(x)) - n * dt_s
        x = x - f / (1 - c * np.cos(x) + s * np.sin(x))
    forward = 1 - a / distance * (1 - np.cos(x))
    lag = dt_s - (x - np.sin(x)) / n
    return np.asarray(forward[:, None] * r + lag[:, None] * v)
