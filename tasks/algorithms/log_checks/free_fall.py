"""Free fall: whether the positions of an arc fall freely, and in which axes.

In axes that turn with the rate w, a satellite has the acceleration g - 2 w x v - w x (w x r). What
a path of positions has beyond that is estimated with its error. In inertial axes w is zero, in
Earth-fixed axes it is the Earth's rotation about z; about another axis where axes were exchanged.
So no table of the Earth's orientation is needed. TEME, EME2000 and GCRF differ by constant
rotations, which no arc shows.
"""

from typing import NamedTuple

import numpy as np
from numpy.polynomial.chebyshev import chebder, chebfit, chebint, chebval, chebvander

from epipole.schemas.arrays import Array, Flags, Nanoseconds
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM, GM_KM3_S2, J2, SECOND_NS

MIN_STATES = 5  # of an arc: three are fitted on each axis
# A low orbit turns by a third of a radian in five minutes, which a polynomial follows to a metre.
# States that are far apart have longer arcs, of ten steps.
ARC_S = 300.0
MIN_STEPS = 10
LONGEST_ARC_S = 1200.0
MAX_DEGREE = 8
NODES = 12  # at which forces are evaluated: two more than the double integral's degree
MEDIAN_LENGTH = 1.538  # of three normal numbers of unit variance
OUTLIER = 10.0  # in units of the scatter
# Errors of neighbouring states are correlated: as if an error of the size of the sigma bent the
# whole arc, but at most that of ten times the scatter.
BENT = 10.0


# Values and slopes there of a Chebyshev series are products with its coefficients, and so is the
# series of the integral with the values.
_TAU = np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES)
_AT_NODES = chebvander(_TAU, NODES - 1)
_SLOPE_AT_NODES = np.stack([chebval(_TAU, chebder(unit)) for unit in np.eye(NODES)], axis=1)
_INTEGRAL = np.asarray(chebint(np.linalg.inv(_AT_NODES)))


class Arc(NamedTuple):
    """States of one sensor that follow each other.

    t_s : (n,) float
        Time from the middle [s].
    r, v : (n, 3) float
        Position and velocity, in any unit; NaN where there is no velocity.
    sigma : float
        Stated 1-sigma error of a position per axis; 0 where unknown.
    """

    t_s: Array
    r: Array
    v: Array
    sigma: float


class Fall(NamedTuple):
    """How an arc falls in some axes.

    excess_km_s2, sigma_km_s2 : float
        Length of the acceleration that gravity and the axes do not explain, and its error.
    gravity_km_s2 : float
        Gravity in the middle.
    v_km_s : (n, 3) float
        Velocity along the path, in these axes; `v_sigma_km_s` is its error.
    """

    excess_km_s2: float
    sigma_km_s2: float
    gravity_km_s2: float
    v_km_s: Array
    v_sigma_km_s: float


def arcs_of(time_ns: Nanoseconds, r: Array, v: Array, sigma: Array, most: int = 4) -> list[Arc]:
    """Return some arcs, evenly spread over the states, which are sorted by time."""
    if len(time_ns) < MIN_STATES:
        return []
    step_s = float(np.median(np.diff(time_ns))) / SECOND_NS
    longest_s = min(max(ARC_S, MIN_STEPS * step_s), LONGEST_ARC_S)
    # A gap ends an arc.
    starts = [0]
    since = np.concatenate([[0.0], np.diff(time_ns) / SECOND_NS])
    begin = time_ns[0]
    for k in range(1, len(time_ns)):
        if since[k] > longest_s / 4 or (time_ns[k] - begin) / SECOND_NS > longest_s:
            starts.append(k)
            begin = time_ns[k]
    ends = [*starts[1:], len(time_ns)]
    full = [(a, b) for a, b in zip(starts, ends, strict=True) if b - a >= MIN_STATES]
    chosen = np.unique(np.linspace(0, len(full) - 1, min(most, len(full))).round().astype(int))
    return [_arc(time_ns, r, v, sigma, *full[k]) for k in chosen.tolist()]


def _arc(time_ns: Nanoseconds, r: Array, v: Array, sigma: Array, first: int, end: int) -> Arc:
    middle = (time_ns[first] + time_ns[end - 1]) // 2
    rows = slice(first, end)
    return Arc(
        (time_ns[rows] - middle) / SECOND_NS, r[rows], v[rows], float(np.median(sigma[rows]))
    )


def degree_of(n: int) -> int:
    """Return the degree of the polynomial that follows n positions."""
    return min(MAX_DEGREE, max(n - 3, 2))


def polynomial_residuals(arc: Arc) -> tuple[Array, float]:
    """Return the residuals of the positions from a polynomial (n, 3), and their scatter.

    The scatter is a 1-sigma error per axis, by quantiles: outliers do not count.
    """
    n, degree = len(arc.t_s), degree_of(len(arc.t_s))
    used = np.ones(n, bool)
    residual, scatter = arc.r, 0.0
    for _ in range(3):
        _, fitted = _polynomial(arc.t_s, arc.r, degree, used)
        residual = arc.r - fitted
        dof = max(used.sum() - degree - 1, 1) / used.sum()
        off = np.linalg.norm(residual, axis=1)
        scatter = float(np.median(off[used])) / MEDIAN_LENGTH / np.sqrt(dof)
        kept = off <= OUTLIER * max(scatter, 1e-9)
        if (kept == used).all() or kept.sum() < degree + 2:
            break
        used = kept
    return residual, scatter


class ReadArc(NamedTuple):
    """An arc as a reading has it, in kilometres, and what gravity and the axes do along it.

    tau : (n,) float
        Time, -1 to 1 from the first to the last state, and half the time between them [s].
    once, twice : (n, 3) float
        Their acceleration, integrated once and twice over time [km/s, km].
    """

    tau: Array
    half_s: float
    r_km: Array
    v_km_s: Array
    sigma_km: float
    gravity_km_s2: float
    once: Array
    twice: Array


def read_arc(arc: Arc, scale: float, rate_rad_s: Array) -> ReadArc:
    """Return an arc whose positions times `scale` are kilometres, in axes that turn.

    Parameters
    ----------
    rate_rad_s : (3,) float
        Rotation of the axes.
    """
    r = arc.r * scale
    half_s = max(float(arc.t_s[-1] - arc.t_s[0]) / 2, 1e-6)
    tau = arc.t_s / half_s
    path, _ = _polynomial(tau, r, degree_of(len(tau)), np.ones(len(tau), bool))
    once, twice = _integrals(path, half_s, rate_rad_s)
    gravity = float(np.linalg.norm(gravity_of(_values(path, np.zeros(1)))))
    return ReadArc(
        tau, half_s, r, arc.v, arc.sigma * scale, gravity, _values(once, tau), _values(twice, tau)
    )  # fmt: skip


def fall(read: ReadArc) -> Fall:
    """Return how an arc falls by its positions."""
    # What remains of free fall is a straight line; its curve is the excess.
    tau, half_s, y = read.tau, read.half_s, read.r_km - read.twice
    design = np.stack([np.ones_like(tau), tau, tau**2 / 2], axis=1)
    solution, *_ = np.linalg.lstsq(design, y, rcond=None)
    scatter = float(np.sqrt(((y - design @ solution) ** 2).sum() / (3 * max(len(tau) - 3, 1))))
    cov = np.linalg.inv(design.T @ design)
    bent = min(read.sigma_km, BENT * scatter)
    excess = solution[2] / half_s**2
    sigma = np.hypot(scatter * np.sqrt(cov[2, 2]), 2 * bent) / half_s**2
    v = read.once + (solution[1] + solution[2] * tau[:, None]) / half_s
    return Fall(
        float(np.linalg.norm(excess)),
        float(sigma),
        read.gravity_km_s2,
        v,
        float(np.hypot(scatter * np.sqrt(cov[1, 1] + cov[2, 2] / 3), bent) / half_s),
    )


def fall_of_velocities(read: ReadArc) -> tuple[float, float]:
    """Return the excess acceleration and its error [km/s^2], by the velocities [km/s].

    NaN and infinity where fewer than `MIN_STATES` have one.
    """
    known = np.isfinite(read.v_km_s[:, 0])
    if known.sum() < MIN_STATES:
        return np.nan, np.inf
    y = (read.v_km_s - read.once)[known]
    design = np.stack([np.ones_like(read.tau), read.tau], axis=1)[known]
    solution, *_ = np.linalg.lstsq(design, y, rcond=None)
    scatter = np.sqrt(((y - design @ solution) ** 2).sum() / (3 * max(len(y) - 2, 1)))
    cov = np.linalg.inv(design.T @ design)
    sigma = scatter * np.hypot(np.sqrt(cov[1, 1]), 1.0) / read.half_s
    return float(np.linalg.norm(solution[1]) / read.half_s), float(sigma)


def gravity_of(r_km: Array) -> Array:
    """Return gravity [km/s^2] at (n, 3) positions, at any height."""
    radius2 = np.maximum((r_km**2).sum(axis=1, keepdims=True), 1.0)
    flattening = 1.5 * J2 * EARTH_RADIUS_KM**2 / radius2
    z2 = 5 * r_km[:, 2:] ** 2 / radius2
    factor = 1 + flattening * (np.array([1.0, 1.0, 3.0]) - z2)
    return -GM_KM3_S2 / radius2**1.5 * factor * r_km


def _integrals(path: Array, half_s: float, rate_rad_s: Array) -> tuple[Array, Array]:
    """Return the acceleration along a path, integrated once and twice over time."""
    r = _AT_NODES[:, : len(path)] @ path
    v = _SLOPE_AT_NODES[:, : len(path)] @ path / half_s
    turned = np.cross(rate_rad_s, np.eye(3))  # the cross product w x r is r @ turned
    acceleration = gravity_of(r) - 2 * v @ turned - r @ turned @ turned
    once = _INTEGRAL @ acceleration * half_s
    twice = np.asarray(chebint(once) * half_s, np.float64)
    return once, twice


def _polynomial(tau: Array, r: Array, degree: int, used: Flags) -> tuple[Array, Array]:
    """Return the Chebyshev coefficients of the best polynomial, and its values at all times."""
    width = max(float(np.abs(tau).max()), 1e-9)
    fitted = chebfit(tau[used] / width, r[used], degree)
    path = np.asarray(fitted, np.float64)
    return path, _values(path, tau / width)


def _values(coefficients: Array, tau: Array) -> Array:
    return np.asarray(chebval(tau, coefficients).T)
