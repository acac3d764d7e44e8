"""Paths of bodies: two-body orbits, and positions sampled at even times with cubics between."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.simulation.orbits import state_at

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

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
    def is_sampled(self) -> npt.NDArray[np.bool_]:
        """Return which bodies have no elements."""
        return self.row >= 0


NO_NODES = Nodes(0.0, np.empty((0, 2, 3)), np.empty((0, 2, 3)))


def two_body_paths(elements: Array) -> Paths:
    """Return the paths of (n, 6) elements, see `state_at`."""
    elements = np.asarray(elements, float).reshape(-1, 6)
    return Paths(elements, np.full(len(elements), -1), NO_NODES)


def sampled_paths(t_s: Array, r_km: Array) -> Paths:
    """Return the paths through places at even times, see `node_times`.

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
    """Return the path of a body that stays at a GCRF place (3,)."""
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
