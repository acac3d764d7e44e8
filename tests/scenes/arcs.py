"""Arcs of a geostationary object, with independent errors and errors that views share."""

import numpy as np

from epipole.tasks.algorithms.constants import ARCSEC, SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.algorithms.orbits.orbit_fit import Arcs, propagate

GEO = np.array([-39359.89, 15125.76, 64.30, -1.1030, -2.8700, 0.01])


def trial(
    seed, *, n_sensors=4, times=None, noise=2.0, bias=3.0, place_km=0.05, truth=GEO, number=0,
    worse=1.0,
):  # fmt: skip
    """Return views of one object with independent errors and with errors shared by a sensor.

    Objects with different numbers have other independent errors, but sensors and shared errors
    are those of the seed. The first sensor's error of place is worse than stated by a factor.
    """
    rng = np.random.default_rng(seed)
    times = np.arange(-294.0, 295.0, 49.0) if times is None else times
    out, along = rng.normal(size=(2, n_sensors, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    along = np.cross(out, along)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    shift = rng.normal(size=(n_sensors, 3)) * bias * ARCSEC
    place = rng.normal(size=(n_sensors, 3)) * place_km
    place[0] *= worse
    rng = np.random.default_rng((seed, number))
    rows = []
    for t in times:
        for s in range(n_sensors):
            angle = t * 7.5 / 7000
            r = 7000 * (np.cos(angle) * out[s] + np.sin(angle) * along[s])
            delay = 0.0
            for _ in range(4):
                sight = propagate(truth, t - delay)[:3] - r
                delay = np.linalg.norm(sight) / SPEED_OF_LIGHT_KM_S
            u = sight / np.linalg.norm(sight)
            u = u + shift[s] + rng.normal(size=2) * noise * ARCSEC @ tangent_basis(u)
            rows.append((t, s, r + place[s], u / np.linalg.norm(u)))
    t, s, r, u = (np.array(column) for column in zip(*rows, strict=True))
    n = len(t)
    return Arcs(
        np.array([0, n]), t, s, r, u,
        np.tile(np.eye(2) * (noise * ARCSEC) ** 2, (n, 1, 1)),
        np.tile(np.eye(2) * (bias * ARCSEC) ** 2, (n, 1, 1)),
        np.full(n, place_km),
    )  # fmt: skip
