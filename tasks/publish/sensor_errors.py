"""Sensor errors: what all orbits of a night tell of the errors that a sensor's directions share."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from epipole.schemas.arrays import Array, Indices
from epipole.schemas.bridge import table, unstack, unstack_covariance
from epipole.schemas.columns import SHARED_AXES
from epipole.schemas.tables import SENSOR_ERRORS
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.orbits.reference_frames import state_rotation
from epipole.tasks.algorithms.orbits.sensor_biases import (
    SensorEquations,
    added,
    sensor_equations,
    solve_biases,
)
from epipole.tasks.algorithms.orbits.shared_errors import ArcEquations

UNITS = np.array([ARCSEC] * 3 + [1.0] * 3)  # of the direction and the position


class SensorSums(NamedTuple):
    """What the orbits of some objects tell of s sensors.

    `variances` (s, 2) are sums of the stated ones of direction [rad^2] and position [km^2] over
    `n_observations` (s,).
    """

    names: list[str]
    equations: SensorEquations
    variances: Array
    n_observations: Indices
    n_objects: Indices


def summed_equations(
    names: list[str],
    orbits: Sequence[tuple[Indices, ArcEquations]],
    sensor: Indices,
    variance: Array,
) -> SensorSums:
    """Return the sums of some orbits.

    Parameters
    ----------
    names
        Of all sensors.
    orbits
        The sensors of each orbit, and its equations.
    sensor, variance : (n,) int, (n, 2) float
        Sensor and stated variances of each observation of these orbits.
    """
    n = len(names)
    of_orbits = np.concatenate([np.zeros(0, np.int64), *(sensors for sensors, _ in orbits)])
    return SensorSums(
        names,
        sensor_equations(orbits, n),
        np.column_stack([np.bincount(sensor, of, minlength=n) for of in variance.T]),
        np.bincount(sensor, minlength=n),
        np.bincount(of_orbits, minlength=n),
    )


def sensor_errors(sums: Sequence[SensorSums], R_night_from_gcrf: Array) -> pa.Table:
    """Return SENSOR_ERRORS, in the order of the sensors' ids."""
    names = sorted({name for each in sums for name in each.names})
    number = {name: k for k, name in enumerate(names)}
    at = [np.array([number[name] for name in each.names], np.int64) for each in sums]
    variance, counts = np.zeros((len(names), 2)), np.zeros((len(names), 2), np.int64)
    for rows, each in zip(at, sums, strict=True):
        variance[rows] += each.variances
        counts[rows] += np.column_stack([each.n_observations, each.n_objects])
    prior = np.sqrt(variance / np.maximum(counts[:, :1], 1))
    parts = [(rows, each.equations) for rows, each in zip(at, sums, strict=True)]
    bias, cov = solve_biases(added(parts, len(names)), np.repeat(prior, 3, axis=1))
    used = np.flatnonzero((counts[:, 0] > 0) & np.isfinite(bias).all(axis=1))
    turn = state_rotation(R_night_from_gcrf.T) / UNITS[:, None]
    bias, cov = bias[used] @ turn.T, turn @ cov[used] @ turn.T
    return table(
        SENSOR_ERRORS,
        {
            "sensor_id": [names[k] for k in used],
            **unstack("direction_error_{}_arcsec", bias[:, :3]),
            **unstack("position_error_{}_km", bias[:, 3:]),
            **unstack_covariance("cov_{}", cov, SHARED_AXES),
            "bias_sigma_arcsec": prior[used, 0] / ARCSEC,
            "position_sigma_km": prior[used, 1],
            "n_objects": counts[used, 1].astype(np.int32),
            "n_observations": counts[used, 0].astype(np.int32),
        },
    )
