"""Time and memory of a whole night, by stage, and how they grow with the length of the night.

`python tests/benchmarks/bench_night.py [--shares 16 4 1] [--hours 11.4]`. Each row is
one `epipole run` of a simulated log, in its own process and with cached kernels: 4 sensors at 5 Hz
with about 25 centroids per frame.
"""

import argparse
import subprocess
import sys
import tempfile
import time
import tomllib
from datetime import datetime
from pathlib import Path

from whole_runs import STAGES, whole_run

SCENES = Path(__file__).parents[2] / "io" / "simulation" / "built_in"
HOURS = 11.4  # of the whole night; the Earth hides the field of view for a third of it
TOLD_APART = {name: begins for name, begins in STAGES.items() if name != "check"}
EMPTY_TASKS = """
import statistics, sys, time
from prefect import flow, task
from prefect.cache_policies import NO_CACHE
from epipole.flows.prefect.defaults import embedded_prefect, quiet_console
@task(cache_policy=NO_CACHE)
def nothing(k):
    return k
@flow
def many(n):
    [f.result() for f in [nothing.submit(k) for k in range(n)]]
quiet_console()
with embedded_prefect():
    many(3)
    cpu, wall = [], []
    for _ in range(5):
        for n in (0, int(sys.argv[1])):
            started = time.process_time(), time.monotonic()
            many(n)
            cpu.append(time.process_time() - started[0])
            wall.append(time.monotonic() - started[1])
for seconds in (cpu, wall):
    print(statistics.median(b - a for a, b in zip(seconds[::2], seconds[1::2])))
"""


def simulate_night(log: Path, hours: float) -> None:
    """Write a log of four sensors, three objects, twenty stars and two false points per frame."""
    from epipole.flows.simulate import simulate
    from epipole.schemas.scene import validate_scene

    scene = tomllib.loads((SCENES / "night.toml").read_text())
    scene["start"] = datetime.fromisoformat("2019-04-01T06:00:00+00:00")
    scene["duration_s"] = hours * 3600
    (sensors,) = scene["sensors"]
    sensors |= {"count": 4, "rate_hz": 5.0, "magnitude_limit": 7.15}
    sensors["detection"] |= {"false_points": 2.0, "hot_pixels": 0}
    scene["targets"][0]["count"] = 3
    simulate(validate_scene(scene, "night"), log)


def run(log: Path, out: Path) -> dict[str, float]:
    """Return the seconds of each stage of a run, its total CPU seconds, and its memory [MiB]."""
    started = time.monotonic()
    done = whole_run(log, out, TOLD_APART, lambda _: time.monotonic() - started)
    return {
        **done.stages(),
        "night": done.at["publish"] - done.at["find"],
        "all": time.monotonic() - started,
        "cpu": done.cpu_s,
        "mib": done.mib,
        "frames": done.summary["frames"],
        "positions": done.summary["positions"],
    }


def prefect_share(n_tasks: int) -> tuple[float, float]:
    """Return the CPU and wall seconds of this many tasks that do nothing."""
    done = subprocess.run(
        [sys.executable, "-c", EMPTY_TASKS, str(n_tasks)],
        check=True,
        capture_output=True,
        text=True,
    )
    cpu, wall = done.stdout.split()[-2:]
    return float(cpu), float(wall)


def main() -> None:
    """Print the rows of the tables in BENCHMARKS.md."""
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--shares", type=int, nargs="+", default=[16, 4, 1])
    arguments.add_argument("--hours", type=float, default=HOURS)
    chosen = arguments.parse_args()
    columns = [
        "find",
        "read",
        "identify",
        "track",
        "solve",
        "name",
        "publish",
        "night",
        "cpu",
        "mib",
    ]
    print("| night | frames | " + " | ".join(columns) + " | us per frame |")
    with tempfile.TemporaryDirectory() as folder:
        where = Path(folder)
        for share in chosen.shares:
            log = where / f"night{share}.mcap"
            simulate_night(log, chosen.hours / share)
            got = run(log, where / f"out{share}")
            values = [f"{got[name]:.1f}" for name in columns]
            per_frame = f"{got['cpu'] / got['frames'] * 1e6:.0f}"
            print(f"| 1/{share} | {got['frames']:,} | " + " | ".join([*values, per_frame]) + " |",
                  flush=True)  # fmt: skip
            log.unlink()
    spans = int(chosen.hours * 2) + 1
    n_tasks = spans * (4 + 4 + 1) + 3 * 4
    cpu, wall = prefect_share(n_tasks)
    print(f"{n_tasks} tasks that do nothing: {cpu:.2f} s CPU, {wall:.2f} s wall")


if __name__ == "__main__":
    main()
