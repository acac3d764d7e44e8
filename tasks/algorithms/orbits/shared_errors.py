"""Shared errors: are the errors that all views of a sensor share larger than stated?

The error of an ephemeris or a prior attitude is sometimes larger than its stated standard
deviation. A single object has little information on that, all objects of a sensor together have
much. The stated deviation is taken as the scale of a Student distribution: most errors are of this
size, some are much larger. The factor of each sensor's variance follows from its lines of sight.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Flags, Indices

FREEDOM = 4.0  # degrees of freedom of the Student distribution: 1 error in 90 beyond five sigma
AXES = 3
ITERATIONS = 200
CONVERGED = 1e-3  # relative change of the factors
MAX_TOGETHER = 32  # maximum number of sensors that are scaled at a time
SWEEPS = 2  # over all groups of sensors; the second has the factors of the first


class ArcEquations(NamedTuple):
    """Normal equations of one arc: its object's state, and the shared errors of its s sensors.

    Each sensor has six unknowns: the error of its directions [rad] and of its position [km], three
    axes each. The equations are without the prior; the errors are counted from zero. The state has
    m unknowns, six or more.

    state : (m, m) float
    coupling : (s, 6, m) float
        Rows are the unknowns of the sensor, columns those of the state.
    blocks : (s, 6, 6) float
        Diagonal blocks of the sensors: two sensors are coupled by the state only.
    of_state, of_sensors : (m,), (s, 6) float
        Right sides.
    """

    state: Array
    coupling: Array
    blocks: Array
    of_state: Array
    of_sensors: Array


def no_equations(n_sensors: int) -> ArcEquations:
    """Return the equations of an arc without views: zeros."""
    return ArcEquations(
        np.zeros((6, 6)),
        np.zeros((n_sensors, 6, 6)),
        np.zeros((n_sensors, 6, 6)),
        np.zeros(6),
        np.zeros((n_sensors, 6)),
    )


def scale_shared_errors(
    arcs: Sequence[tuple[Indices, ArcEquations]], prior: Array, free: Flags
) -> Array:
    """Return the factors of the stated variances of sensors' shared errors.

    Parameters
    ----------
    arcs
        The sensors of each arc of all objects, and its equations.
    prior : (s, 6, 6) float
        Inverse of the stated covariance of each sensor's errors; direction and position not
        correlated.
    free : (s, 2) bool
        Whether the variances of direction and position may be larger than stated.

    Returns
    -------
    (s, 2) float
        Factors of the variances of direction and position, 1 or larger.

    Notes
    -----
    An error e of k axes with covariance C, from a Student distribution with f degrees of freedom,
    has the variance factor (f + e' C^-1 e) / (f + k). If the stated covariance is right, its mean
    is 1. In expectation maximisation e' C^-1 e is its expected value. So a sensor whose errors are
    not observable keeps the factor 1.

    At most `MAX_TOGETHER` sensors are scaled at a time. The errors of the others count as
    independent from arc to arc: with that many sensors each has little weight.

    References
    ----------
    Lange, Little, Taylor (1989), Robust statistical modeling using the t distribution, JASA 84.
    """
    n_sensors = len(prior)
    factor = np.ones((n_sensors, 2))
    groups = np.array_split(np.arange(n_sensors), max(-(-n_sensors // MAX_TOGETHER), 1))
    for _ in range(1 if len(groups) == 1 else SWEEPS):
        absorbed = [_absorbed(sensors, of_arc, prior, factor) for sensors, of_arc in arcs]
        for group in groups:
            equations = _of_group(group, arcs, absorbed, n_sensors)
            factor[group] = _scaled(*equations, prior[group], free[group])
    return factor


def _absorbed(
    sensors: Indices, arc: ArcEquations, prior: Array, factor: Array
) -> tuple[Array, Array]:
    """Return what eliminating each sensor's errors subtracts from the equations of the state.

    (s, 6, 6), and right sides (s, 6).
    """
    weight = 1.0 / np.repeat(np.sqrt(factor[sensors]), AXES, axis=1)
    blocks = arc.blocks + prior[sensors] * weight[:, :, None] * weight[:, None, :]
    unit = 1.0 / np.sqrt(np.diagonal(blocks, axis1=1, axis2=2))
    both = np.concatenate([arc.coupling, arc.of_sensors[:, :, None]], axis=2)
    scaled = blocks * unit[:, :, None] * unit[:, None, :]
    solved = unit[:, :, None] * np.linalg.solve(scaled, unit[:, :, None] * both)
    absorbed = np.swapaxes(arc.coupling, 1, 2) @ solved
    return absorbed[:, :, :6], absorbed[:, :, 6]


def _of_group(
    group: Indices,
    arcs: Sequence[tuple[Indices, ArcEquations]],
    absorbed: Sequence[tuple[Array, Array]],
    n_sensors: int,
) -> tuple[Array, Array]:
    """Return the equations of some sensors' errors, (6 g, 6 g) and (6 g,), from all arcs.

    The states, and with them the errors of all other sensors, are eliminated.
    """
    index = np.full(n_sensors, -1)
    index[group] = np.arange(len(group))
    normal, right = np.zeros((6 * len(group),) * 2), np.zeros(6 * len(group))
    for (sensors, arc), (less, less_right) in zip(arcs, absorbed, strict=True):
        inside = index[sensors] >= 0
        if not inside.any():
            continue
        reduced, of_sensors = without_state(
            ArcEquations(
                arc.state - less[~inside].sum(axis=0),
                arc.coupling[inside],
                arc.blocks[inside],
                arc.of_state - less_right[~inside].sum(axis=0),
                arc.of_sensors[inside],
            )
        )
        at = (6 * index[sensors[inside]][:, None] + np.arange(6)).ravel()
        normal[np.ix_(at, at)] += reduced
        right[at] += of_sensors
    return normal, right


def without_state(arc: ArcEquations) -> tuple[Array, Array]:
    """Return the equations of the errors of an arc's s sensors, (6 s, 6 s) and (6 s,).

    The state is eliminated.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(arc.state), 1e-300))
    inverse = np.linalg.pinv(arc.state * scale[:, None] * scale, hermitian=True)
    inverse *= scale[:, None] * scale
    to_state = arc.coupling.reshape(-1, len(arc.state))
    reduced = -to_state @ inverse @ to_state.T
    for k, block in enumerate(arc.blocks):
        reduced[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += block
    return reduced, arc.of_sensors.ravel() - to_state @ (inverse @ arc.of_state)


def _scaled(normal: Array, right: Array, prior: Array, free: Flags) -> Array:
    """Return the variance factors (s, 2) of sensors from the equations of their errors."""
    n_sensors = len(prior)
    factor = np.ones((n_sensors, 2))
    unit = _units(prior)
    normal = normal * unit[:, None] * unit
    right = right * unit
    block = np.arange(2 * n_sensors).repeat(AXES)
    stated = np.zeros_like(normal)
    for s in range(n_sensors):
        of_sensor = slice(6 * s, 6 * s + 6)
        stated[of_sensor, of_sensor] = prior[s] * unit[of_sensor, None] * unit[of_sensor]
    for _ in range(ITERATIONS):
        weight = 1.0 / factor.ravel()[block]
        # All axes of a block have one weight, and blocks are not correlated.
        cov = np.linalg.inv(normal + stated * np.sqrt(weight[:, None] * weight))
        error = cov @ right
        square = np.sum(stated * (np.outer(error, error) + cov), axis=1)
        expected = np.bincount(block, square, minlength=2 * n_sensors)
        new = np.maximum((FREEDOM + expected) / (FREEDOM + AXES), 1.0).reshape(n_sensors, 2)
        new[~free] = 1.0
        done = (np.abs(new - factor) < CONVERGED * factor).all()
        factor = new
        if done:
            break
    return factor


def _units(prior: Array) -> Array:
    """Return the stated standard deviation of each unknown, (6 s,) [rad, km]."""
    return np.asarray(1.0 / np.sqrt(np.diagonal(prior, axis1=1, axis2=2)).ravel())
