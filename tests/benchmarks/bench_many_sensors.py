"""Association of many sensors: CPU time and peak memory per sample.

``python tests/benchmarks/bench_many_sensors.py [TABLE ...] [--sensors N ...]``, tables: ring, low,
flood.

Ring: low sensors that look at the same 60 geostationary objects, each seen by about 70 % of them.
Low: sensors at 1,200 km that look down, at objects below; each field meets a few others. Flood: one
of the sensors of the ring has thousands of unrelated tracklets. Each case runs in a process of its
own. Memory is what association adds to the peak, above the samples.
"""

import argparse
import multiprocessing
import resource
import time
from typing import NamedTuple

import numpy as np
from bench_association import associate

from epipole.tasks.algorithms.association.samples import Samples
from epipole.tasks.algorithms.constants import ARCSEC, EARTH_RADIUS_KM, GM_KM3_S2
from epipole.tasks.algorithms.geometry.directions import tangent_basis

SENSORS = (8, 32, 128, 512, 2000)
TIMES_S = np.array([2.0, 12.0, 22.0])  # instants of a window of 30 s, as a run samples it
NOISE_RAD = ARCSEC
PLACE_KM = 0.02
GEO_KM = 42164.2
RING = np.array([-0.9333, 0.3588, 0.0])  # towards the part of the ring that all look at


class Case(NamedTuple):
    """Samples, and the object of each tracklet (-1: unrelated)."""

    samples: Samples
    who: np.ndarray


def circular(rng: np.random.Generator, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (n, k, 3): positions and velocities on circular orbits through points r (n, 3)."""
    radius = np.linalg.norm(r, axis=1, keepdims=True)
    out = r / radius
    along = np.cross(rng.normal(size=r.shape), out)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    turn = (np.sqrt(GM_KM3_S2 / radius**3) * (TIMES_S - TIMES_S.mean()))[:, :, None]
    path = radius[:, None] * (np.cos(turn) * out[:, None] + np.sin(turn) * along[:, None])
    speed = np.sqrt(GM_KM3_S2 / radius)[:, None]
    return path, speed * (np.cos(turn) * along[:, None] - np.sin(turn) * out[:, None])


def ring(seed: int, n_sensors: int, n_objects: int = 60, n_lone: int = 2, flood: int = 0) -> Case:
    """Return low sensors that look at geostationary objects, seen by 70 % of the sensors each.

    Every sensor has `n_lone` unrelated tracklets; the first one `flood` more.
    """
    rng = np.random.default_rng(seed)
    out = rng.normal(size=(20 * n_sensors, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    r, v = circular(rng, 7000.0 * out[out @ RING > 0.3][:n_sensors])
    start = GEO_KM * RING + rng.normal(size=(n_objects, 3)) * 200.0
    w = np.array([0.0, 0.0, 7.2921e-5])
    v_objects = np.cross(w, start) + rng.normal(size=(n_objects, 3)) * 0.02
    ahead = (TIMES_S - TIMES_S.mean())[:, None]
    x = start[:, None] + v_objects[:, None] * ahead - start[:, None] * ahead**2 * 2.7e-9
    look = GEO_KM * RING - r
    seen = rng.random((n_sensors, n_objects)) < 0.7
    lone = np.full(n_sensors, n_lone)
    lone[0] += flood
    return sampled(rng, (r, v, look), (x, v_objects), seen, lone, np.radians(1.0))


def low(seed: int, n_sensors: int, most: int = 2000) -> Case:
    """Return sensors that look down, on a part of the globe that grows with their number."""
    rng = np.random.default_rng(seed)
    share = n_sensors / most
    half = np.radians(20.0)

    def spread(n: int, radius: np.ndarray) -> np.ndarray:
        z, turn = 1 - 2 * share * rng.random(n), rng.uniform(0, 2 * np.pi, n)
        across = np.sqrt(1 - z * z)
        return radius[:, None] * np.column_stack([across * np.cos(turn), across * np.sin(turn), z])

    r, v = circular(rng, spread(n_sensors, np.full(n_sensors, EARTH_RADIUS_KM + 1200.0)))
    n_objects = 16 * n_sensors
    x, v_objects = circular(
        rng, spread(n_objects, EARTH_RADIUS_KM + rng.uniform(400.0, 900.0, n_objects))
    )
    look = -r / np.linalg.norm(r, axis=2, keepdims=True)
    seen = np.zeros((n_sensors, n_objects), bool)
    for s in range(n_sensors):
        toward = x[:, 1] - r[s, 1]
        distance = np.linalg.norm(toward, axis=1)
        # Beyond this range is only what is behind the Earth.
        seen[s] = (toward @ look[s, 1] > np.cos(half) * distance) & (distance < 2000.0)
        seen[s] &= rng.random(n_objects) < 0.95
    return sampled(rng, (r, v, look), (x, v_objects[:, 1]), seen, np.full(n_sensors, 2), half)


def sampled(rng, sensors, objects, seen, lone, half) -> Case:
    """Return the samples of the tracklets.

    Parameters
    ----------
    sensors : tuple
        Positions and velocities of s sensors at k instants, and where they look, (s, k, 3).
    objects : tuple
        Positions of o objects, (o, k, 3), and velocities, (o, 3).
    seen : (s, o) bool
        Whether a sensor detects an object.
    lone : (s,) int
        Unrelated tracklets of each sensor.
    half : float
        Half the field's width [rad].
    """
    (r, v, look), (x, v_objects) = sensors, objects
    look = look / np.linalg.norm(look, axis=2, keepdims=True)
    sensor, who = np.nonzero(seen)
    u, moving = x[who] - r[sensor], v_objects[who][:, None] - v[sensor]
    stray = np.repeat(np.arange(len(r)), lone)
    if len(stray):  # they drift like the objects, a little differently
        off = rng.uniform(-half, half, (len(stray), 2)) / np.sqrt(2)
        rate = rng.normal(size=(len(stray), 2)) * 10 * ARCSEC
        step = off[:, None] + (TIMES_S - TIMES_S.mean())[:, None] * rate[:, None]
        far = np.linalg.norm(x[:, 1], axis=1).mean() - np.linalg.norm(r[stray], axis=2)
        basis = tangent_basis(look[stray])
        u = np.vstack([u, look[stray] + np.einsum("nka,nkai->nki", step, basis)])
        drift = -v[stray] / np.abs(far)[:, :, None]
        moving = np.vstack([moving, drift])
        sensor, who = np.append(sensor, stray), np.append(who, np.full(len(stray), -1))
    distance = np.linalg.norm(u, axis=2, keepdims=True)
    u = u / distance
    rate = (moving - np.sum(moving * u, axis=2, keepdims=True) * u) / distance
    noise = rng.normal(size=(*u.shape[:2], 2)) * NOISE_RAD
    u = u + np.einsum("nka,nkai->nki", noise, tangent_basis(u))
    u /= np.linalg.norm(u, axis=2, keepdims=True)
    n, k = u.shape[:2]
    order = np.argsort(sensor, kind="stable")
    samples = Samples(
        sensor=sensor[order],
        start_s=np.zeros(n),
        end_s=np.full(n, TIMES_S[-1] + 2.0),
        seen=np.ones((n, k), bool),
        u=u[order],
        cov=np.tile(np.eye(2) * NOISE_RAD**2, (n, k, 1, 1)),
        sigma_km=np.full((n, k), PLACE_KM),
        time_s=TIMES_S,
        sensor_km=r,
        R_sensor_from_icrs=np.concatenate([tangent_basis(look), look[:, :, None]], axis=2),
        half_field=np.full((len(r), 2), np.tan(half)),
        rate=rate[order],
        sensor_km_s=v,
    )
    return Case(samples, who[order])


def measure(kind: str, n_sensors: int, flood: int) -> None:
    """Associate one case and print a row."""
    associate(ring(1, 40, 5).samples)  # compiles, before the measurement
    case = low(0, n_sensors) if kind == "low" else ring(0, n_sensors, flood=flood)
    took = []
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(3 if n_sensors < 1000 else 1):
        begun = time.process_time()
        groups = associate(case.samples)
        took.append(time.process_time() - begun)
    more = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    n = int(case.samples.seen.sum())
    true, grouped, right = neighbour_score(case.who, groups.group)
    name = f"{kind}, {flood} more" if flood else kind
    print(
        f"{name} | {n_sensors} | {n:,} | {np.median(took):.3f} | {1e6 * np.median(took) / n:.2f} | "
        f"{more / 2**20:.0f} | {more / n:.0f} | {len(groups.score)} | "
        f"{100 * right / max(grouped, 1):.2f} | {100 * right / max(true, 1):.2f}",
        flush=True,
    )


def neighbour_score(who: np.ndarray, group: np.ndarray) -> tuple[int, int, int]:
    """Return how many pairs of tracklets are true, grouped, and both.

    Pairs of one object or group that follow each other in the order of the samples: as many as
    views, while all pairs would be their square.
    """

    def pairs(label: np.ndarray) -> np.ndarray:
        order = np.argsort(label, kind="stable")
        same = (label[order][1:] == label[order][:-1]) & (label[order][1:] >= 0)
        return np.column_stack([order[:-1][same], order[1:][same]])

    true, grouped = pairs(who), pairs(group)
    right = int((who[grouped[:, 0]] == who[grouped[:, 1]])[who[grouped[:, 0]] >= 0].sum())
    return len(true), len(grouped), right


def main() -> None:
    """Run the requested tables, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tables", nargs="*", default=["ring", "low", "flood"])
    parser.add_argument("--sensors", type=int, nargs="*", default=SENSORS)
    args = parser.parse_args()
    print(
        "scene | sensors | samples | CPU s | microseconds per sample | more memory MiB | bytes per "
        "sample | groups | precision % | recall %"
    )
    cases = [(kind, n, 0) for kind in ("ring", "low") if kind in args.tables for n in args.sensors]
    if "flood" in args.tables:
        cases += [("ring", n, flood) for n in (8, 128) for flood in (0, 1000, 5000)]
    spawn = multiprocessing.get_context("spawn")
    for case in cases:
        process = spawn.Process(target=measure, args=case)
        process.start()
        process.join()


if __name__ == "__main__":
    main()
