"""Whole runs of the example, and the commands that look at its dataset: wall and CPU seconds.

    python tests/benchmarks/bench_example.py [--rounds 3] [--cached] [--only TEXT]

Each is a process of its own. The first run has an empty cache: it copies the kernels of a wheel,
else it compiles. With --cached it is left out, with --only also the commands whose names do not
contain a text. CPU is that of the process and all that it starts.
"""

import argparse
import os
import resource
import statistics
import subprocess
import tempfile
import time
from pathlib import Path

from whole_runs import COMMAND

EXAMPLE = Path(__file__).parents[2] / "examples" / "four_sensor_geo.mcap"
NIGHT = "2019-04-01"


def measure(*arguments: str | Path) -> tuple[float, float]:
    """Return the wall and CPU seconds of a command of `epipole`."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    subprocess.run([*COMMAND, *map(str, arguments)], check=True, capture_output=True)
    wall, after = time.monotonic() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def row(name: str, times: list[tuple[float, float]]) -> None:
    """Print the medians of several times."""
    wall, cpu = (statistics.median(values) for values in zip(*times, strict=True))
    print(f"| {name} | {wall:.2f} | {cpu:.2f} |", flush=True)


def main() -> None:
    """Print a row for each command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--cached", action="store_true", help="without the first run")
    parser.add_argument("--only", default="", help="commands whose names contain this")
    chosen = parser.parse_args()
    print("| what | wall s | CPU s |\n|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        out, plain = work / "out", work / "plain.toml"
        plain.write_text("report.write = false\n")
        if not chosen.cached:
            os.environ["EPIPOLE_CACHE"] = str(work / "cache")
            row("first run, with an empty cache", [measure("run", EXAMPLE, "--out", out)])
        else:
            measure("run", EXAMPLE, "--out", out)
        again = ("run", EXAMPLE, "--again", "--out", out)
        cases: dict[str, tuple[str | Path, ...]] = {
            "later run, without the report": (*again, "--settings", plain),
            "later run": again,
            "run that finds the night unchanged": ("run", EXAMPLE, "--out", out),
            "`epipole report`": ("report", out, "--night", NIGHT, "--out", work / "night.html"),
            "`epipole overlay`": ("overlay", out, EXAMPLE, "--out", work / "night.mcap"),
        }
        for name, command in cases.items():
            if chosen.only not in name:
                continue
            row(name, [measure(*command) for _ in range(chosen.rounds)])


if __name__ == "__main__":
    main()
