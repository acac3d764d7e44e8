"""Trajectories: orbits integrated under all forces, with their derivatives by the unknowns.

Dormand and Prince's method of order 8 with a fixed step, and polynomials between the steps. The
unknowns are the state at the epoch and two areas over mass.
"""

from typing import NamedTuple

import numpy as np
from scipy.integrate import DOP853

from epipole.schemas.arrays import Array
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM, GM_KM3_S2
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.orbits.forces import (
    N_UNKNOWNS,
    Surroundings,
    accelerate,
    gravity_gradient,
)

N_VALUES = 6 + 6 * N_UNKNOWNS  # a state, and its derivatives row by row
# Steps of this share of the time in which a circular orbit at the perigee turns by one radian:
# error below 1 m after a day of a low orbit.
STEP_SHARE = 0.1
MAX_STEPS = 200_000

_A = np.ascontiguousarray(DOP853.A)
_B = np.ascontiguousarray(DOP853.B)
_C = np.ascontiguousarray(DOP853.C)
_STAGES = len(_B)


class Trajectory(NamedTuple):
    """An orbit at nodes that are `step_s` apart; the first is at `start_s`.

    values, rates : (n, 54) float
        State [km, km/s] and its derivatives by the unknowns (6, 8), row by row; and the time
        derivatives of these. In the axes of the night.
    """

    start_s: float
    step_s: float
    values: Array
    rates: Array


@kernel
def _rates(t_s, y, areas, around, work, gradient, out):
    """Write the time derivatives of a state and its derivatives, `y` (54,), to `out` (54,).

    `areas`, `around` and `work` as in `accelerate`; `gradient` (3, 3) is scratch.
    """
    accelerate(t_s, y[:3], y[3:6], areas, around, work, out[3:6])
    gravity_gradient(y[:3], gradient)
    out[:3] = y[3:6]
    for a in range(3):
        for k in range(N_UNKNOWNS):
            out[6 + N_UNKNOWNS * a + k] = y[6 + N_UNKNOWNS * (3 + a) + k]
            total = work[k - 6, a] if k >= 6 else 0.0
            for b in range(3):
                total += gradient[a, b] * y[6 + N_UNKNOWNS * b + k]
            out[6 + N_UNKNOWNS * (3 + a) + k] = total


@kernel
def _integrate(values, rates, epoch, start_s, step_s, areas, around):
    """Fill the nodes of a trajectory from that of the epoch on, in both directions.

    `values` and `rates` (n, 54) as in `Trajectory`; ``values[epoch]``, at the node of the epoch, is
    given. `areas` (2,) [m^2/kg] and `around` as in `accelerate`.
    """
    work, gradient = np.zeros((4, 3)), np.empty((3, 3))
    stage, y = np.empty((_STAGES, N_VALUES)), np.empty(N_VALUES)
    n = len(values)
    t0 = start_s + epoch * step_s
    _rates(t0, values[epoch], areas, around, work, gradient, rates[epoch])
    for direction in (-1, 1):
        h = direction * step_s
        node = epoch
        while 0 <= node + direction < n:
            t, y0 = start_s + node * step_s, values[node]
            stage[0] = rates[node]
            for s in range(1, _STAGES):
                y[:] = y0
                for q in range(s):
                    if _A[s, q] != 0.0:
                        for k in range(N_VALUES):
                            y[k] += h * _A[s, q] * stage[q, k]
                _rates(t + _C[s] * h, y, areas, around, work, gradient, stage[s])
            node += direction
            out = values[node]
            out[:] = y0
            for q in range(_STAGES):
                if _B[q] != 0.0:
                    for k in range(N_VALUES):
                        out[k] += h * _B[q] * stage[q, k]
            _rates(start_s + node * step_s, out, areas, around, work, gradient, rates[node])


def integrate(
    unknowns: Array, epoch_s: float, first_s: float, last_s: float, around: Surroundings
) -> Trajectory:
    """Return the trajectory of an orbit from a first to a last time.

    Parameters
    ----------
    unknowns : (8,) float
        State [km, km/s] at the epoch, in the axes of the night, and areas over mass [m^2/kg].
    epoch_s, first_s, last_s : float
        Times since the origin of `around`. The trajectory holds the epoch too.

    Raises
    ------
    ValueError
        If the times are too far apart for the orbit.

    References
    ----------
    Hairer, Norsett, Wanner (1993), Solving Ordinary Differential Equations I, section II.5;
    coefficients as in SciPy's DOP853.
    """
    step_s = _step(unknowns[:6])
    before = _count(max(epoch_s - first_s, 0.0) / step_s)
    after = max(_count(max(last_s - epoch_s, 0.0) / step_s), 1)
    start_s = epoch_s - before * step_s
    return Trajectory(
        start_s, step_s, *_from_node(unknowns, before, before + after, start_s, step_s, around)
    )


def _count(steps: float) -> int:
    if not steps <= MAX_STEPS:
        raise ValueError(f"an orbit of {steps:g} steps; at most {MAX_STEPS:,} are allowed")
    return int(np.ceil(steps))


def _from_node(
    unknowns: Array, epoch: int, last: int, start_s: float, step_s: float, around: Surroundings
) -> tuple[Array, Array]:
    """Return values and rates at the nodes 0 to `last`, from the unknowns at one of them."""
    values = np.zeros((last + 1, N_VALUES))
    rates = np.empty_like(values)
    values[epoch, :6] = unknowns[:6]
    values[epoch, 6:] = np.eye(6, N_UNKNOWNS).ravel()
    areas = np.ascontiguousarray(unknowns[6:])
    _integrate(values, rates, epoch, start_s, step_s, areas, around)
    return values, rates


def _step(state: Array) -> float:
    """Return the step [s] of an orbit: by its perigee, not below the ground."""
    r_km = float(np.linalg.norm(state[:3]))
    lowest_km = min(max(perigee_km(state), EARTH_RADIUS_KM), r_km)
    return float(STEP_SHARE * np.sqrt(lowest_km**3 / GM_KM3_S2))


def perigee_km(state: Array) -> float:
    """Return the distance of the perigee of a two-body orbit from the geocentre [km].

    state : (6,) or more float
        Position and velocity [km, km/s], in any frame that does not turn.
    """
    r_km, v2 = float(np.linalg.norm(state[:3])), float(state[3:6] @ state[3:6])
    momentum2 = float(np.sum(np.cross(state[:3], state[3:6]) ** 2))
    energy = v2 / 2 - GM_KM3_S2 / r_km
    e = np.sqrt(max(1 + 2 * energy * momentum2 / GM_KM3_S2**2, 0.0))
    return float(momentum2 / GM_KM3_S2 / (1 + e))


@kernel
def _quintic(u, h):
    """Return the weights of a quintic between two nodes: of the step, velocities, accelerations.

    u is the share of the step h [s] that has passed. NumPy's arrays do as well, without compiling.
    """
    u2, u3 = u * u, u * u * u
    u4, u5 = u3 * u, u3 * u2
    rise = 10 * u3 - 15 * u4 + 6 * u5
    v0, v1 = h * (u - 6 * u3 + 8 * u4 - 3 * u5), h * (-4 * u3 + 7 * u4 - 3 * u5)
    a0 = 0.5 * h * h * (u2 - 3 * u3 + 3 * u4 - u5)
    return rise, v0, v1, a0, 0.5 * h * h * (u3 - 2 * u4 + u5)


@kernel
def _node_before(t_s, path):
    """Return the node before a time, and the share of the step [0 to 1] that has passed since.

    `t_s` and `path` as in `interpolate_position`.
    """
    k = min(max(int(np.floor((t_s - path.start_s) / path.step_s)), 0), len(path.values) - 2)
    return k, (t_s - path.start_s) / path.step_s - k


@kernel
def interpolate_position(t_s, path, x):
    """Write an orbit's position at a time.

    Parameters
    ----------
    t_s : float
        Time since the origin [s]; outside the nodes the polynomial at the end is continued.
    path
        `Trajectory`.
    x : (3,) float, out
        Position [km]: the quintic with positions, velocities and accelerations at two nodes.
    """
    k, u = _node_before(t_s, path)
    rise, v0, v1, a0, a1 = _quintic(u, path.step_s)
    p, q, dp, dq = path.values[k], path.values[k + 1], path.rates[k], path.rates[k + 1]
    for a in range(3):
        b = 3 + a  # the velocity; its rate is the acceleration
        x[a] = p[a] + (q[a] - p[a]) * rise + v0 * p[b] + v1 * q[b] + a0 * dp[b] + a1 * dq[b]


@kernel
def interpolate_derivatives(t_s, path, jacobian):
    """Write the derivatives of an orbit's position at a time by the unknowns.

    Parameters
    ----------
    t_s, path
        As in `interpolate_position`.
    jacobian : (3, 8) float, out
        By the same quintic. Angles from one satellite hardly show the distance of an object that
        flies along: an error of 1e-5 would hide it.
    """
    k, u = _node_before(t_s, path)
    rise, v0, v1, a0, a1 = _quintic(u, path.step_s)
    p, q, dp, dq = path.values[k], path.values[k + 1], path.rates[k], path.rates[k + 1]
    for a in range(3):
        for m in range(N_UNKNOWNS):
            i, j = 6 + N_UNKNOWNS * a + m, 6 + N_UNKNOWNS * (3 + a) + m
            jacobian[a, m] = (
                p[i] + (q[i] - p[i]) * rise + v0 * p[j] + v1 * q[j] + a0 * dp[j] + a1 * dq[j]
            )


def positions_at(path: Trajectory, time_s: Array) -> Array:
    """Return an orbit's positions (n, 3) [km] at times (n,) [s], as `interpolate_position` does."""
    h, last = path.step_s, len(path.values) - 2
    k = np.clip(np.floor((time_s - path.start_s) / h).astype(np.int64), 0, last)
    u = ((time_s - path.start_s) / h - k)[:, None]
    rise, v0, v1, a0, a1 = _quintic.py_func(u, h)
    # Of the nodes, before any is copied: they have derivatives by the unknowns too.
    r, v, a = path.values[:, :3], path.values[:, 3:6], path.rates[:, 3:6]
    moved = (r[k + 1] - r[k]) * rise + v0 * v[k] + v1 * v[k + 1]
    return np.asarray(r[k] + moved + a0 * a[k] + a1 * a[k + 1])


def propagate_unknowns(
    unknowns: Array, epoch_s: float, to_s: float, around: Surroundings
) -> tuple[Array, Array]:
    """Return the unknowns (8,) at another time, and their derivatives by the given ones, (8, 8)."""
    if to_s == epoch_s:
        return unknowns.copy(), np.eye(N_UNKNOWNS)
    nodes = _count(abs(to_s - epoch_s) / _step(unknowns[:6]))
    epoch = 0 if to_s > epoch_s else nodes
    step_s = abs(to_s - epoch_s) / nodes  # shortened, so that the last node is at that time
    values = _from_node(unknowns, epoch, nodes, min(epoch_s, to_s), step_s, around)[0]
    end = values[nodes - epoch]
    transition = np.eye(N_UNKNOWNS)
    transition[:6] = end[6:].reshape(6, N_UNKNOWNS)
    return np.concatenate([end[:6], unknowns[6:]]), transition
