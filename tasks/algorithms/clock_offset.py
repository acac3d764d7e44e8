"""Clock offsets of sensors, constant over a night, from the residuals of positions.

A frame stamped late by d shows what stood there d before: the line of sight lags behind by d
times its rate. The objects' positions, a bias of each sensor's own position and one of its
attitude are solved with the offsets, so that none of these is taken for a clock.
"""

import itertools
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.rotations import skew
from epipole.tasks.algorithms.sky import tangent_basis

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

PRIOR_S = 10.0  # 1-sigma of an offset before anything is known
PER_SENSOR = 7  # offset, bias of position (3), bias of attitude (3)


class Lines(NamedTuple):
    """Lines of sight to objects at common instants.

    group : (n,) int
        Position that the line belongs to, 0 .. g - 1.
    sensor : (n,) int
        Sensor, 0 .. s - 1.
    u : (n, 3) float
        Measured directions, aberration removed.
    cov : (n, 2, 2) float
        Their errors that are new each time, on `tangent_basis(u)` [rad^2].
    x_km, v_km_s : (n, 3) float
        Position and velocity of the line's object as they were solved, at the line's time.
    r_km, v_sensor_km_s : (n, 3) float
        The same of its sensor.
    """

    group: Indices
    sensor: Indices
    u: Array
    cov: Array
    x_km: Array
    v_km_s: Array
    r_km: Array
    v_sensor_km_s: Array


def clock_offsets(
    lines: Lines, position_sigma_km: Array, attitude_sigma_rad: Array
) -> tuple[Array, Array]:
    """Return each sensor's clock offset, reported minus true time, and its 1-sigma error.

    Parameters
    ----------
    lines
        Lines of sight, in any order; groups of one line say nothing.
    position_sigma_km, attitude_sigma_rad : (s,) float
        1-sigma an axis of the biases that a sensor keeps over the night: of its position
        [km], and of its attitude [rad] (0 where stars give it).

    Returns
    -------
    offset_s, sigma_s : (s,) float
        NaN for a sensor without lines. A sigma near `PRIOR_S` means: the geometry shows nothing.

    Notes
    -----
    Linear least squares about the solved positions, those eliminated group by group (Schur
    complement). Valid while offset times rate stays small beside the range's own angle: offsets
    of seconds. What all sensors share shows only by their own motion.
    """
    n_sensors = len(position_sigma_km)
    size = PER_SENSOR * n_sensors
    normal, right = np.zeros((size, size)), np.zeros(size)
    spread = np.concatenate(
        [
            np.full((n_sensors, 1), PRIOR_S),
            np.repeat(np.maximum(position_sigma_km, 1e-6)[:, None], 3, axis=1),
            np.repeat(np.maximum(attitude_sigma_rad, 1e-12)[:, None], 3, axis=1),
        ],
        axis=1,
    ).ravel()
    to_position, to_sensor, misses = _whitened(lines, spread)
    order = np.argsort(lines.group, kind="stable")
    bounds = np.flatnonzero(np.diff(lines.group[order], prepend=-1, append=-1))
    for lo, hi in itertools.pairwise(bounds):
        rows = order[lo:hi]
        if hi - lo < 2:
            continue
        H, A, e = to_position[rows].reshape(-1, 3), to_sensor[rows], misses[rows].ravel()
        # What the position can absorb says nothing of the sensors.
        free, _ = np.linalg.qr(H)
        columns = (PER_SENSOR * lines.sensor[rows][:, None] + np.arange(PER_SENSOR)).ravel()
        wide = np.zeros((len(e), len(columns)))
        for k in range(hi - lo):
            own = slice(PER_SENSOR * k, PER_SENSOR * (k + 1))
            wide[2 * k : 2 * k + 2, own] = A[k]
        wide -= free @ (free.T @ wide)
        np.add.at(normal, np.ix_(columns, columns), wide.T @ wide)
        np.add.at(right, columns, wide.T @ (e - free @ (free.T @ e)))
    cov = np.linalg.inv(normal + np.eye(size))
    found, sigma = (cov @ right) * spread, np.sqrt(np.diag(cov)) * spread
    seen = np.bincount(lines.sensor, minlength=n_sensors) > 0
    offset = np.where(seen, found[::PER_SENSOR], np.nan)
    return offset, np.where(seen, sigma[::PER_SENSOR], np.nan)


def _whitened(lines: Lines, spread: Array) -> tuple[Array, Array, Array]:
    """Return derivatives by position (n, 2, 3) and by the sensor's unknowns (n, 2, 7) and the
    residuals (n, 2), in units of the noise and of the unknowns' spread."""
    basis = tangent_basis(lines.u)
    away = lines.x_km - lines.r_km
    reach = np.linalg.norm(away, axis=1)
    foretold = away / reach[:, None]
    root = np.linalg.inv(np.linalg.cholesky(lines.cov))
    by_place = root @ basis / reach[:, None, None]
    rate = np.einsum("nij,nj->ni", by_place, lines.v_km_s - lines.v_sensor_km_s)
    by_turn = root @ basis @ -skew(lines.u)
    own = np.concatenate([-rate[:, :, None], by_place, by_turn], axis=2)
    per_line = spread.reshape(-1, PER_SENSOR)[lines.sensor]
    misses = np.einsum("nij,nj->ni", root @ basis, lines.u - foretold)
    return by_place, own * per_line[:, None, :], misses
