"""CPU and memory of a night of many sensors, by stage, and what a unit of its data costs.

`python tests/benchmarks/bench_scaling.py [--sensors 8 32 128] [--hours 0.17] [--objects 60]`, or
`[--satellites 24 96 384] [--seconds 30]`. Each row is one `epipole run`, in its own process: of
`epipole simulate night`, or of `epipole simulate constellation`, two sensors and a log a satellite.
Needs Linux: the CPU of each stage is read from /proc at the log line that ends it.
"""

import argparse
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow.parquet as pq
from whole_runs import COMMAND, STAGES, whole_run

TABLES = ("frames", "stars", "detections", "associations", "positions")
TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")


class Night(NamedTuple):
    """CPU seconds of the stages and of all processes, memory [MiB], and rows of tables."""

    stages: dict[str, float]
    cpu_s: float
    mib: float
    rows: dict[str, int]
    bytes: int


def simulate(log: Path, scene: str, **numbers: float) -> None:
    """Write the log of a night, or the logs of a constellation in a folder."""
    options = [word for name, value in numbers.items() for word in (f"--{name}", str(value))]
    command = [*COMMAND, "simulate", scene, *options, "--out", str(log)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def run(log: Path, out: Path) -> Night:
    """Run the log once."""
    done = whole_run(log, out, STAGES, _cpu_s)
    size = sum(file.stat().st_size for file in out.rglob("*.parquet"))
    return Night(done.stages(), done.cpu_s, done.mib, _rows(out), size)


def _cpu_s(pid: int) -> float:
    """Return the CPU seconds of a process without its children."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) * TICK_S


def _rows(out: Path) -> dict[str, int]:
    return {
        name: sum(pq.read_metadata(file).num_rows for file in out.glob(f"night=*/{name}/*.parquet"))
        for name in TABLES
    }


def prices(night: Night) -> dict[str, float]:
    """Return what a unit costs [microseconds of CPU]: of each stage by what it works on."""
    rows, of = night.rows, night.stages
    return {
        "read, a centroid": 1e6 * of["read"] / (rows["stars"] + rows["detections"]),
        "identify, a frame": 1e6 * of["identify"] / rows["frames"],
        "identify, a star": 1e6 * of["identify"] / max(rows["stars"], 1),
        "track, a detection": 1e6 * of["track"] / rows["detections"],
        "solve, a detection": 1e6 * of["solve"] / rows["detections"],
        "solve, a view": 1e6 * of["solve"] / max(rows["associations"], 1),
        "solve, an object's epoch": 1e6 * of["solve"] / max(rows["positions"], 1),
        "publish, a row": 1e6 * of["publish"] / sum(rows.values()),
    }


def main() -> None:
    """Print the rows of the tables in BENCHMARKS.md."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--sensors", type=int, nargs="+", default=[8, 32, 128])
    arguments.add_argument("--objects", type=int, default=60)
    arguments.add_argument("--hours", type=float, default=0.17)
    arguments.add_argument("--satellites", type=int, nargs="+")
    arguments.add_argument("--seconds", type=float, default=30.0)
    arguments.add_argument("--prices", action="store_true", help="what a unit of the data costs")
    chosen: Any = arguments.parse_args()
    if chosen.satellites:
        scenes = {
            2 * n: ("constellation", {"satellites": n, "seconds": chosen.seconds})
            for n in chosen.satellites
        }
    else:
        scenes = {
            n: ("night", {"sensors": n, "objects": chosen.objects, "hours": chosen.hours})
            for n in chosen.sensors
        }
    print("| sensors | frames | detections | " + " | ".join(STAGES) + " | CPU s | MiB | disk MiB |")
    with tempfile.TemporaryDirectory() as folder:
        for sensors, (scene, numbers) in scenes.items():
            name = f"{sensors}" if chosen.satellites else f"{sensors}.mcap"
            log, out = Path(folder) / name, Path(folder) / f"out{sensors}"
            simulate(log, scene, **numbers)
            night = run(log, out)
            shutil.rmtree(log) if log.is_dir() else log.unlink()
            stages = " | ".join(f"{night.stages.get(name, 0.0):.1f}" for name in STAGES)
            print(
                f"| {sensors} | {night.rows['frames']:,} | {night.rows['detections']:,} | {stages} "
                f"| {night.cpu_s:.1f} | {night.mib:,.0f} | {night.bytes / 2**20:,.0f} |",
                flush=True,
            )
            for what, price in (prices(night) if chosen.prices else {}).items():
                print(f"{what:>26s}: {price:8.2f} us", flush=True)


if __name__ == "__main__":
    main()
