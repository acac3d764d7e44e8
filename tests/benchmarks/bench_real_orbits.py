"""Many scenes of real satellites: are the covariances honest, and how much is found?

    python tests/benchmarks/bench_real_orbits.py --low LOW.tle... --geo GEO.tle --scenes 20
        [--seed 1] [--kind geo|low] [--faulty 0.3] [--out FOLDER] [--only-simulate]

Each scene draws its hour (within half a day of the elements' epochs), satellites, fields (2 to 20
degrees), cadence (0.2 to 30 s), noise, and the biases of its sensors from the sigmas that they
report. `geo`: low sensors look at the geostationary ring. `low`: low sensors, and sometimes a
geostationary one, look at a place where low satellites cross. With --faulty, this share of the
scenes has one sensor whose states are off by more than its sigma says.

A scene is made from its number alone. Results are kept in FOLDER, so a run that is stopped goes
on. Scenes are independent, objects of one scene share the biases of its sensors: so means are over
scenes, and their errors come from the scatter of scenes.
"""

import argparse
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from epipole.flows.evaluate import evaluate
from epipole.flows.simulate import simulate
from epipole.io.simulation.scenes import read_element_sets
from epipole.schemas.errors import SceneError
from epipole.schemas.scene import validate_scene
from epipole.tasks.algorithms.simulation.element_sets import propagate

SECOND_NS = 1_000_000_000
EARTH_KM = 6378.0
LIMITS = [(2.0, 10.0), (4.0, 8.5), (8.0, 7.5), (12.0, 6.5), (20.0, 5.8)]  # field [deg], V
CADENCES_S = {"geo": [0.5, 1.0, 2.0, 5.0, 10.0, 30.0], "low": [0.2, 0.2, 0.5, 1.0]}
ATTEMPTS = 200

Rng = np.random.Generator


class Orbits:
    """The satellites of some files, and where they are."""

    def __init__(self, files: Sequence[str]) -> None:
        # A name that is no file on the disk is that of a built-in one.
        self.files = [str(p.resolve()) if (p := Path(file)).exists() else file for file in files]
        named = [(file, s) for file in self.files for s in read_element_sets(file)]
        self.file = [file for file, _ in named]
        self.sets = [element_set for _, element_set in named]
        self._elements = np.array([element_set.elements for element_set in self.sets])
        self.middle_ns = int(np.median([element_set.epoch_ns for element_set in self.sets]))

    def places(self, start: datetime, t_s: np.ndarray) -> np.ndarray:
        """Return (n, m, 3) GCRF [km]."""
        t0_ns = round(start.timestamp()) * SECOND_NS
        return propagate(self._elements, t0_ns + np.rint(t_s * SECOND_NS).astype(np.int64))[0]


def make_scene(number: int, low: Orbits, geo: Orbits, options: argparse.Namespace) -> Any:
    """Return the scene of this number, the same for the same files and options."""
    rng = np.random.default_rng([options.seed, number])
    for _ in range(ATTEMPTS):
        kind = options.kind or ("geo" if rng.random() < 0.5 else "low")
        try:
            values = geo_scene(rng, low, geo) if kind == "geo" else low_scene(rng, low, geo)
            values |= {
                "name": f"{kind}{number}",
                "seed": int(rng.integers(1 << 31)),
                "element_age_days": 30.0,
            }
            if rng.random() < options.faulty:
                _spoil(values, rng)
            return validate_scene(values, values["name"])
        except SceneError:
            continue  # no satellites where they are needed: another hour
    raise SystemExit(f"scene {number}: no hour has sensors where they are needed")


def _common(rng: Rng, kind: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return what scenes share, and what their sensors share."""
    field = float(np.exp(rng.uniform(math.log(2.0 if kind == "geo" else 8.0), math.log(20.0))))
    limit = float(np.interp(field, *zip(*LIMITS, strict=True)))
    cadence_s = float(rng.choice(CADENCES_S[kind]))
    duration_s = float(np.clip(60 * cadence_s, 120.0, 1800.0))
    states = {
        "position_noise_km": float(np.exp(rng.uniform(math.log(0.003), math.log(0.03)))),
        "position_bias_km": float(np.exp(rng.uniform(math.log(0.01), math.log(0.3)))),
    }
    if field < 5.0 or rng.random() < 0.4:  # few stars: the prior is needed
        states |= {
            "prior_noise_arcsec": float(rng.uniform(5.0, 30.0)),
            "prior_bias_arcsec": float(rng.uniform(5.0, 60.0)),
        }
    sensor = {
        "camera": {"width": 1024, "height": 1024, "fov_deg": field},
        "magnitude_limit": limit,
        "rate_hz": 1 / cadence_s,
        "detection": {
            "sigma_px": float(rng.uniform(0.08, 0.3)),
            "fade": 0.2,
            "false_points": float(rng.uniform(0.0, 5.0)),
            "star_drop": 0.05,
            "target_drop": 0.05,
        },
        "states": states,
    }
    return {"duration_s": duration_s}, sensor


def _start(rng: Rng, orbits: Orbits) -> datetime:
    middle = datetime.fromtimestamp(orbits.middle_ns // SECOND_NS, UTC)
    return middle + timedelta(seconds=int(rng.integers(-43200, 43200)))


def geo_scene(rng: Rng, low: Orbits, geo: Orbits) -> dict[str, Any]:
    """Return low sensors that follow a geostationary object."""
    scene, sensor = _common(rng, "geo")
    start = _start(rng, geo)
    followed = geo.sets[int(rng.integers(len(geo.sets)))]
    at_ring = geo.sets.index(followed)
    t_s = np.linspace(0.0, scene["duration_s"], 2 + int(scene["duration_s"] / 60))
    place = geo.places(start, t_s)[at_ring]
    near = np.flatnonzero(_all_visible(low.places(start, t_s), place[None], 500.0, 60000.0))
    n = int(rng.integers(3, 9))
    limit = sensor["magnitude_limit"]
    target = {"standard_magnitude": [limit - 10.4, limit - 8.0]}  # 7.9 fainter at the ring
    return scene | {
        "start": start,
        "sensors": _carried(low, near, n, rng, sensor, {"target": str(followed.number)}),
        "targets": [target | {"orbit": {"elements": file}} for file in geo.files],
    }


def low_scene(rng: Rng, low: Orbits, geo: Orbits) -> dict[str, Any]:
    """Return low sensors, and at times a geostationary one, that follow a place among low ones."""
    scene, sensor = _common(rng, "low")
    start = _start(rng, low)
    t_s = np.linspace(0.0, scene["duration_s"], 7)
    places = low.places(start, t_s)
    high = np.flatnonzero(np.linalg.norm(places[:, 3], axis=1) > EARTH_KM + 1000.0)
    place = places[rng.choice(high if len(high) else np.arange(len(places))), 3]
    near = np.flatnonzero(_all_visible(places, place[None], 500.0, 3500.0))
    place_km = [round(float(value), 1) for value in place]
    n = int(rng.integers(3, 8))
    sensors = _carried(low, near, n, rng, sensor, {"place_km": place_km})
    limit = sensor["magnitude_limit"]
    if rng.random() < 0.3:
        far = np.flatnonzero(_all_visible(geo.places(start, t_s), place[None], 0.0, 60000.0))
        deep = sensor | {"object_limit": limit + 7.7}
        one = _carried(geo, far, 1, rng, deep, {"place_km": place_km})
        sensors += [{**one[0], "id": "g1"}]
    target = {"standard_magnitude": [limit - 3.0, limit - 1.0]}
    return scene | {
        "start": start,
        "sensors": sensors,
        "targets": [target | {"orbit": {"elements": file}} for file in low.files],
    }


def _all_visible(r_km: np.ndarray, place: np.ndarray, least: float, most: float) -> np.ndarray:
    """Return which satellites (n, m, 3) always see a place (1, m, 3) or (1, 3) in this range."""
    d = np.broadcast_to(place, r_km.shape) - r_km
    distance = np.linalg.norm(d, axis=2)
    along = np.clip(-np.einsum("nmi,nmi->nm", r_km, d) / np.maximum(distance, 1.0) ** 2, 0.0, 1.0)
    clear = np.linalg.norm(r_km + along[:, :, None] * d, axis=2) > EARTH_KM + 50.0
    return (clear & (distance > least) & (distance < most)).all(axis=1)


def _carried(
    orbits: Orbits, rows: np.ndarray, n: int, rng: Rng, sensor: Any, pointing: Any
) -> list[dict[str, Any]]:
    """Return sensors on n of the satellites."""
    if len(rows) < n:
        raise SceneError("too few satellites")
    return [
        sensor
        | {
            "id": f"s{k + 1}",
            "orbit": {"elements": orbits.file[row], "satellites": [orbits.sets[row].number]},
            "pointing": pointing | {"roll_deg": float(rng.uniform(0.0, 360.0))},
        }
        for k, row in enumerate(rng.permutation(rows)[:n].tolist())
    ]


def _spoil(values: dict[str, Any], rng: Rng) -> None:
    """Give one sensor an error that its sigma does not tell."""
    k = int(rng.integers(len(values["sensors"])))
    if rng.random() < 0.5:
        fault: dict[str, Any] = {"faults": {"position_offset_km": float(rng.uniform(0.5, 3.0))}}
    else:
        fault = {"clock_offset_s": float(rng.uniform(0.05, 0.5))}
    values["sensors"][k] = values["sensors"][k] | fault


def run_scene(number: int, low: Orbits, geo: Orbits, options: argparse.Namespace) -> dict[str, Any]:
    """Simulate a scene, run the pipeline on it, and return the figures of its evaluation."""
    scene = make_scene(number, low, geo, options)
    log = options.out / f"{number:04d}.mcap"
    made = simulate(scene, log)
    if options.only_simulate:
        return {}
    with tempfile.TemporaryDirectory() as folder:
        began, used = time.perf_counter(), os.times()
        command = [shutil.which("epipole") or "epipole", "run", str(log), "--out", folder]
        done = subprocess.run([*command, "--quiet"], capture_output=True, text=True)
        cpu_s = sum(os.times()[2:4]) - sum(used[2:4])
        wall_s = time.perf_counter() - began
        report = evaluate(folder, made.truth).as_dict() if done.returncode == 0 else {}
    sensor = scene.sensors[0]
    facts = {
        "scene": scene.name,
        "sensors": made.sensors,
        "fov_deg": round(sensor.camera.fov_deg or 0.0, 1),
        "cadence_s": 1 / sensor.rate_hz,
        "bias_km": round(sensor.states.position_bias_km, 3),
        "cpu_s": round(cpu_s, 1),
        "wall_s": round(wall_s, 1),
        "error": done.stderr.strip()[-300:] if done.returncode else "",
    }
    return facts | report


COLUMNS = (
    "scene", "sensors", "fov_deg", "cadence_s", "bias_km", "wall_s", "object_recall", "ghosts",
    "id_swaps", "objects_seen_by_two", "positions", "nees_mean", "nees_in_99", "states",
    "states_nees_mean", "states_in_99",
)  # fmt: skip


def pooled(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures of all scenes together: sums, and means over scenes with their errors."""
    out: dict[str, Any] = {"scenes": len(results), "failed": sum(bool(r["error"]) for r in results)}
    for name in ("positions", "states", "objects_seen_by_two", "objects_lost", "ghosts",
                 "id_swaps", "att_wrong"):  # fmt: skip
        out[name] = sum(r.get(name) or 0 for r in results)
    for name, weight in (("nees_in_99", "positions"), ("states_in_99", "states"),
                         ("object_recall", "positions")):  # fmt: skip
        pairs = [(r[name], r[weight]) for r in results if r.get(name) is not None and r.get(weight)]
        share, count = np.array(pairs).T if pairs else (np.ones(0), np.ones(0))
        out[name] = _round(np.average(share, weights=count)) if pairs else None
    for name in ("nees_mean", "states_nees_mean"):
        values = np.array([r[name] for r in results if r.get(name) is not None])
        if len(values):
            out[name] = _round(values.mean())
            error = values.std(ddof=1) / len(values) ** 0.5 if len(values) > 1 else math.inf
            out[f"{name}_error"] = _round(error)
            out[f"{name}_median"] = _round(np.median(values))
    return out


def _round(value: float) -> float:
    return round(float(value), 4)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--low", nargs="+", default=["real_leo.tle", "real_sensors.tle"])
    parser.add_argument("--geo", nargs="+", default=["real_geo.tle"])
    parser.add_argument("--scenes", type=int, default=10)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kind", choices=("geo", "low"))
    parser.add_argument("--faulty", type=float, default=0.0)
    parser.add_argument("--out", type=Path, default=Path("real_orbits"))
    parser.add_argument("--only-simulate", action="store_true")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    low, geo = Orbits(options.low), Orbits(options.geo)
    results = []
    print(" ".join(f"{name[:12]:>12}" for name in COLUMNS))
    for number in range(options.first, options.first + options.scenes):
        kept = options.out / f"{number:04d}.json"
        if not kept.exists():
            result = run_scene(number, low, geo, options)
            if options.only_simulate:
                continue
            kept.write_text(json.dumps(result) + "\n")
        results.append(json.loads(kept.read_text()))
        row = (results[-1].get(name) for name in COLUMNS)
        print(" ".join(f"{_text(value):>12}" for value in row), file=sys.stdout, flush=True)
    if results:
        print(json.dumps(pooled(results), indent=1))


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
