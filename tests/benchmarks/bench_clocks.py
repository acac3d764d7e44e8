"""Clocks: offsets estimated from a minute of data, over their sigmas, and the decisions.

python tests/benchmarks/bench_clocks.py [--offsets 0 0.005 ...]
"""

import argparse
from typing import Any
from unittest import mock

import numpy as np
from four_sensors import runs

from epipole.flows.night import stages

OFFSETS_S = (0.0, 0.005, -0.02, 0.05, -0.1, 0.2, -0.3, 0.5, -0.7, 1.0, -1.3, 2.0)


def main() -> None:
    """Print a row for each offset, then the scatter of all estimates over their sigmas."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--offsets", type=float, nargs="+", default=OFFSETS_S, help="seconds")
    offsets_s = parser.parse_args().offsets
    estimates: list[Any] = []
    check_sensors = stages.check_sensors

    def recorded(*args: Any, **how: Any) -> Any:
        estimates.append(check_sensors(*args, **how))
        return estimates[-1]

    scores, wrong = [], 0
    print("| true s | estimate s | sigma s | wrong clock | others called wrong | left out |")
    with runs() as run, mock.patch.object(stages, "check_sensors", recorded):
        for k, offset_s in enumerate(offsets_s):

            def late(scene: dict[str, Any], k: int = k, offset_s: float = offset_s) -> None:
                scene["seed"] = 300 + k
                scene["sensors"][k % 4]["clock_offset_s"] = offset_s

            estimates.clear()
            summary, *_ = run(late)
            name = f"sat{k % 4 + 1}"
            for clock in estimates[0].verdicts:
                true = offset_s if clock.sensor_id == name else 0.0
                scores.append((clock.offset_s - true) / clock.sigma_s)
                if clock.sensor_id == name:
                    late_clock = clock
                else:
                    wrong += clock.is_faulty
            found = late_clock.has_wrong_clock
            estimate = f"{late_clock.offset_s:.3f} | {late_clock.sigma_s:.3f} | {found}"
            left_out = summary.outcomes.get("sensor_left_out", 0)
            print(f"| {offset_s} | {estimate} | {wrong} | {left_out} |", flush=True)
    print(f"rms over sigma {np.sqrt(np.mean(np.square(scores))):.2f} of {len(scores)}")


if __name__ == "__main__":
    main()
