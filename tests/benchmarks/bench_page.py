"""What Prefect's page costs a run: CPU seconds with and without its lines, progress and artifacts.

python tests/benchmarks/bench_page.py [--rounds N]

Runs of the example with and without the page, in turns, on one embedded API. The CPU time of the
server is included.
"""

import argparse
import logging
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

EXAMPLE = Path(__file__).parents[2] / "examples" / "four_sensor_geo.mcap"


def cpu_s() -> float:
    """Return the CPU seconds of this process and of its living children."""
    parents: dict[int, tuple[int, float]] = {}
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = entry.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        ticks = int(fields[11]) + int(fields[12])
        parents[int(entry.parent.name)] = int(fields[1]), ticks / os.sysconf("SC_CLK_TCK")

    def is_ours(pid: int) -> bool:
        while pid in parents and pid != os.getpid():
            pid = parents[pid][0]
        return pid == os.getpid()

    return sum(seconds for pid, (_, seconds) in parents.items() if is_ours(pid))


def measure(runs: dict[str, Callable[[], object]], rounds: int) -> None:
    """Print the median CPU and wall seconds of each kind of run, taken in turns."""
    cpu: dict[str, list[float]] = {name: [] for name in runs}
    wall: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(rounds):
        for name, run in runs.items():
            cpu_before, before = cpu_s(), time.monotonic()
            run()
            wall[name].append(time.monotonic() - before)
            time.sleep(0.5)  # the server writes with a delay
            cpu[name].append(cpu_s() - cpu_before)
    for name in runs:
        medians = statistics.median(cpu[name]), statistics.median(wall[name])
        print("{:12} CPU {:.2f} s, wall {:.2f} s".format(name, *medians))


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=9)
    rounds = parser.parse_args().rounds
    with tempfile.TemporaryDirectory() as folder:
        os.environ["PREFECT_HOME"] = folder  # read when prefect is imported
        from prefect import flow

        from epipole.flows.nightly import nightly
        from epipole.flows.prefect.defaults import embedded_prefect, quiet_console

        quiet_console()
        logging.getLogger("epipole").setLevel(logging.WARNING)
        bare = flow(name="bare")(nightly.fn.__wrapped__)  # type: ignore[attr-defined]
        with embedded_prefect():
            arguments = [str(EXAMPLE)], f"{folder}/out"
            nightly(*arguments, again=True)  # compiles
            measure(
                {"page": lambda: nightly(*arguments, again=True), "bare": lambda: bare(*arguments)},
                rounds,
            )


if __name__ == "__main__":
    main()
