"""Star catalogues: what building one for a sensor costs, and what a deep one gives narrow fields.

    python tests/benchmarks/bench_catalogue.py [build] [narrow] [--seeds 1 2 3] [--repeats 5]

build: CPU time to the stars of a day, their grid and their pairs for four cameras, made and read
from disk. narrow: simulated 2 degree fields of Gaia's stars to V 10 (512 px, a new attitude in
every frame, no prior, no stated centroid error), identified with the deep catalogue and with
Hipparcos; wrong: boresight more than 6' off. Needs the extra `deep`.
"""

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pyarrow as pa
from night_stages import see

from epipole.flows.simulate import simulate
from epipole.io.catalogues.hipparcos import read_hipparcos
from epipole.io.catalogues.star_catalogue import write_star_catalogue
from epipole.schemas.bridge import array
from epipole.schemas.given_settings import validate_settings
from epipole.schemas.scene import validate_scene
from epipole.tasks.algorithms.star_identification.frame import FieldOfView
from epipole.tasks.catalogue import build_deep_catalogue
from epipole.tasks.identify import cache_skies
from epipole.tasks.identify.cache_skies import CachedSkies, Catalogue

# Catalogue, field [degrees], pixels along it, centroids a frame.
CAMERAS = (
    ("hipparcos", 20.3, 1024, 15),
    ("hipparcos", 8.0, 1024, 60),
    ("hipparcos", 2.0, 512, 20),
    ("deep", 2.0, 512, 50),
)
MADE = {"hipparcos": read_hipparcos, "deep": build_deep_catalogue}
NOISE = {
    "0.15 px, 2 false, 5 % missing": {"sigma_px": 0.15, "false_points": 2.0, "star_drop": 0.05},
    "0.5 px, 10 false, 20 % missing": {"sigma_px": 0.5, "false_points": 10.0, "star_drop": 0.2},
}
DAY = 18_000


def cpu_ms(work: Callable[[], Any]) -> float:
    started = time.process_time()
    work()
    return 1e3 * (time.process_time() - started)


def bench_build(folder: Path, repeats: int, only: list[str]) -> None:
    made = {name: make for name, make in MADE.items() if name in only}
    tables = {}
    for name, make in made.items():
        took = [cpu_ms(lambda: tables.update({name: make()})) for _ in range(repeats)]  # noqa: B023
        print(f"{name}: {tables[name].num_rows} stars, table made in {np.median(took):.0f} ms")
    print("| catalogue, field | stars, pairs | made: stars, grid, pairs ms | from disk ms |")
    for name, field, pixels, centroids in (camera for camera in CAMERAS if camera[0] in made):
        catalogue, costs = Catalogue(tables[name]), []
        for disk in ("off", str(folder / "cache")):
            os.environ["EPIPOLE_CACHE"] = disk
            rows = [sky_cost(catalogue, field, pixels, centroids) for _ in range(repeats + 1)]
            stars, grid, pairs, *counts = np.median(rows[1:], axis=0)  # the first fills the disk
            costs.append(f"{stars:.0f}, {grid:.0f}, {pairs:.0f}")
        sizes = ", ".join(f"{count:,.0f}" for count in counts)
        print(f"| {name}, {field:g} degrees | {sizes} | {costs[0]} | {costs[1]} |")


def sky_cost(catalogue: Catalogue, field: float, pixels: int, centroids: int) -> tuple[float, ...]:
    """Return CPU ms for stars, grid and pairs of a camera, and how many stars and pairs."""
    for kept in ("_navigation", "_sky", "_grid", "_pairs"):
        getattr(cache_skies, kept).cache_clear()
    half = np.tan(np.radians(field / 2))
    box = np.array([-half, half, -half, half])
    pixel = np.radians(field) / pixels
    optics = FieldOfView(float(np.arctan(half * np.sqrt(2))), box, pixel)
    skies = CachedSkies(catalogue, DAY, pixel, 2.0)
    stars = cpu_ms(lambda: skies.limit_for(centroids / optics.solid_angle_sr))
    limit = skies.limit_for(centroids / optics.solid_angle_sr)
    grid = cpu_ms(lambda: skies.grid(limit, 5 * pixel))
    pairs = cpu_ms(lambda: skies.pairs(limit, optics))
    seen = skies.sky(limit).catalogue.star_id
    return stars, grid, pairs, len(seen), len(skies.pairs(limit, optics).first)


def bench_narrow(folder: Path, seeds: list[int]) -> None:
    deep = folder / "deep.parquet"
    write_star_catalogue(deep, build_deep_catalogue())
    log = folder / "first.mcap"
    simulate(validate_scene(_scene({}, deep, 0) | {"duration_s": 5.0}, "first"), log)
    see(log, validate_settings({}, "bench"))  # kernels compiled
    print("noise, catalogue: frames, by stars, wrong, stars a frame, CPU ms a frame")
    for noise, detection in NOISE.items():
        for which in (str(deep), "hipparcos"):
            settings = validate_settings({"identification": {"catalogue": which}}, "bench")
            n = by_stars = wrong = stars = 0
            spent = 0.0
            for seed in seeds:
                log = folder / f"narrow-{seed}.mcap"
                simulate(validate_scene(_scene(detection, deep, seed), "narrow"), log)
                started = time.process_time()
                seen = see(log, settings)
                spent += time.process_time() - started
                found = array(seen.solutions, "attitude_source") == "stars"
                off = _boresight_error(seen.solutions, Path(f"{log}.truth"))
                n, by_stars = n + len(found), by_stars + int(found.sum())
                wrong += int(np.sum(off[found] > 0.1))
                stars += int(array(seen.solutions, "n_stars")[found].sum())
            name = "deep" if which == str(deep) else which
            print(
                f"{noise}, {name}: {n}, {100 * by_stars / n:.1f} %, {wrong}, "
                f"{stars / max(by_stars, 1):.1f}, {1e3 * spent / n:.0f}"
            )


def _scene(detection: dict[str, float], deep: Path, seed: int) -> dict[str, Any]:
    sensor = {
        "id": "narrow",
        "orbit": {"random": "leo"},
        "magnitude_limit": 10.0,
        "camera": {"width": 512, "height": 512, "fov_deg": 2.0},
        "detection": detection | {"send_sigma": False},
        "pointing": {"mode": "random", "clear_of_earth_deg": 15.0},
    }
    scene = {"name": "narrow", "duration_s": 100.0, "seed": seed, "catalogue": str(deep)}
    return scene | {"sensors": [sensor]}


def _boresight_error(solutions: pa.Table, truth: Path) -> np.ndarray:
    """Return how far each frame's boresight is off [degrees]."""
    true = pl.read_parquet(truth / "frames.parquet").sort("frame_number")
    rows = np.searchsorted(true["frame_number"].to_numpy(), array(solutions, "frame_number"))
    x, y, z, w = (true[f"q{a}"].to_numpy()[rows] for a in "xyzw")
    u = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    ra, dec = (np.radians(array(solutions, name).astype(float)) for name in ("ra_deg", "dec_deg"))
    found = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    return np.degrees(2 * np.arcsin(np.linalg.norm(u - found, axis=1) / 2))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", default=["build", "narrow"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--repeats", type=int, default=5, help="of build")
    parser.add_argument("--only", nargs="+", choices=MADE, default=list(MADE), help="of build")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if "build" in arguments.parts:
            bench_build(Path(folder), arguments.repeats, arguments.only)
        if "narrow" in arguments.parts:
            bench_narrow(Path(folder), arguments.seeds)


if __name__ == "__main__":
    main()
