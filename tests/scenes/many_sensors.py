"""Many low sensors that see geostationary objects; some have wrong clocks or ephemerides."""

from collections.abc import Mapping

import numpy as np

from epipole.tasks.algorithms.constants import GM_KM3_S2
from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.algorithms.sensor_faults.fault_judgement import Lines

POSITION_KM = 0.02
NOISE_RAD = 2e-5
SEEN = 0.3  # probability that a sensor sees an object at an epoch


def circular(rng, n: int, radius_km: float, highest: float):
    """Return random places and velocities on circular orbits."""
    tilt, node, along = rng.uniform([0, 0, 0], [highest, 2 * np.pi, 2 * np.pi], (n, 3)).T
    c, s, ci, si = np.cos(node), np.sin(node), np.cos(tilt), np.sin(tilt)
    first, second = np.array([c, s, 0 * c]), np.array([-s * ci, c * ci, si])
    x = radius_km * (np.cos(along) * first + np.sin(along) * second).T
    v = np.sqrt(GM_KM3_S2 / radius_km) * (-np.sin(along) * first + np.cos(along) * second).T
    return x, v


def lines_of_many(
    seed: int, n_sensors: int, n_groups: int, late_s: Mapping[int, float] | None = None,
    off_km: Mapping[int, float] | None = None, seen_share: float = SEEN,
) -> Lines:  # fmt: skip
    """Return lines of sight from sensors, some with late clocks or an ephemeris off along x."""
    rng = np.random.default_rng(seed)
    late, off = late_s or {}, off_km or {}
    delay = np.array([late.get(s, 0.0) for s in range(n_sensors)])
    bias = rng.normal(0, POSITION_KM, (n_sensors, 3))
    bias[:, 0] += [off.get(s, 0.0) for s in range(n_sensors)]
    x, v = circular(rng, n_groups, 42164.0, 0.2)
    rows = []
    for g in range(n_groups):
        r, w = circular(rng, n_sensors, 7500.0, 2.0)
        seen = np.flatnonzero(rng.random(n_sensors) < seen_share)
        d = delay[seen, None]
        u = (x[g] - v[g] * d) - (r[seen] - w[seen] * d)
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        noise = rng.normal(0, NOISE_RAD, (len(seen), 1, 2))
        u += (noise @ tangent_basis(u))[:, 0]
        n = len(seen)
        rows.append((np.full(n, g), seen, u / np.linalg.norm(u, axis=1, keepdims=True),
                     np.tile(np.eye(2) * NOISE_RAD**2, (n, 1, 1)), np.tile(x[g], (n, 1)),
                     np.tile(v[g], (n, 1)), r[seen] + bias[seen], w[seen]))  # fmt: skip
    return Lines(*(np.concatenate(column) for column in zip(*rows, strict=True)))
