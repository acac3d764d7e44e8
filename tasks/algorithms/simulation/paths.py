"""Paths of bodies: two-body orbits, or sampled positions with cubics between them."""

from dataclasses import dataclass

import numpy as np

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.tasks.algorithms.simulation.constants import GM_KM3_S2

# Two-body orbits about the Earth.


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


# Sampled paths.


# [s] A cubic between nodes errs by step^4 / 384 of the fourth derivative, and a low orbit's is
# 1e-8 km/s^4: less than a millimetre.
NODE_STEP_S = 10
END_NODES = 2  # at each end, which only give the derivatives of the others


@dataclass(frozen=True)
class Nodes:
    """States of bodies at times `NODE_STEP_S` apart."""

    first_s: float
    r_km: Array  # (n, m, 3) GCRF
    v_km_s: Array


@dataclass(frozen=True)
class Paths:
    """The paths of n bodies. Each has two-body elements, or states at nodes."""

    elements: Array  # (n, 6), see `state_at`; NaN where a body is sampled
    row: Indices  # (n,) of the nodes; -1 where a body has elements
    nodes: Nodes

    def __len__(self) -> int:
        return len(self.elements)

    def at(self, t_s: Array, body: Indices | int = 0) -> tuple[Array, Array]:
        """Return positions [km] and velocities [km/s] (..., 3), GCRF.

        Parameters
        ----------
        t_s : (...) float
            Seconds since the scene's start. Before the first and after the last node, the
            cubics there go on.
        body : (...) int or int
            Index of each body; broadcast with the times.
        """
        row = self.row[body]
        if np.all(row < 0):
            return state_at(self.elements[body], t_s)
        if np.all(row >= 0):
            return interpolated(self.nodes, row, t_s)
        body, t_s = np.broadcast_arrays(body, t_s)
        r_km, v_km_s = (np.empty((*np.shape(t_s), 3)) for _ in range(2))
        for part in (self.row[body] < 0, self.row[body] >= 0):
            r_km[part], v_km_s[part] = self.at(t_s[part], body[part])
        return r_km, v_km_s

    def of(self, *bodies: int) -> "Paths":
        """Return the paths of some bodies."""
        part = np.array(bodies, int)
        row = self.row[part]
        sampled = row >= 0
        nodes = Nodes(
            self.nodes.first_s, self.nodes.r_km[row[sampled]], self.nodes.v_km_s[row[sampled]]
        )
        row = np.where(sampled, np.cumsum(sampled) - 1, -1)
        return Paths(self.elements[part], row, nodes)

    @property
    def is_sampled(self) -> Flags:
        """Return which bodies have no elements."""
        return self.row >= 0


NO_NODES = Nodes(0.0, np.empty((0, 2, 3)), np.empty((0, 2, 3)))


def two_body_paths(elements: Array) -> Paths:
    """Return the paths of (n, 6) elements, see `state_at`."""
    elements = np.asarray(elements, float).reshape(-1, 6)
    return Paths(elements, np.full(len(elements), -1), NO_NODES)


def sampled_paths(t_s: Array, r_km: Array) -> Paths:
    """Return the paths through positions at even times, see `node_times`.

    The velocities at the nodes are central differences of fourth order: within 1e-8 km/s of the
    derivative for a low orbit.

    Parameters
    ----------
    t_s : (m,) float
        Times `NODE_STEP_S` apart, 6 or more. The paths begin at the third.
    r_km : (n, m, 3) float
        GCRF.
    """
    n = len(r_km)
    before, after = r_km[:, 1:-3] - r_km[:, 3:-1], r_km[:, :-4] - r_km[:, 4:]
    v_km_s = (after - 8 * before) / (12 * NODE_STEP_S)
    nodes = Nodes(float(t_s[END_NODES]), r_km[:, END_NODES:-END_NODES], v_km_s)
    return Paths(np.full((n, 6), np.nan), np.arange(n), nodes)


def resting_path(r_km: Array) -> Paths:
    """Return the path of a body that stays at a GCRF position (3,)."""
    r_km = np.tile(r_km, (1, 2, 1))
    return Paths(np.full((1, 6), np.nan), np.zeros(1, int), Nodes(0.0, r_km, np.zeros_like(r_km)))


def joined_paths(parts: list[Paths]) -> Paths:
    """Return all paths of the parts as one; the sampled ones have the same times."""
    sampled = [part for part in parts if part.is_sampled.any()]
    if not sampled:
        return two_body_paths(np.concatenate([np.empty((0, 6)), *[p.elements for p in parts]]))
    rows, n = [], 0
    for part in parts:
        rows.append(np.where(part.is_sampled, part.row + n, -1))
        n += len(part.nodes.r_km)
    nodes = Nodes(
        sampled[0].nodes.first_s,
        np.concatenate([part.nodes.r_km for part in sampled]),
        np.concatenate([part.nodes.v_km_s for part in sampled]),
    )
    return Paths(np.concatenate([part.elements for part in parts]), np.concatenate(rows), nodes)


def node_times(start_s: float, end_s: float) -> Array:
    """Return even times that cover a part of the scene, with `END_NODES` more at each end [s]."""
    first = np.floor(start_s / NODE_STEP_S) - END_NODES
    last = np.ceil(end_s / NODE_STEP_S) + END_NODES
    return np.arange(first, max(last, first + 2 * END_NODES + 1) + 1) * NODE_STEP_S


def interpolated(nodes: Nodes, row: Indices | int, t_s: Array) -> tuple[Array, Array]:
    """Return positions and velocities by cubics through the nodes before and after each time.

    The velocity is the derivative of the position.
    """
    h = NODE_STEP_S
    t = (np.asarray(t_s, float) - nodes.first_s) / h
    i = np.clip(np.floor(t).astype(np.int64), 0, nodes.r_km.shape[1] - 2)
    u = (t - i)[..., None]
    p0, p1 = nodes.r_km[row, i], nodes.r_km[row, i + 1]
    m0, m1 = nodes.v_km_s[row, i] * h, nodes.v_km_s[row, i + 1] * h
    a, b = 2 * (p0 - p1) + m0 + m1, 3 * (p1 - p0) - 2 * m0 - m1
    return p0 + u * (m0 + u * (b + u * a)), (m0 + u * (2 * b + u * 3 * a)) / h
