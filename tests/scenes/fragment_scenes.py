"""Broken tracks with their truth: many far objects in the field of a low sensor."""

from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from epipole.schemas.arrays import Array, Indices
from epipole.tasks.algorithms.simulation.constants import GM_KM3_S2
from epipole.tasks.algorithms.simulation.paths import state_at

FIELD_RAD = np.radians(8.0)
FIELD_PX = 1024
PIXEL_RAD = FIELD_RAD / FIELD_PX
SIGMA_PX = 0.15


class BrokenTracks(NamedTuple):
    """Fragments in the layout of the linkers, and the object of each."""

    offsets: Indices
    time_s: Array
    u_icrs: Array
    sigma_rad: Array
    truth: Indices


def broken_tracks(
    seed: int,
    n_objects: int,
    gap_s: tuple[float, float],
    *,
    belt: bool = True,
    field_rad: float = FIELD_RAD,
    duration_s: float = 240.0,
) -> BrokenTracks:
    """Return tracks at 1 Hz of objects in a low sensor's field, each with gaps.

    In the belt, objects are near geostationary height on orbits inclined up to 15 degrees. They
    all have nearly the same motion, which makes them hard to tell apart. Otherwise they are at
    ranges of 1,500 to 45,000 km with velocities in any direction. Each object is in the field
    for part of the time, and is lost once or twice for a time in the range `gap_s`.
    """
    rng = np.random.default_rng(seed)
    sensor = np.array([7000.0, 0.001, np.radians(60.0), rng.uniform(0, 6), 0.0, rng.uniform(0, 6)])
    t = np.arange(duration_s) + 0.0
    r_sensor, _ = state_at(sensor, t)
    out = _direction_up(rng, r_sensor[len(t) // 2])
    e_1 = np.cross(out, rng.normal(size=3))
    e_1 /= np.linalg.norm(e_1)
    e_2 = np.cross(out, e_1)
    sigma = SIGMA_PX * field_rad / FIELD_PX
    offsets, times, u, truth = [0], [], [], []
    for k in range(n_objects):
        at = rng.uniform(0, duration_s)
        place = rng.uniform(-field_rad / 2, field_rad / 2, 2)
        sight = out + place[0] * e_1 + place[1] * e_2
        sight /= np.linalg.norm(sight)
        here, _ = state_at(sensor, np.array([at]))
        if belt:  # where the line of sight passes the height of an orbit
            height = 42164.0 + rng.normal() * 300.0
            reach = _reach(here[0], sight, height)
            heading = np.cross([0.0, 0.0, 1.0], sight)
            heading += rng.normal() * np.radians(8.0) * np.cross(sight, heading)
        else:
            reach = np.exp(rng.uniform(np.log(1500.0), np.log(45000.0)))
            heading = np.cross(sight, rng.normal(size=3))
        r = here[0] + reach * sight
        v = heading / np.linalg.norm(heading) * np.sqrt(GM_KM3_S2 / np.linalg.norm(r))
        line = _two_body(r, v, t - at) - r_sensor
        line /= np.linalg.norm(line, axis=1, keepdims=True)
        inside = (np.abs(line @ e_1) < field_rad / 2) & (np.abs(line @ e_2) < field_rad / 2)
        seen = np.flatnonzero(inside & (line @ out > 0) & (rng.random(len(t)) > 0.05))
        for part in _break(rng, seen, t, gap_s):
            noise = rng.normal(size=(len(part), 3)) * sigma
            spot = line[part] + noise
            u.append(spot / np.linalg.norm(spot, axis=1, keepdims=True))
            times.append(t[part])
            truth.append(k)
            offsets.append(offsets[-1] + len(part))
    n = offsets[-1]
    return BrokenTracks(
        np.array(offsets), np.concatenate(times), np.concatenate(u),
        np.full(n, sigma), np.array(truth),
    )  # fmt: skip


def _direction_up(rng: np.random.Generator, r: Array) -> Array:
    """Return a direction near the equator that is well above a low sensor's horizon."""
    while True:
        a = rng.uniform(0, 2 * np.pi)
        out = np.array([np.cos(a), np.sin(a), 0.0])
        if out @ r > 0.3 * np.linalg.norm(r):
            return out


def _reach(r: Array, sight: Array, height_km: float) -> float:
    """Return the distance along a line of sight to a sphere around the Earth's centre."""
    along = r @ sight
    return float(-along + np.sqrt(along * along - r @ r + height_km**2))


def _break(
    rng: np.random.Generator, seen: Indices, t: Array, gap_s: tuple[float, float]
) -> list[Indices]:
    """Cut gaps out of a track: fragments of five detections or more."""
    parts, rest = [], seen
    for _ in range(2):
        if len(rest) < 10:
            break
        cut = rng.integers(5, len(rest))
        gap = rng.uniform(*gap_s)
        parts.append(rest[:cut])
        rest = rest[t[rest] >= t[rest[cut - 1]] + gap]
    parts.append(rest)
    return [part for part in parts if len(part) >= 5]


def _two_body(r: Array, v: Array, t: Array) -> Array:
    """Return places on an orbit at times from the instant of r and v."""

    def motion(_: float, state: Array) -> Array:
        x = state[:3]
        return np.concatenate([state[3:], -GM_KM3_S2 * x / np.linalg.norm(x) ** 3])

    out = np.empty((len(t), 3))
    for side in (t < 0, t >= 0):
        order = np.argsort(np.abs(t[side]))
        at = t[side][order]
        if len(at):
            path = solve_ivp(
                motion, (0.0, at[-1]), np.concatenate([r, v]), t_eval=at, rtol=1e-10, atol=1e-7
            )
            out[np.flatnonzero(side)[order]] = path.y[:3].T
    return out
