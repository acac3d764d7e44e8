"""Passages of objects through the field of one low sensor, with their true directions and rates."""

from typing import NamedTuple

import numpy as np

from epipole.tasks.algorithms.constants import ARCSEC, EARTH_RADIUS_KM, GM_KM3_S2

HALF_FIELD = np.radians(10.0)
FASTEST = np.radians(10.0)  # per second
DRAWN = 4000  # at once
FAR_KM = (12_000.0, 20_000.0, 26_560.0, 42_164.0)


class Passages(NamedTuple):
    """Detections of t tracklets, bounds (t + 1,), and the truth at time 0.

    time_s, u, cov : (n,), (n, 3), (n, 3, 3); true_u, true_w : (t, 3), directions and rates [rad/s]
    """

    bounds: np.ndarray
    time_s: np.ndarray
    u: np.ndarray
    cov: np.ndarray
    true_u: np.ndarray
    true_w: np.ndarray


def passages_of_one(
    seed: int, n: int, seconds: float, rate_hz: float, sigma_arcsec: float, *, far: bool
) -> Passages:
    """Return n passages of this length, in the field at both ends.

    `far`: on high orbits; else some 100 to 3,000 km away, at up to 10 degrees per second.
    """
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, seconds + 1e-9, 1.0 / rate_hz) - seconds / 2
    paths, true_u, true_w, found = [], [], [], 0
    while found < n:
        sensor, target = _drawn(rng, far)
        u, w = _direction(target - sensor)
        rows = np.flatnonzero(_passes(sensor, target, u, w, seconds))[: n - found]
        paths.append(_path(sensor[rows], target[rows], time_s))
        true_u.append(u[rows])
        true_w.append(w[rows])
        found += len(rows)
    u = np.concatenate(paths).reshape(-1, 3)
    across = np.eye(3) - u[:, :, None] * u[:, None]
    error = np.einsum("nij,nj->ni", across, rng.normal(size=u.shape) * sigma_arcsec * ARCSEC)
    seen = (u + error) / np.linalg.norm(u + error, axis=1, keepdims=True)
    return Passages(
        np.arange(n + 1) * len(time_s), np.tile(time_s, n), seen,
        (sigma_arcsec * ARCSEC) ** 2 * across, np.concatenate(true_u), np.concatenate(true_w),
    )  # fmt: skip


def _drawn(rng, far):
    sensor = _circular(rng, _unit(rng.normal(size=(DRAWN, 3))), rng.uniform(6800, 7600, DRAWN))
    if far:
        out = _unit(rng.normal(size=(DRAWN, 3)))
        return sensor, _circular(rng, out, rng.choice(FAR_KM, DRAWN))
    apart = rng.choice([0.02, 0.05, 0.1, 0.2, 0.4], DRAWN)[:, None]
    out = _unit(_unit(sensor[:, :3]) + rng.normal(size=(DRAWN, 3)) * apart)
    return sensor, _circular(rng, out, rng.uniform(6800, 8200, DRAWN))


def _circular(rng, out, radius_km):
    """Return states (n, 6) on circular orbits through points in these directions."""
    along = _unit(np.cross(out, rng.normal(size=out.shape)))
    speed = np.sqrt(GM_KM3_S2 / radius_km)[:, None]
    return np.concatenate([radius_km[:, None] * out, speed * along], axis=1)


def _passes(sensor, target, u, w, seconds):
    """Return which passages are slow enough, not behind the Earth, and in the field throughout."""
    toward = np.sum(sensor[:, :3] * u, axis=1)
    lowest = np.sqrt(np.sum(sensor[:, :3] ** 2, axis=1) - np.minimum(toward, 0) ** 2)
    good = (np.linalg.norm(w, axis=1) < FASTEST) & (lowest > EARTH_RADIUS_KM + 100)
    for end in (-seconds / 2, seconds / 2):
        at_end, _ = _direction(_moved(target, end) - _moved(sensor, end))
        good &= np.sum(at_end * u, axis=1) > np.cos(HALF_FIELD)
    return good


def _path(sensor, target, time_s):
    """Return directions (n, k, 3)."""
    out = [_direction(_moved(target, t) - _moved(sensor, t))[0] for t in time_s.tolist()]
    return np.stack(out, axis=1)


def _direction(state):
    range_km = np.linalg.norm(state[:, :3], axis=1, keepdims=True)
    u = state[:, :3] / range_km
    return u, (state[:, 3:] - np.sum(state[:, 3:] * u, axis=1, keepdims=True) * u) / range_km


def _moved(state, t):
    """Return circular states after t seconds: they turn in their planes."""
    radius = np.linalg.norm(state[:, :3], axis=1, keepdims=True)
    speed = np.linalg.norm(state[:, 3:], axis=1, keepdims=True)
    turn = speed / radius * t
    out, along = state[:, :3] / radius, state[:, 3:] / speed
    return np.concatenate(
        [
            radius * (np.cos(turn) * out + np.sin(turn) * along),
            speed * (np.cos(turn) * along - np.sin(turn) * out),
        ],
        axis=1,
    )


def _unit(v):
    return v / np.linalg.norm(v, axis=1, keepdims=True)
