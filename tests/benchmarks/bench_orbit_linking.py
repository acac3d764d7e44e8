"""Linking by orbits: tracklets of a dense shell, as its own satellites see each other.

python tests/benchmarks/bench_orbit_linking.py [--satellites 60 240] [--hours 0.5] [--seeds 1]

A Walker shell of 1,584 satellites at 550 km, moved by 10 km at random, propagated by SGP4. Some of
them have two sensors of 18 degrees, fixed to the body. A crossing of a field is one attributable:
12 arcsec per detection at 3 Hz, for 13 s on average, less at high rates.

Figures as of difi (Moeyens et al. 2021, THOR, AJ 162, 143): an object of three tracklets or more is
found if three are in a group with no tracklet of another. Groups per object: 1 is best.
"""

import argparse
import time
from collections import Counter
from typing import NamedTuple

import numpy as np
from sgp4.api import WGS72, Satrec, SatrecArray

from epipole.schemas.arrays import Array, Indices
from epipole.schemas.settings import LinkingSettings
from epipole.tasks.algorithms.constants import ARCSEC, SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.directions import east_north
from epipole.tasks.algorithms.orbit_linking.arc_fit import Tracklets
from epipole.tasks.algorithms.orbit_linking.grouping import link_tracklets
from epipole.tasks.algorithms.simulation.shells import GM_WGS72_KM3_S2, walker_elements

PATTERN, HEIGHT_KM, INCLINATION_DEG = (1584, 72, 39), 550.0, 53.0
SCATTER_KM, ECCENTRICITY = 10.0, 1e-3
STEP_S, GAP_S = 5.0, 60.0  # of the search for crossings; between two of one object in one field
HALF_FIELD, RANGES_KM = np.radians(9.0), (20.0, 2500.0)
SIGMA, RATE_HZ, MEAN_S = 12 * ARCSEC, 3.0, 12.0
POSITION_KM = 0.015  # of a satellite, the same for all its tracklets
EPOCH = 28000.0  # days after 1949-12-31, of the elements
JD_1949 = 2433281.5


class Seen(NamedTuple):
    """Tracklets in order of time, and the object of each."""

    tracklets: Tracklets
    object: Indices


def shell(rng: np.random.Generator) -> tuple[SatrecArray, list[Satrec]]:
    """Return the satellites of the shell."""
    radius = 6378.137 + HEIGHT_KM
    elements = walker_elements(radius, np.radians(INCLINATION_DEG), PATTERN, 2 * np.pi)
    n = len(elements)
    a = elements[:, 0] + rng.normal(0, 2.0, n)
    node = elements[:, 3] + rng.normal(0, SCATTER_KM / 3 / radius, n)
    argument = elements[:, 5] + rng.normal(0, SCATTER_KM / radius, n)
    e, perigee = np.abs(rng.normal(0, ECCENTRICITY, n)), rng.uniform(0, 2 * np.pi, n)
    made = []
    for k in range(n):
        satellite = Satrec()
        satellite.sgp4init(
            WGS72, "i", k, EPOCH, 0.0, 0.0, 0.0, e[k], perigee[k], elements[k, 2],
            (argument[k] - perigee[k]) % (2 * np.pi), 60 * np.sqrt(GM_WGS72_KM3_S2 / a[k] ** 3),
            node[k] % (2 * np.pi),
        )  # fmt: skip
        made.append(satellite)
    return SatrecArray(made), made


def crossings(
    satellites: SatrecArray, count: int, hours: float, rng: np.random.Generator
) -> tuple[Array, Indices, Indices]:
    """Return time [s], sensor and object of each crossing; satellite s has sensors 2 s, 2 s + 1."""
    seers = rng.permutation(PATTERN[0])[:count]
    azimuth = rng.uniform(0, 2 * np.pi, (count, 2))
    elevation = np.radians(rng.uniform(-12, 20, (count, 2)))
    last: dict[tuple[int, int], float] = {}
    found = []
    for t in np.arange(0.0, hours * 3600, STEP_S):
        _, r, v = satellites.sgp4(np.array([JD_1949 + EPOCH]), np.array([t / 86400]))
        r, v = r[:, 0], v[:, 0]
        for k, seer in enumerate(seers):
            up = r[seer] / np.linalg.norm(r[seer])
            side = np.cross(up, v[seer]) / np.linalg.norm(v[seer])
            ahead = np.cross(side, up)
            d = r - r[seer]
            distance = np.linalg.norm(d, axis=1)
            near = np.flatnonzero((distance > RANGES_KM[0]) & (distance < RANGES_KM[1]))
            for b in range(2):
                level = np.cos(azimuth[k, b]) * ahead + np.sin(azimuth[k, b]) * side
                axis = np.cos(elevation[k, b]) * level + np.sin(elevation[k, b]) * up
                seen = near[d[near] @ axis > np.cos(HALF_FIELD) * distance[near]]
                for number in seen.tolist():
                    sensor = 2 * int(seer) + b
                    if t - last.get((sensor, number), -np.inf) >= GAP_S:
                        found.append((t + rng.uniform(0, STEP_S), sensor, number))
                    last[sensor, number] = t
    found.sort()
    time_s, sensor, number = np.array(found).reshape(-1, 3).T
    return time_s.copy(), sensor.astype(np.int64), number.astype(np.int64)


def measured(
    satellites: list[Satrec],
    time_s: Array,
    sensor: Indices,
    number: Indices,
    rng: np.random.Generator,
) -> Tracklets:
    """Return the attributables of crossings, with errors."""
    n = len(time_s)
    states = np.array([
        [np.concatenate(satellites[k].sgp4(JD_1949 + EPOCH, t / 86400)[1:]) for k in pair]
        for pair, t in zip(np.stack([sensor // 2, number], axis=1).tolist(), time_s, strict=True)
    ])  # fmt: skip
    r, v, there, moving = states[:, 0, :3], states[:, 0, 3:], states[:, 1, :3], states[:, 1, 3:]
    delay = np.linalg.norm(there - r, axis=1) / SPEED_OF_LIGHT_KM_S
    d = there - moving * delay[:, None] - r
    distance = np.linalg.norm(d, axis=1)
    u = d / distance[:, None]
    recedes = np.einsum("ni,ni->n", u, moving - v)
    relative = moving * (1 - recedes / SPEED_OF_LIGHT_KM_S)[:, None] - v
    w = (relative - np.einsum("ni,ni->n", u, relative)[:, None] * u) / distance[:, None]
    fastest = 2 * HALF_FIELD / np.linalg.norm(w, axis=1)
    lasts = np.minimum(rng.exponential(MEAN_S, n) + 1.0, fastest)
    detections = np.maximum(lasts * RATE_HZ, 3)
    of_direction = SIGMA / np.sqrt(detections)
    of_rate = of_direction * np.sqrt(12) / lasts
    sigma = np.stack([of_direction, of_direction, of_rate, of_rate], axis=1)
    error = rng.normal(size=(n, 4)) * sigma
    axes = east_north(u)
    u = u + np.einsum("nk,nki->ni", error[:, :2], axes)
    w = w + np.einsum("nk,nki->ni", error[:, 2:], axes)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    w -= np.einsum("ni,ni->n", w, u)[:, None] * u
    east, north = (np.ascontiguousarray(axis) for axis in np.moveaxis(east_north(u), 1, 0))
    bias = POSITION_KM * rng.normal(size=(PATTERN[0], 3))
    cov = np.einsum("nk,kl->nkl", sigma**2, np.eye(4))
    return Tracklets(
        time_s, time_s - lasts / 2, time_s + lasts / 2, sensor, r + bias[sensor // 2],
        np.ascontiguousarray(v), u, east, north, w, cov, np.full(n, POSITION_KM),
    )  # fmt: skip


def scene(seed: int, count: int, hours: float) -> Seen:
    """Return the tracklets that `count` satellites have in some hours."""
    rng = np.random.default_rng(seed)
    array, satellites = shell(rng)
    time_s, sensor, number = crossings(array, count, hours, rng)
    return Seen(measured(satellites, time_s, sensor, number, rng), number)


def judge(label: Indices, number: Indices) -> tuple[float, float, int, int, float]:
    """Return the shares of objects found and of grouped tracklets that are their group's object,
    the number of groups with tracklets of two objects, of groups, and of groups per object."""
    order = np.argsort(label, kind="stable")
    groups = np.split(number[order], np.flatnonzero(np.diff(label[order])) + 1)
    found, pure, grouped, mixed, count, grouped_objects = set(), 0, 0, 0, 0, set()
    for group in groups:
        if len(group) == 1:
            continue
        main, size = Counter(group.tolist()).most_common(1)[0]
        pure, grouped, count = pure + size, grouped + len(group), count + 1
        mixed += size < len(group)
        grouped_objects.add(main)
        if size == len(group) >= 3:
            found.add(main)
    asked = sum(times >= 3 for times in Counter(number.tolist()).values())
    shares = len(found) / max(asked, 1), pure / max(grouped, 1)
    return *shares, mixed, count, count / max(len(grouped_objects), 1)


def main() -> None:
    """Print for each number of satellites and seed: tracklets, found, purity, groups, time."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--satellites", type=int, nargs="+", default=[60, 240])
    parser.add_argument("--hours", type=float, default=0.5)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    chosen = parser.parse_args()
    settings = LinkingSettings()
    print(
        "| satellites | tracklets | found % | purity % | groups of two objects | groups per object "
        "| ms a tracklet |"
    )
    for count in chosen.satellites:
        for seed in chosen.seeds:
            tracklets, number = scene(seed, count, chosen.hours)
            alone = np.full(len(number), -1)
            began = time.process_time()
            label = link_tracklets(
                tracklets,
                alone,
                max_gap_s=settings.max_gap_s,
                log_odds=settings.log_odds,
                max_orbit_gap_s=settings.max_orbit_gap_s,
            ).label
            cost = 1e3 * (time.process_time() - began) / len(number)
            found, purity, mixed, groups, each = judge(label, number)
            print(
                f"| {count} | {len(number):,} | {100 * found:.1f} | {100 * purity:.2f} "
                f"| {mixed} of {groups:,} | {each:.2f} | {cost:.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
