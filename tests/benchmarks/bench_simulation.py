"""Simulation with log and truth written: frames per second and peak memory.

    python tests/benchmarks/bench_simulation.py [--hours 2] [--sensors 6]

The first, short simulation loads libraries and is not counted.
"""

import argparse
import json
import resource
import tempfile
import time
from pathlib import Path

from epipole.flows.simulate import simulate


def bench_simulate(hours: float, sensors: int) -> dict[str, float]:
    """Return time and memory of one simulated night."""
    with tempfile.TemporaryDirectory() as folder:
        simulate("night", Path(folder) / "first.mcap", hours=0.01)
        wall, cpu = time.perf_counter(), time.process_time()
        made = simulate("night", Path(folder) / "night.mcap", hours=hours, sensors=sensors)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return {
        "frames": made.frames,
        "centroids_a_frame": round(made.centroids / made.frames, 1),
        "wall_s": round(wall, 2),
        "cpu_s": round(cpu, 2),
        "frames_a_second": round(made.frames / wall),
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
    }


def main() -> None:
    """Print time and memory as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--sensors", type=int, default=6)
    print(json.dumps(bench_simulate(**vars(parser.parse_args()))))


if __name__ == "__main__":
    main()
