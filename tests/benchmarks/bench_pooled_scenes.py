"""Random scenes of all kinds, pooled: what is joined wrongly, and are the covariances honest?

    python tests/benchmarks/bench_pooled_scenes.py --scenes 60 [--seed 1] [--first 0] [--out FOLDER]
                                                   [--unlike]

A third are constellations: satellites with two trackers each, fixed to the body. The others are
those of `bench_real_orbits.py`, geostationary or low, and half of these have one or two sensors at
fault, by ephemeris, clock or attitude. All are short. With --unlike, the sensors of a scene have
other optics, noise and rates each, and send less (`_unlike`); none of these is a constellation.

A scene is made from its number alone. Log, truth and dataset are kept in FOLDER, so a run that is
stopped goes on. A line for each scene, with what is wrong in it: ghosts, ids of several objects,
tracklets joined wrongly, states with a squared error of more than 60 times their covariance.
"""

import argparse
import json
import math
import shutil
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from bench_real_orbits import Orbits, geo_scene, low_scene
from whole_runs import whole_run

from epipole.flows.evaluate import evaluate
from epipole.flows.simulate import simulate
from epipole.io.datasets.dataset import nights_in, read_table
from epipole.io.simulation.truth import Truth, read_truth
from epipole.schemas.bridge import array, concat, stack, stack_covariance, to_polars
from epipole.schemas.errors import SceneError
from epipole.schemas.scene import validate_scene
from epipole.schemas.tables import TABLES
from epipole.tasks.algorithms.evaluation import squared_normalised_errors
from epipole.tasks.evaluate.matching import (
    blended_objects,
    detected_objects,
    locate_objects,
    match_estimates,
    match_positions,
    match_views,
)

FRAMES = 20  # of the slowest sensor, if they fit in the limits
LIMITS_S = (40.0, 240.0)
CHI2_999 = 16.266  # of three degrees of freedom
WRONG_STATE = 60.0  # squared error over covariance that no right state has
MANY_SENSORS = 5  # of these two may be at fault
NEAR_SATELLITES, SATELLITES = (8, 25), (30, 49)  # of a constellation; the last is not drawn
BLEND_PX = 2.0  # satellites that are nearer to each other are one spot
ATTEMPTS = 200
AXES = ("x", "y", "z", "vx", "vy", "vz")
MIDDLE = datetime(2026, 5, 30, 14, tzinfo=UTC)

Rng = np.random.Generator


def make_log(
    number: int, low: Orbits, geo: Orbits, seed: int, out: Path, unlike: bool
) -> tuple[str, Path]:
    """Simulate the scene of this number; return what it is, and its log."""
    rng = np.random.default_rng([seed, number])
    if number % 3 == 0 and not unlike:
        near = bool(rng.random() < 0.8)
        size = {
            "satellites": int(rng.integers(*(NEAR_SATELLITES if near else SATELLITES))),
            "near": near,
            "seconds": float(rng.uniform(40.0, 90.0)),
            "start": MIDDLE + timedelta(seconds=int(rng.integers(-43200, 43200))),
        }
        log = out / f"{number:04d}"
        simulate("constellation", log, seed=int(rng.integers(1 << 31)), **size)  # type: ignore[arg-type]
        kind = "near" if near else "apart"
        return f"{kind}{size['satellites']}", log
    log = out / f"{number:04d}.mcap"
    for _ in range(ATTEMPTS):
        kind = "geo" if rng.random() < 0.5 else "low"
        try:
            values = (geo_scene if kind == "geo" else low_scene)(rng, low, geo)
            if unlike:
                values["sensors"] = [_unlike(sensor, rng) for sensor in values["sensors"]]
            cadence_s = 1 / min(sensor["rate_hz"] for sensor in values["sensors"])
            values |= {
                "name": f"{kind}{number}",
                "seed": int(rng.integers(1 << 31)),
                "duration_s": float(np.clip(FRAMES * cadence_s, *LIMITS_S)),
                "element_age_days": 30.0,
            }
            for sensor in values["sensors"]:
                sensor["detection"] = sensor["detection"] | {"blend_px": BLEND_PX}
            faults = _spoil(values, rng) if number % 3 == 1 else []
            simulate(validate_scene(values, values["name"]), log)
        except SceneError:
            continue  # no satellites where they are needed: another hour
        return " ".join([f"{kind}{len(values['sensors'])}", *faults]), log
    raise SystemExit(f"scene {number}: no hour has sensors where they are needed")


def _unlike(sensor: dict[str, Any], rng: Rng) -> dict[str, Any]:
    """Return a sensor with other images, optics, noise and rates, of which it sends less."""
    width, height = int(rng.choice([512, 1024, 2048])), int(rng.choice([512, 1024, 1536]))
    camera = sensor["camera"] | {"width": width, "height": height}
    lens = rng.random()
    if lens < 0.2:
        camera["k1"] = float(rng.uniform(-0.3, 0.2))
    elif lens < 0.35:
        camera["fisheye"] = True
    if rng.random() < 0.25:
        cx_px, cy_px = rng.normal(0.0, 3.0, 2).tolist()
        focal = float(rng.normal(0.0, 0.003))
        camera["departure"] = {"focal": focal, "cx_px": cx_px, "cy_px": cy_px}
    if rng.random() < 0.15:
        camera["line_time_s"] = float(rng.uniform(0.0, 3e-5))
    detection = sensor["detection"] | {
        "sigma_px": float(np.exp(rng.uniform(math.log(0.05), math.log(0.8)))),
        "false_points": float(np.exp(rng.uniform(math.log(0.1), math.log(100.0)))),
        "faint_sigma_px": float(rng.choice([0.0, 0.0, 0.2, 0.5])),
        "flux_error": float(rng.uniform(0.02, 0.3)),
        "send_sigma": bool(rng.random() > 0.2),
        "send_flux": bool(rng.random() > 0.2),
    }
    states = sensor["states"] | {
        "send_velocity": bool(rng.random() > 0.15),
        "rate_hz": float(rng.choice([0.1, 0.5, 1.0, 10.0])),
    }
    rate_hz = sensor["rate_hz"] * float(rng.choice([0.5, 1.0, 1.0, 1.37, 2.0]))
    return sensor | {
        "camera": camera, "detection": detection, "states": states, "rate_hz": rate_hz,
    }  # fmt: skip


def _spoil(values: dict[str, Any], rng: Rng) -> list[str]:
    """Give one or two sensors an error that their sigma does not tell; return what it is."""
    sensors, faults = values["sensors"], []
    n = 2 if len(sensors) >= MANY_SENSORS and rng.random() < 0.5 else 1
    for k in rng.permutation(len(sensors))[:n].tolist():
        kind, has_prior = rng.random(), "prior_noise_arcsec" in sensors[k]["states"]
        if has_prior and kind < 0.3:
            size = round(float(rng.uniform(30.0, 120.0)))
            fault = {"faults": {"prior_offset_arcsec": float(size)}}
            faults.append(f"{sensors[k]['id']}:{size}arcsec")
        elif kind < 0.65:
            size_km = round(float(rng.uniform(0.5, 5.0)), 1)
            fault = {"faults": {"position_offset_km": size_km}}
            faults.append(f"{sensors[k]['id']}:{size_km}km")
        else:
            size_s = round(float(rng.uniform(0.05, 0.5)), 2)
            fault = {"clock_offset_s": size_s}  # type: ignore[dict-item]
            faults.append(f"{sensors[k]['id']}:{size_s}s")
        sensors[k] = sensors[k] | fault
    return faults


def judge(dataset: Path, truth_folder: Path) -> dict[str, Any]:
    """Return squared errors of positions and states, and what is joined wrongly."""
    truth = read_truth(truth_folder)
    points = to_polars(truth.points)
    nights = nights_in(str(dataset))  # two, where the scene goes on after midnight
    detections, associations, positions, states = (
        concat(TABLES[name], [read_table(str(dataset), name, night) for night in nights])
        for name in ("detections", "associations", "positions", "states")
    )
    views = match_views(
        to_polars(associations), detected_objects(to_polars(detections), points), points
    )
    matched = match_positions(positions, match_estimates(views))
    of, blended = matched["true_object"].to_numpy(), blended_objects(points)
    ids = matched["object_id"].to_list()
    seen: dict[str, list[int]] = {}
    for object_id, k in zip(ids, of.tolist(), strict=True):
        seen.setdefault(object_id, []).append(k)
    main = {object_id: max(set(ks), key=ks.count) for object_id, ks in seen.items()}
    real = (of >= 0) & ~np.isin(of, blended)
    r_km, _ = locate_objects(truth, of[real], array(positions, "time")[real])
    nees = squared_normalised_errors(
        stack(positions, "{}_km")[real] - r_km, stack_covariance(positions, "cov_{}")[real]
    )
    state_ids = states["object_id"].to_pylist()
    whose = np.array([main.get(i, -1) for i in state_ids], np.int64)
    judged = (whose >= 0) & ~np.isin(whose, blended)
    of_states = _state_errors(states, whose, judged, truth)
    judged_ids = [i for i, right in zip(state_ids, judged, strict=True) if right]
    return {
        "nees": np.round(nees, 3).tolist(),
        "state_nees": np.round(of_states, 3).tolist(),
        "ghost_ids": {i: ks.count(-1) for i, ks in seen.items() if -1 in ks},
        "mixed_ids": sorted(i for i, ks in seen.items() if len({k for k in ks if k >= 0}) > 1),
        "wrong_states": {
            i: round(value, 1)
            for i, value in zip(judged_ids, of_states.tolist(), strict=True)
            if not value < WRONG_STATE
        },
    }


def _state_errors(states: Any, whose: np.ndarray, judged: np.ndarray, truth: Truth) -> np.ndarray:
    if not judged.any():
        return np.zeros(0)
    r_km, v_km_s = locate_objects(truth, whose[judged], array(states, "epoch")[judged])
    mine = np.concatenate([stack(states, "{}_km"), stack(states, "v{}_km_s")], axis=1)[judged]
    error = mine - np.concatenate([r_km, v_km_s], axis=1)
    covariance = stack_covariance(states, "cov_{}", AXES)[judged]
    return squared_normalised_errors(error, covariance)


def run_scene(
    number: int, low: Orbits, geo: Orbits, seed: int, out: Path, unlike: bool
) -> dict[str, Any]:
    """Simulate a scene, run it, and return its figures."""
    what, log = make_log(number, low, geo, seed, out, unlike)
    dataset = out / f"{number:04d}.out"
    shutil.rmtree(dataset, ignore_errors=True)
    run = whole_run(log, dataset, {}, lambda _: 0.0)
    truth = Path(f"{log}.truth")
    report = evaluate(dataset, truth).as_dict()
    return {"what": what, "cpu_s": round(run.cpu_s, 1), **report, **judge(dataset, truth)}


def line(number: int, result: dict[str, Any]) -> str:
    """Return the line of a scene."""
    wrong = [
        f"{name} {result[name]}"
        for name in ("ghost_ids", "mixed_ids", "wrong_states", "joined_wrong", "objects_lost")
        if result.get(name)
    ]
    recall = result["object_recall"]
    found = (
        f"{math.nan if recall is None else recall:.3f} of {result['objects_seen_by_two'] or 0:3d}"
    )
    return (
        f"{number:4d} {result['what']:34s} {result['cpu_s']:5.0f} s"
        f" found {found}"
        f" positions {len(result['nees']):5d} {mean(result['nees'], 3):5.2f}"
        f" states {len(result['state_nees']):3d} {mean(result['state_nees'], 6):5.2f}"
        f"  {'; '.join(wrong)}"
    )


def mean(values: Iterable[float], axes: int) -> float:
    """Return the mean of squared errors over their number of axes, NaN without any."""
    numbers = np.array(list(values))
    return float(numbers.mean() / axes) if len(numbers) else math.nan


def pooled(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures of all scenes together."""
    nees = np.array([v for r in results for v in r["nees"]])
    of_states = np.array([v for r in results for v in r["state_nees"]])
    total = {
        name: sum(r.get(name) or 0 for r in results)
        for name in (
            *("ghosts", "id_swaps", "joined_wrong", "objects_seen_by_two", "objects_lost"),
            *("tracklets", "tracklets_false", "passages"),
        )
    }
    weights = np.array([r["objects_seen_by_two"] or 0 for r in results], float)
    recall = np.array([r.get("object_recall") or 0.0 for r in results])
    return {
        "scenes": len(results),
        "positions": len(nees),
        "their NEES / 3": round(mean(nees, 3), 3),
        "beyond 99.9 %": round(float(np.mean(nees > CHI2_999)), 5) if len(nees) else None,
        "states": len(of_states),
        "their NEES / 6": round(mean(of_states, 6), 3),
        "states over 60": int((of_states > WRONG_STATE).sum()),
        "object_recall": round(float(np.average(recall, weights=weights)), 4)
        if weights.any()
        else None,
        **total,
        "cpu_s": round(sum(r["cpu_s"] for r in results)),
    }


def main() -> None:
    """Print a line for each scene, and the pooled figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--low", nargs="+", default=["real_leo.tle", "real_sensors.tle"])
    parser.add_argument("--geo", nargs="+", default=["real_geo.tle"])
    parser.add_argument("--scenes", type=int, default=60)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--unlike", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("pooled_scenes"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    low, geo = Orbits(options.low), Orbits(options.geo)
    results = []
    for number in range(options.first, options.first + options.scenes):
        kept = options.out / f"{number:04d}.json"
        if not kept.exists():
            result = run_scene(number, low, geo, options.seed, options.out, options.unlike)
            kept.write_text(json.dumps(result) + "\n")
        results.append(json.loads(kept.read_text()))
        print(line(number, results[-1]), flush=True)
    print(json.dumps(pooled(results), indent=1))


if __name__ == "__main__":
    main()
