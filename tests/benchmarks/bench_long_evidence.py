"""Two sensors over ten minutes, end to end: objects of both sensors, and of one sensor only.

``python tests/benchmarks/bench_long_evidence.py [--seeds N] [--lone N] [--minutes N]
[--longest S ...] [--work DIR]`` simulates logs, runs them with and without evidence over more than
half a minute, and evaluates. There are twenty geostationary objects. Objects that only one sensor
sees are half way to these, and their motion in the image differs by 2"/s.
"""

import argparse
import json
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from epipole.schemas.arrays import Array
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.algorithms.orbits.orbit_fit import propagate
from epipole.tasks.algorithms.simulation.paths import state_at

GEO_KM = np.array([-39359.89, 15125.76, 64.30])
EARTH_RATE_RAD_S = np.array([0.0, 0.0, 7.2921159e-5])
V_GEO_KM_S = np.cross(EARTH_RATE_RAD_S, GEO_KM)
OBJECTS, SPREAD_KM = 20, 200.0
NEARER = (0.5, 0.62)  # ranges of the lone objects over those of the geostationary ones
SHORTEST_BASELINE_KM = 2500.0  # across the line of sight: no lone object is in both fields

SHOWN = ("pair_precision", "pair_recall", "groups", "ghosts", "positions", "nees_in_99")

HEAD = """
name = "lone"
start = 2019-04-01T04:00:00Z
duration_s = {duration_s}
seed = {seed}
[sensor_defaults]
magnitude_limit = 10.0
rate_hz = 0.5
camera = {{ width = 512, height = 512, fov_deg = 2.0 }}
detection = {{ sigma_px = 0.15, false_points = 2.0, star_drop = 0.05, target_drop = 0.05 }}
states = {{ prior_noise_arcsec = 20.0, prior_bias_arcsec = 30.0 }}
pointing = {{ mode = "track", orbit = {{ position_km = {r}, velocity_km_s = {v} }} }}
"""
SENSOR = """
[[sensors]]
id = "sat{number}"
orbit = {{ a_km = {a}, i_deg = {i}, raan_deg = {raan}, mean_anomaly_deg = {anomaly} }}
"""
TARGET = """
[[targets]]
orbit = {{ position_km = {r}, velocity_km_s = {v} }}
magnitude = {magnitude}
"""


def low_orbits(rng: np.random.Generator, duration_s: float) -> list[Array]:
    """Return the elements of two orbits from which the objects are always in view."""
    times_s = np.array([0.0, duration_s / 2, duration_s])
    toward = GEO_KM / np.linalg.norm(GEO_KM)
    orbits: list[tuple[Array, Array]] = []
    while len(orbits) < 2:
        angles = np.radians([rng.uniform(20, 100), rng.uniform(0, 360), 0, rng.uniform(0, 360)])
        elements = np.array([rng.uniform(6950, 7500), 0.0, *angles])
        path = np.array([state_at(elements, np.float64(t))[0] for t in times_s])
        apart = [np.cross(path - other, toward) for _, other in orbits]
        if (path @ toward > 2000).all() and all(
            np.linalg.norm(a, axis=1).min() > SHORTEST_BASELINE_KM for a in apart
        ):
            orbits.append((elements, path))
    return [elements for elements, _ in orbits]


def scene(seed: int, n_lone: int, duration_s: float) -> str:
    """Return a scene as TOML."""
    rng = np.random.default_rng(seed)
    orbits = low_orbits(rng, duration_s)
    middle_s = duration_s / 2  # when all objects are near the middle of the fields
    followed = propagate(np.concatenate([GEO_KM, V_GEO_KM_S]), -middle_s)
    parts = [
        HEAD.format(
            duration_s=duration_s, seed=seed, r=followed[:3].tolist(), v=followed[3:].tolist()
        )
    ]
    for number, elements in enumerate(orbits):
        i, raan, _, anomaly = np.degrees(elements[2:]).tolist()
        parts.append(
            SENSOR.format(number=number + 1, a=float(elements[0]), i=i, raan=raan, anomaly=anomaly)
        )
    states = [
        np.concatenate(
            [
                GEO_KM + rng.normal(size=3) * SPREAD_KM,
                V_GEO_KM_S + rng.normal(size=3) * 0.02,
            ]
        )
        for _ in range(OBJECTS)
    ]
    for elements in orbits:
        r, v = state_at(elements, np.float64(middle_s))
        states += [lone(rng, r, v) for _ in range(n_lone)]
    for state in states:
        start = propagate(state, -middle_s)
        parts.append(
            TARGET.format(
                r=start[:3].tolist(), v=start[3:].tolist(), magnitude=float(rng.uniform(7, 9))
            )
        )
    return "".join(parts)


def lone(rng: np.random.Generator, r_km: Array, v_km_s: Array) -> Array:
    """Return the state of an object in the field of a sensor at r_km."""
    line = GEO_KM - r_km
    basis = tangent_basis(line / np.linalg.norm(line))
    u = line / np.linalg.norm(line) + rng.uniform(-1, 1, 2) * np.radians(0.9) @ basis
    share = rng.uniform(*NEARER)
    range_km = share * np.linalg.norm(line)
    drift = rng.normal(size=2) * 2 * ARCSEC @ basis
    return np.concatenate(
        [
            r_km + range_km * u / np.linalg.norm(u),
            v_km_s + share * (V_GEO_KM_S - v_km_s) + range_km * drift,
        ]
    )


def epipole(*arguments: str | Path) -> str:
    """Run a command and return what it prints."""
    command = ["epipole", *map(str, arguments)]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def main() -> None:
    """Print pair precision and recall with and without longer evidence, scene by scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3, help="scenes")
    parser.add_argument(
        "--lone", type=int, default=100, help="objects that only one sensor sees, per sensor"
    )
    parser.add_argument(
        "--work", type=Path, help="folder for logs and datasets; default: temporary"
    )
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--longest", type=float, nargs="+", default=[0.0, 600.0], help="seconds")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        work = args.work or Path(folder)
        work.mkdir(parents=True, exist_ok=True)
        for seed in range(1, args.seeds + 1):
            log, toml = work / f"{seed}.mcap", work / f"{seed}.toml"
            toml.write_text(scene(seed, args.lone, 60.0 * args.minutes))
            epipole("simulate", toml, "--out", log)
            for longest_s in args.longest:
                settings = work / f"{longest_s:.0f}.toml"
                settings.write_text(f"[association]\nmax_window_s = {longest_s}\n")
                out = work / f"{seed}-{longest_s:.0f}"
                epipole("run", log, "--out", out, "--settings", settings)
                report = json.loads(epipole("evaluate", out, "--truth", f"{log}.truth", "--json"))
                shown = ", ".join(f"{name} {report[name]:.4f}" for name in SHOWN)
                print(f"seed {seed}, up to {longest_s:.0f} s: {shown}", flush=True)


if __name__ == "__main__":
    main()
