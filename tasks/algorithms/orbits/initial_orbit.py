"""Initial orbit: a state from directions alone, without anything known of the distances.

Over some minutes the path is nearly a parabola, and then the directions of several satellites are
linear equations of its position and velocity. Where these do not decide, as with one satellite:
two directions leave two unknowns, the distance and how fast it changes. All pairs of these are
tried; each gives an orbit, which is compared with the directions between.

Directions of one satellite over less than a minute or two fit many orbits, among them any that
are near the satellite's: at a small distance nothing moves. They are the worst: the nearer, the
smaller all errors. So orbits are compared by evidence, which counts how many objects there may be
about each of them.
"""

from collections.abc import Callable

import numpy as np

from epipole.schemas.arrays import Array, Indices
from epipole.tasks.algorithms.constants import GM_KM3_S2
from epipole.tasks.algorithms.earth_gravity import LOWEST_ORBIT_KM, gravity, propagate_states
from epipole.tasks.algorithms.orbits.forces import Surroundings
from epipole.tasks.algorithms.orbits.orbit_determination import (
    AreaPrior,
    DeterminedOrbit,
    ObjectDirections,
    determine_orbit,
    velocity_prior,
)

# Returns the log of the density of objects about states (n, 6), up to a constant: (n,).
LogDensity = Callable[[Array], Array]

# Longest time between the two directions. With the longer one more pairs of distances lead to no
# orbit; but two passages of seconds, a quarter of an hour apart, show little each.
LONGEST_S, LONGER_S = 600.0, 1500.0
DISTANCES_KM = np.geomspace(50.0, 60_000.0, 48)  # 16 % apart, which the fit converges from
RATES_KM_S = np.linspace(-15.0, 15.0, 41)  # of the distance: two low satellites that meet
COMPARED, FITTED = 16, 100  # directions of these minutes, at most
REFINED = 6  # of the best orbits, which are fitted
STEP_S = 60.0  # longest step of the propagation: right to some metres in ten minutes
BETTER = 0.01  # in log evidence: with less, two fits found the same orbit
ROUNDS = 6  # of the linear equations, each with the gravity of the path before
SHOTS = 3  # of the velocity; each leaves a hundredth of the miss
GRAVITY_ALONE = AreaPrior(np.zeros(2), np.zeros(2))


def initial_orbit(
    directions: ObjectDirections,
    around: Surroundings,
    log_density: LogDensity,
    longest_s: float = LONGEST_S,
) -> tuple[Array, float] | None:
    """Return a state (6,) [km, km/s] and its time [s] by some minutes of the directions.

    At most `longest_s` of them. None if no bound orbit fits. Axes and times are those of the
    directions.

    References
    ----------
    Gooding (1997), A new procedure for the solution of the classical problem of minimal orbit
    determination from three lines of sight, CMDA 66:387, improves two distances from a guess. Here
    they are searched over a grid, so that no orbit is missed.
    """
    first, last = _widest_pair(directions, longest_s)
    if first == last:
        return None
    part = _rows(directions, np.unique(np.linspace(first, last, FITTED).round().astype(np.int64)))
    tried = [_along_parabola(part), *_likeliest(directions, first, last, log_density)]
    at_s = float(directions.time_s[first])
    best: tuple[float, Array] | None = None
    for state in tried:
        orbit = determine_orbit(part, state, at_s, at_s, GRAVITY_ALONE, around)
        above = float(np.linalg.norm(orbit.unknowns[:3])) > LOWEST_ORBIT_KM  # false of NaN
        if not above:
            continue
        evidence = _log_evidence(orbit, log_density)
        if best is None or evidence > best[0] + BETTER:
            best = evidence, orbit.unknowns[:6]
    return None if best is None else (best[1], at_s)


def _log_evidence(orbit: DeterminedOrbit, log_density: LogDensity) -> float:
    """Return the log of how probable the directions are for objects about an orbit (Laplace)."""
    state, cov = orbit.unknowns[:6], orbit.cov[:6, :6]
    pulls, _ = velocity_prior(state)
    of_directions = orbit.chi2 - float(pulls @ pulls)
    # Scaled: the unknowns are km and km/s.
    sigma = np.sqrt(np.diag(cov))
    _, log_det = np.linalg.slogdet(cov / sigma[:, None] / sigma)
    volume = float(np.sum(np.log(sigma))) + log_det / 2
    return float(log_density(state[None])[0]) + volume - of_directions / 2


def _likeliest(
    directions: ObjectDirections, first: int, last: int, log_density: LogDensity
) -> Array:
    """Return states (k, 6) at the first of two directions: the likeliest distances of the grid,
    each with its likeliest rate."""
    time_s, _, r_km, u, *_ = directions
    chosen = np.unique(np.linspace(first, last, COMPARED).round().astype(np.int64))
    span_s = float(time_s[last] - time_s[first])
    rho, rate = (a.ravel()[:, None] for a in np.meshgrid(DISTANCES_KM, RATES_KM_S, indexing="ij"))
    then = np.maximum(rho + rate * span_s, DISTANCES_KM[0])
    states = _orbits_through(r_km[first] + rho * u[first], r_km[last] + then * u[last], span_s)
    # The directions between those that are compared tell as much.
    chi2 = _chi2(states, directions, chosen) * (last - first + 1) / len(chosen)
    # The errors of both directions fill a volume that grows with the squares of both distances; the
    # steps of the grid are even in the log of the first.
    volume = 3.0 * np.log(rho[:, 0]) + 2.0 * np.log(then[:, 0])
    with np.errstate(all="ignore"):
        score = log_density(states) + volume - chi2 / 2
    score = np.where(np.isfinite(score), score, -np.inf).reshape(len(DISTANCES_KM), -1)
    order = np.argsort(-score.max(axis=1), kind="stable")[:REFINED]
    order = order[np.isfinite(score.max(axis=1)[order])]
    rates = np.argmax(score[order], axis=1)
    return np.asarray(states.reshape(*score.shape, 6)[order, rates])


def _along_parabola(part: ObjectDirections) -> Array:
    """Return the state (6,) at the first direction whose path misses the lines of sight least.

    The misses are weighed by the distances of the round before.
    """
    tau = part.time_s - part.time_s[0]
    fall, weight = np.zeros((len(tau), 3)), np.ones(len(tau))
    state = np.zeros(6)
    for _ in range(ROUNDS):
        rows = np.concatenate([part.basis, part.basis * tau[:, None, None]], axis=2)
        right = np.einsum("npa,na->np", part.basis, part.r_km - fall)
        scale = np.array([1.0, 1.0, 1.0, *(1.0 / max(tau[-1], 1.0) * np.ones(3))])
        equations = (rows * weight[:, None, None] * scale).reshape(-1, 6)
        state = scale * np.linalg.lstsq(equations, (right * weight[:, None]).ravel())[0]
        path = state[:3] + tau[:, None] * state[3:] + fall
        weight = 1.0 / np.maximum(np.linalg.norm(path - part.r_km, axis=1), 1.0)
        pull = gravity(path)
        # Twice the integral of the pull, as if it changed evenly from the first instant on.
        fall = tau[:, None] ** 2 * (2.0 * pull[:1] + pull) / 6.0
    return state


def _widest_pair(directions: ObjectDirections, longest_s: float) -> tuple[int, int]:
    """Return the first and last direction of the stretch, at most `longest_s`, that most sensors
    saw, and of these the longest."""
    time_s, sensor = directions.time_s, directions.sensor
    ends = np.searchsorted(time_s, time_s + longest_s, side="right") - 1
    begins = np.flatnonzero(np.diff(ends, prepend=-1) > 0)
    best = max(
        begins.tolist(),
        key=lambda k: (len(np.unique(sensor[k : ends[k] + 1])), time_s[ends[k]] - time_s[k]),
    )
    return best, int(ends[best])


def _rows(directions: ObjectDirections, rows: Indices) -> ObjectDirections:
    time_s, sensor, r_km, u, basis, weight, prior = directions
    present, sensor = np.unique(sensor[rows], return_inverse=True)
    return ObjectDirections(
        time_s[rows], sensor.astype(np.int64), r_km[rows], u[rows], basis[rows], weight[rows],
        prior[present],
    )  # fmt: skip


def _orbits_through(near: Array, far: Array, span_s: float) -> Array:
    """Return states (n, 6) at the first of two positions; NaN where the orbit is not bound."""
    with np.errstate(all="ignore"):
        v = (far - near) / span_s - gravity((near + far) / 2) * span_s / 2
        speed = np.linalg.norm((far - near) / span_s, axis=1)
        radius = [np.linalg.norm(r, axis=1) for r in (near, far)]
        possible = (np.minimum(*radius) > LOWEST_ORBIT_KM) & (
            speed < np.sqrt(2 * GM_KM3_S2 / np.minimum(*radius))
        )
        states = np.full((len(near), 6), np.nan)
        rows = np.flatnonzero(possible)
        near, far, v = near[rows], far[rows], v[rows]
        for _ in range(SHOTS):
            v = v - (_moved(np.hstack([near, v]), span_s)[:, :3] - far) / span_s
        bound = np.sum(v * v, axis=1) < 2 * GM_KM3_S2 / np.linalg.norm(near, axis=1)
        states[rows] = np.where(bound[:, None], np.hstack([near, v]), np.nan)
    return states


def _moved(states: Array, dt_s: float) -> Array:
    """Return states (n, 6) after a time, under the Earth's gravity."""
    steps = max(int(np.ceil(abs(dt_s) / STEP_S)), 1)
    return np.hstack(propagate_states(states[:, :3], states[:, 3:], np.array([dt_s]), steps))


def _chi2(states: Array, directions: ObjectDirections, chosen: Indices) -> Array:
    """Return chi-square of states and directions, by independent errors; infinite where NaN, or
    where the object is behind the sensor."""
    total = np.full(len(states), np.inf)
    rows = np.flatnonzero(np.isfinite(states[:, 0]))
    y, now = states[rows], directions.time_s[chosen[0]]
    squares = np.zeros(len(rows))
    with np.errstate(all="ignore"):
        for k in chosen:
            y, now = _moved(y, float(directions.time_s[k] - now)), directions.time_s[k]
            line = y[:, :3] - directions.r_km[k]
            line /= np.linalg.norm(line, axis=1, keepdims=True)
            off = line @ directions.basis[k].T
            squares += np.einsum("ni,ij,nj->n", off, directions.weight[k], off)
            squares[~(line @ directions.u[k] > 0.0)] = np.inf
    total[rows] = np.where(np.isfinite(squares), squares, np.inf)
    return total
