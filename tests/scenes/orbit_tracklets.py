"""Attributables of low objects at several times, each from a sensor of its own; motion by SciPy."""

from typing import NamedTuple

import numpy as np
import pyarrow as pa
from scipy.integrate import solve_ivp

from epipole.schemas.bridge import unstack, unstack_covariance
from epipole.schemas.columns import ATTRIBUTABLE_AXES
from epipole.schemas.rejects import Outcome
from epipole.schemas.tables import TRACKLETS
from epipole.tasks.algorithms.geometry.directions import radec_from_unit
from epipole.tasks.algorithms.orbit_linking.arc_fit import Tracklets
from scenes.associations import filled

GM, RADIUS, OBLATE, LIGHT = 398600.4418, 6378.137, 1.08262668e-3, 299792.458
ARCSEC = np.pi / 648000
NIGHT, START_NS = "2026-05-30", 1_780_099_200_000_000_000  # of their rows


def gravity(r):
    """Return the acceleration [km/s^2] of two bodies and J2 at r (3,) [km]."""
    r2 = r @ r
    z2 = r[2] ** 2 / r2
    share = 1.5 * OBLATE * RADIUS**2 / r2 * np.array([1 - 5 * z2, 1 - 5 * z2, 3 - 5 * z2])
    return -GM / r2**1.5 * r * (1 + share)


def moved(state, times_s):
    """Return states (n, 6) at several times [s]; `times_s` from 0 on, in order."""
    if not len(times_s):
        return np.zeros((0, 6))
    motion = solve_ivp(
        lambda _, y: np.concatenate([y[3:], gravity(y[:3])]), (0, times_s[-1] + 1e-9), state,
        "DOP853", t_eval=times_s, rtol=1e-11, atol=1e-9,
    )  # fmt: skip
    return motion.y.T


class OrbitTracklets(NamedTuple):
    """Tracklets in order of time, the object of each, and its true state at the epoch."""

    tracklets: Tracklets
    object: np.ndarray
    state: np.ndarray


def low_orbit(rng, eccentricity=0.002):
    """Return the state of a nearly circular low orbit."""
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    r = RADIUS + rng.uniform(450, 1200)
    radial, level = eccentricity * rng.normal(size=2)
    speed = np.sqrt(GM / r)
    return np.concatenate([r * axes[0], speed * (radial * axes[0] + (1 + level) * axes[1])])


def orbit_tracklets(
    seed, n_objects, per_object, gap_s, *, direction_arcsec=4.0, rate_arcsec_s=1.0, noisy=True,
    range_km=(300, 2000), pause_s=0.0,
):  # fmt: skip
    """Return tracklets of objects: the times of each are up to `gap_s` apart.

    Half of them are `pause_s` later.
    """
    rng = np.random.default_rng(seed)
    rows = []
    for number in range(n_objects):
        times = np.cumsum(rng.uniform(0.05, 1.0, per_object) * gap_s)
        times[per_object // 2 :] += pause_s
        for t, state in zip(times, moved(low_orbit(rng), times), strict=True):
            rows.append((t, number, state))
    rows.sort(key=lambda row: row[0])
    time_s, number = (np.array([row[k] for row in rows]) for k in range(2))
    state = np.array([row[2] for row in rows]).reshape(-1, 6)
    n = len(rows)
    sensor = np.array([_sensor(x, rng, range_km) for x in state]).reshape(-1, 6)
    u, w = _seen(state, sensor)
    east = np.cross([0.0, 0.0, 1.0], u)
    east /= np.linalg.norm(east, axis=1, keepdims=True)
    north = np.cross(u, east)
    sigma = np.array([direction_arcsec] * 2 + [rate_arcsec_s] * 2) * ARCSEC
    e = (rng.normal(size=(n, 4)) if noisy else np.zeros((n, 4))) * sigma
    u = u + e[:, :1] * east + e[:, 1:2] * north
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    w = w + e[:, 2:3] * east + e[:, 3:4] * north
    east = np.cross([0.0, 0.0, 1.0], u)
    east /= np.linalg.norm(east, axis=1, keepdims=True)
    tracklets = Tracklets(
        time_s, time_s - 2.0, time_s + 2.0, np.arange(n), sensor[:, :3].copy(),
        sensor[:, 3:].copy(), u, east, np.cross(u, east), w,
        np.tile(np.diag(sigma**2), (n, 1, 1)), np.full(n, 1e-4),
    )  # fmt: skip
    return OrbitTracklets(tracklets, number, state)


def _sensor(state, rng, range_km):
    """Return a sensor's state: in a circular orbit, somewhere about the object."""
    while True:
        way = rng.normal(size=3)
        r = state[:3] + rng.uniform(*range_km) * way / np.linalg.norm(way)
        if RADIUS + 400 < np.linalg.norm(r) < RADIUS + 1300:
            break
    v = np.cross(r, rng.normal(size=3))
    return np.concatenate([r, v / np.linalg.norm(v) * np.sqrt(GM / np.linalg.norm(r))])


def _seen(state, sensor):
    """Return directions and rates with light time: differences over 2 ms."""
    sides = []
    for dt in (-1e-3, 0.0, 1e-3):
        fall, fall_s = (
            np.array([gravity(r) for r in x[:, :3]]).reshape(-1, 3) for x in (state, sensor)
        )
        there = sensor[:, :3] + dt * sensor[:, 3:] + dt * dt / 2 * fall_s
        delay = np.zeros(len(state))
        for _ in range(4):
            t = (dt - delay)[:, None]
            d = state[:, :3] + t * state[:, 3:] + t * t / 2 * fall - there
            delay = np.linalg.norm(d, axis=1) / LIGHT
        sides.append(d / np.linalg.norm(d, axis=1, keepdims=True))
    return sides[1], (sides[2] - sides[0]) / 2e-3


def rows_of(scene, **columns) -> pa.Table:
    """Return TRACKLETS of a scene, each seen by one sensor alone unless `columns` differ."""
    seen, n = scene.tracklets, len(scene.object)
    ra, dec = radec_from_unit(seen.u)
    times = {
        name: START_NS + np.rint(values * 1e9).astype(np.int64)
        for name, values in (("epoch", seen.time_s), ("start_time", seen.first_s),
                             ("end_time", seen.last_s))
    }  # fmt: skip
    numbers = {
        "ra_deg": np.degrees(ra), "dec_deg": np.degrees(dec),
        "ra_rate_arcsec_s": np.einsum("ni,ni->n", seen.w, seen.east) / ARCSEC,
        "dec_rate_arcsec_s": np.einsum("ni,ni->n", seen.w, seen.north) / ARCSEC,
        "bias_sigma_arcsec": np.zeros(n), "position_sigma_km": seen.position_km,
        **unstack_covariance("cov_{}", seen.cov / ARCSEC**2, ATTRIBUTABLE_AXES),
        **unstack("{}_km", seen.r_km), **unstack("v{}_km_s", seen.v_km_s),
    }  # fmt: skip
    names = {
        "tracklet_id": [f"t{k:02d}" for k in range(n)], "track_id": [f"t{k:02d}" for k in range(n)],
        "sensor_id": [f"s{k:02d}" for k in range(n)], "object_id": [None] * n,
        "outcome": [Outcome.SEEN_BY_ONE.value] * n,
    }  # fmt: skip
    return filled(TRACKLETS, n, {**times, **numbers, **names, **columns})
