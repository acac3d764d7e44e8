"""Directions to one object under all forces, with independent and shared errors."""

import numpy as np

from epipole.tasks.algorithms.constants import ARCSEC, SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.algorithms.orbits.forces import surroundings
from epipole.tasks.algorithms.orbits.orbit_determination import ObjectDirections
from epipole.tasks.algorithms.orbits.trajectories import integrate, interpolate_position

NOON_NS = 1_780_142_400_000_000_000  # 2026-05-30T12:00:00Z
AROUND = surroundings(NOON_NS, NOON_NS - 90_000 * 10**9, NOON_NS + 130_000 * 10**9)
# Unknowns of true orbits at noon, in the axes of the night: the last two are areas over mass.
GEO = np.array([-39359.89, 15125.76, 64.30, -1.1030, -2.8700, 0.01, 0.03, 0.0])
LOW = np.array([5000.0, 4000.0, 2500.0, -4.95, 5.62, 1.3, 0.0, 0.0])


def positions(unknowns, times_s):
    """Return the positions (n, 3) of an orbit at times [s]."""
    path = integrate(unknowns, 0.0, min(times_s.min(), 0.0), max(times_s.max(), 0.0), AROUND)
    out, x = np.empty((len(times_s), 3)), np.empty(3)
    for k, t in enumerate(times_s):
        interpolate_position(t, path, x)
        out[k] = x
    return out


def trial(
    seed, truth=GEO, *, times_s=None, n_sensors=3, sensor_km=7000.0, noise=2.0, bias=3.0,
    place_km=0.02, toward=None, shared=None,
):  # fmt: skip
    """Return directions from circular sensors, all at the same times.

    `noise` of each direction and `bias` of each sensor [arcsec], `place_km` of its position. The
    sensors are near the line to `toward`, or to the object. `shared` are the errors themselves:
    directions [rad] and positions [km], each (n_sensors, 3).
    """
    rng = np.random.default_rng(seed)
    times_s = np.linspace(-300.0, 300.0, 21) if times_s is None else times_s
    axis = rng.normal(size=(n_sensors, 3))
    # Sensors on the object's side of the Earth, in planes of their own.
    towards = (truth if toward is None else toward)[:3]
    out = towards / np.linalg.norm(towards) + 0.6 * axis
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    along = np.cross(axis, out)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    shift = rng.normal(size=(n_sensors, 3)) * bias * ARCSEC
    place = rng.normal(size=(n_sensors, 3)) * place_km
    shift, place = shared or (shift, place)
    time_s, sensor = np.repeat(times_s, n_sensors), np.tile(np.arange(n_sensors), len(times_s))
    angle = (time_s * np.sqrt(398600.0 / sensor_km**3))[:, None]
    r = sensor_km * (np.cos(angle) * out[sensor] + np.sin(angle) * along[sensor])
    delay = np.zeros(len(time_s))
    for _ in range(4):
        line = positions(truth, time_s - delay) - r
        delay = np.linalg.norm(line, axis=1) / SPEED_OF_LIGHT_KM_S
    u = line / np.linalg.norm(line, axis=1, keepdims=True)
    basis = tangent_basis(u)
    error = rng.normal(size=(len(u), 2)) * noise * ARCSEC
    seen = u + shift[sensor] + np.einsum("nk,nka->na", error, basis)
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    sigmas = np.repeat([max(bias, 1e-3) * ARCSEC, max(place_km, 1e-6)], 3)
    return ObjectDirections(
        time_s, sensor, r + place[sensor], seen, tangent_basis(seen),
        np.tile(np.eye(2) / (noise * ARCSEC) ** 2, (len(u), 1, 1)),
        np.tile(np.diag(1.0 / sigmas**2), (n_sensors, 1, 1)),
    )  # fmt: skip
