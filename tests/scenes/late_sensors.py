"""Lines of sight of four sensors whose time stamps may be late."""

import numpy as np

from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.algorithms.sensor_faults.fault_judgement import Lines
from epipole.tasks.algorithms.simulation.paths import state_at

SIGMA = 1.0 * ARCSEC
POSITION_KM = 0.02


def orbit(a, i, raan, anomaly):
    """Return orbital elements of a [km] and angles [deg]."""
    return np.array([a, 0.001, np.radians(i), np.radians(raan), 0.0, np.radians(anomaly)])


SENSORS = [
    orbit(6977.0, 35, 354, 112), orbit(7471.0, 63, 329, 152), orbit(6979.0, 35, 115, 60),
    orbit(6996.0, 98, 125, 64),
]  # fmt: skip


def lines_of(seed, offsets, *, bias_km=POSITION_KM, turn_rad=0.0, n_epochs=60, used=(0, 1, 2, 3)):
    """Return lines of sight to nine far objects, of sensors whose stamps are late by `offsets`."""
    rng = np.random.default_rng(seed)
    t = np.arange(n_epochs) * 2.0
    bias = rng.normal(size=(4, 3)) * bias_km
    turn = rng.normal(size=(4, 3)) * turn_rad
    parts = {name: [] for name in Lines._fields}
    for k in range(9):
        target = orbit(42164.0 + rng.normal() * 100, 0.5 * k, 0.0, 158.0 + 0.2 * k)
        x, v = state_at(target, t)
        for s in used:
            true_t = t - offsets[s]
            shown, _ = state_at(target, true_t)
            here, _ = state_at(SENSORS[s], true_t)
            r, v_sensor = state_at(SENSORS[s], t)
            u = shown - here
            u /= np.linalg.norm(u, axis=1)[:, None]
            u += np.cross(turn[s], u)
            noise = rng.normal(size=(n_epochs, 2)) * SIGMA
            u = u + np.einsum("ni,nij->nj", noise, tangent_basis(u))
            u /= np.linalg.norm(u, axis=1)[:, None]
            parts["group"].append(k * n_epochs + np.arange(n_epochs))
            parts["sensor"].append(np.full(n_epochs, s))
            parts["u"].append(u)
            parts["cov"].append(np.tile(np.eye(2) * SIGMA**2, (n_epochs, 1, 1)))
            parts["x_km"].append(x + 0.5)  # a solved position has an error
            parts["v_km_s"].append(v)
            parts["r_km"].append(r + bias[s])
            parts["v_sensor_km_s"].append(v_sensor)
    return Lines(**{name: np.concatenate(values) for name, values in parts.items()})
