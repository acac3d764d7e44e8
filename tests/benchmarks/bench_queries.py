"""How long queries over a year of positions take, in polars, as a user writes them.

    python tests/benchmarks/bench_queries.py [--nights 365] [--rows 100000] [--keep DIR]

Publishes the nights as a run does: objects near geostationary altitude, with a position at every
epoch of a night and errors of a kilometre. Times are wall and CPU seconds (all threads), medians of
several runs in turns, with the files in the page cache.
"""

import argparse
import datetime
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl
import pyarrow as pa

from epipole.io.datasets.dataset import nights_in
from epipole.schemas.bridge import table
from epipole.schemas.tables import SOURCES, TABLES

sys.path.append(str(Path(__file__).parents[1]))  # helpers beside the tests

from scenes.published import publish

FIRST_DAY = 17897  # 2019-01-01
DAY_NS = 86_400_000_000_000
SIDEREAL_DAY_S = 86164.0905
OBJECTS = 1000
POINT_KM = (30000.0, 29620.0, 0.0)  # in the geostationary belt: objects pass it every night
WITHIN_KM = 50.0
NIGHT = datetime.date(2019, 1, 10)
OBJECT = "20190110-00037"


def positions(day: int, n_rows: int) -> pa.Table:
    """Return the positions of a night: each object at each of its epochs."""
    orbits, rng = np.random.default_rng(0), np.random.default_rng(day)
    longitude, tilt = (
        orbits.uniform(0, 2 * np.pi, OBJECTS),
        np.radians(orbits.normal(0, 2, OBJECTS)),
    )
    radius_km = 42164 + orbits.normal(0, 20, OBJECTS)
    seconds = np.sort(rng.uniform(0, 86400, n_rows // OBJECTS))[:, None]
    angle = longitude + 2 * np.pi * (seconds + (day - FIRST_DAY) * 86400) / SIDEREAL_DAY_S
    in_plane = radius_km * np.sin(angle)
    r_km = (radius_km * np.cos(angle), in_plane * np.cos(tilt), in_plane * np.sin(tilt))
    n = angle.size
    epoch = day * DAY_NS + np.repeat((seconds[:, 0] * 1e9).astype(np.int64), OBJECTS)
    date = (datetime.date(1970, 1, 1) + datetime.timedelta(days=day)).strftime("%Y%m%d")
    columns = {field.name: rng.lognormal(0, 1, n) for field in TABLES["positions"]}
    columns |= {
        f"{axis}_km": r.ravel() + rng.normal(0, 1, n) for axis, r in zip("xyz", r_km, strict=True)
    }
    columns |= {"epoch": epoch, "time": epoch - rng.integers(1e8, 1.4e8, n)}
    columns |= {name: rng.integers(2, 5, n) for name in ("n_sensors", "n_rejected")}
    names = [f"{date}-{i:05d}" for i in range(OBJECTS)] * (n // OBJECTS)
    return table(TABLES["positions"], columns | {"object_id": names})


def write_year(folder: Path, n_nights: int, n_rows: int) -> None:
    """Publish the nights that are missing."""
    there = set(nights_in(folder))
    for day in range(FIRST_DAY, FIRST_DAY + n_nights):
        night = (datetime.date(1970, 1, 1) + datetime.timedelta(days=day)).isoformat()
        if night not in there:
            tables = {"positions": positions(day, n_rows), "sources": SOURCES.empty_table()}
            publish(folder, tables, [night])


def one_object_of_a_night(scan: pl.LazyFrame) -> pl.LazyFrame:
    """Return where one object was."""
    return scan.filter(pl.col("night") == NIGHT, pl.col("object_id") == OBJECT)


def near_a_point(scan: pl.LazyFrame) -> pl.LazyFrame:
    """Return the positions near a point over the year, with all columns."""
    x, y, z = POINT_KM
    away2 = (pl.col("x_km") - x) ** 2 + (pl.col("y_km") - y) ** 2 + (pl.col("z_km") - z) ** 2
    return scan.filter(away2 < WITHIN_KM**2)


def objects_near_a_point(scan: pl.LazyFrame) -> pl.LazyFrame:
    """Return the objects near a point over the year, with time and position."""
    return near_a_point(scan).select("epoch", "object_id", "x_km", "y_km", "z_km")


def ten_minutes_of_a_night(scan: pl.LazyFrame) -> pl.LazyFrame:
    """Return all objects over ten minutes."""
    start = datetime.datetime.combine(NIGHT, datetime.time(4), datetime.UTC)
    end = start + datetime.timedelta(minutes=10)
    return scan.filter(pl.col("night") == NIGHT, pl.col("epoch").is_between(start, end))


QUERIES: dict[str, tuple[Callable[[pl.LazyFrame], pl.LazyFrame], float]] = {
    "one object of one night": (one_object_of_a_night, 0.1),
    "within 50 km of a point, all nights: object, time and place": (objects_near_a_point, 0.5),
    "within 50 km of a point, all nights: all columns": (near_a_point, 0.5),
    "ten minutes of a night": (ten_minutes_of_a_night, 0.05),
}


def main() -> None:
    """Print the rows of the table in BENCHMARKS.md."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--nights", type=int, default=365)
    arguments.add_argument("--rows", type=int, default=100_000, help="positions per night")
    arguments.add_argument("--runs", type=int, default=7)
    arguments.add_argument("--keep", metavar="DIR", help="write the year here and keep it")
    chosen = arguments.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(chosen.keep or temporary) / "year"
        started = time.process_time()
        write_year(folder, chosen.nights, chosen.rows)
        size = sum(part.stat().st_size for part in folder.glob("night=*/positions/*.parquet"))
        print(f"{chosen.nights} nights of {chosen.rows:,} positions, {size / 1e9:.2f} GB")
        print(f"written in {time.process_time() - started:.0f} s of CPU")
        ask(f"{folder}/night=*/positions/*.parquet", chosen.runs)


def ask(path: str, runs: int) -> None:
    """Print the time of each query."""
    wall_s: dict[str, list[float]] = {name: [] for name in QUERIES}
    cpu_s: dict[str, list[float]] = {name: [] for name in QUERIES}
    rows = {}
    for run in range(runs + 1):
        for name, (query, _) in QUERIES.items():
            wall, cpu = time.perf_counter(), time.process_time()
            rows[name] = len(query(pl.scan_parquet(path, hive_partitioning=True)).collect())
            if run:  # the first brings the files into memory
                wall_s[name].append(time.perf_counter() - wall)
                cpu_s[name].append(time.process_time() - cpu)
    print("| query | rows | wall s | least wall s | CPU s | goal s |")
    for name, (_, goal_s) in QUERIES.items():
        wall, cpu = statistics.median(wall_s[name]), statistics.median(cpu_s[name])
        print(
            f"| {name} | {rows[name]:,} | {wall:.3f} | {min(wall_s[name]):.3f} | {cpu:.3f} "
            f"| {goal_s} |"
        )


if __name__ == "__main__":
    main()
