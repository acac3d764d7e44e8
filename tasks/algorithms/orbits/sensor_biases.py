"""Biases of sensors: errors that all directions of one share, as the orbits of a night show them.

Each orbit is fitted with the errors of its sensors as unknowns. One object tells little of them,
all objects of a night together tell more.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from epipole.schemas.arrays import Array, Indices
from epipole.tasks.algorithms.orbits.shared_errors import ArcEquations, without_state

Entries = tuple[Indices, Indices, Array]  # of a sparse matrix: rows, columns, values

N_SHARED = 6  # unknowns of a sensor: direction [rad], then position [km]
MAX_TOGETHER = 1000  # sensors that common objects connect: their matrix has 300 MB


class SensorEquations(NamedTuple):
    """Normal equations of the errors of s sensors, from some objects, without priors.

    matrix : (6 s, 6 s) sparse
    right : (s, 6) float
    """

    matrix: csr_array
    right: Array


def sensor_equations(
    orbits: Sequence[tuple[Indices, ArcEquations]], n_sensors: int
) -> SensorEquations:
    """Return the equations of the sensors' errors, from which the orbits are eliminated.

    Parameters
    ----------
    orbits
        The sensors of each object, and the equations of its fit.
    """
    right = np.zeros((n_sensors, N_SHARED))
    entries: list[Entries] = []
    for sensors, equations in orbits:
        normal, of_sensors = without_state(equations)
        at = _unknowns(sensors)
        entries.append((np.repeat(at, len(at)), np.tile(at, len(at)), normal.ravel()))
        np.add.at(right, sensors, of_sensors.reshape(-1, N_SHARED))
    return SensorEquations(_summed(entries, n_sensors), right)


def added(parts: Sequence[tuple[Indices, SensorEquations]], n_sensors: int) -> SensorEquations:
    """Return the sum of equations; each part comes with the numbers of its sensors."""
    right = np.zeros((n_sensors, N_SHARED))
    entries: list[Entries] = []
    for sensors, equations in parts:
        at, of_part = _unknowns(sensors), equations.matrix.tocoo()
        entries.append((at[of_part.coords[0]], at[of_part.coords[1]], of_part.data))
        np.add.at(right, sensors, equations.right)
    return SensorEquations(_summed(entries, n_sensors), right)


def _unknowns(sensors: Indices) -> Indices:
    """Return the rows of the unknowns of sensors."""
    return (N_SHARED * sensors[:, None] + np.arange(N_SHARED)).ravel()


def _summed(entries: Sequence[Entries], n_sensors: int) -> csr_array:
    """Return the sparse matrix of all sensors; entries of one row and column are added."""
    n = N_SHARED * n_sensors
    empty = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
    rows, columns, values = (np.concatenate(of) for of in zip(empty, *entries, strict=True))
    if len(values) > n * n:  # to sort them takes longer than a dense matrix
        return csr_array(np.bincount(n * rows + columns, values, n * n).reshape(n, n))
    return csr_array(coo_array((values, (rows, columns)), (n, n)))


def solve_biases(equations: SensorEquations, prior: Array) -> tuple[Array, Array]:
    """Return the errors of s sensors and their covariances.

    Parameters
    ----------
    prior : (s, 6) float
        1-sigma errors as stated [rad and km].

    Returns
    -------
    bias : (s, 6) float
        Direction [rad], position [km]; NaN for sensors of which more than `MAX_TOGETHER` are
        connected by common objects.
    cov : (s, 6, 6) float
    """
    n = len(prior)
    bias, cov = np.full((n, N_SHARED), np.nan), np.full((n, N_SHARED, N_SHARED), np.nan)
    _, component = connected_components(equations.matrix, directed=False)
    # A sensor that tells nothing of an axis has several components: they are put together.
    of_sensor = component.reshape(n, N_SHARED)
    links = coo_array((np.ones(of_sensor.size), (np.repeat(np.arange(n), N_SHARED),
                                                 of_sensor.ravel() + n)),
                      (n + of_sensor.size,) * 2)  # fmt: skip
    group = connected_components(links, directed=False)[1][:n]
    for each in np.unique(group):
        sensors = np.flatnonzero(group == each)
        if len(sensors) > MAX_TOGETHER:
            continue
        at = _unknowns(sensors)
        unit = prior[sensors].ravel()
        matrix = equations.matrix[at][:, at].toarray() * unit[:, None] * unit
        inverse = np.linalg.inv(matrix + np.eye(len(at))) * unit[:, None] * unit
        bias[sensors] = (inverse @ equations.right[sensors].ravel()).reshape(-1, N_SHARED)
        blocks = inverse.reshape(len(sensors), N_SHARED, len(sensors), N_SHARED)
        of_each = np.arange(len(sensors))
        cov[sensors] = blocks[of_each, :, of_each]
    return bias, cov
