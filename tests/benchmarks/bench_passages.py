"""Passages: what becomes of objects that sensors fixed to their satellites see for seconds.

    python tests/benchmarks/bench_passages.py [--satellites 16] [--seeds 1 2] [--apart]

The same as `epipole simulate constellation --satellites N --near --seed S`, `epipole run` and
`epipole evaluate`: ten minutes, 10,000 low objects, two sensors of 18 degrees on each satellite.
`--apart`: satellites anywhere, not near each other. A column for each seed.
"""

import argparse
import tempfile
from pathlib import Path

from bench_scenes import figure
from whole_runs import whole_run

from epipole.flows.evaluate import evaluate
from epipole.flows.simulate import simulate
from epipole.schemas.evaluation import Report

MEASURES = {
    "passages; those above 2 deg/s": ("passages", "passages_fast"),
    "with a tracklet": ("passages_tracked", "passages_fast_tracked"),
    "with observations; share of their detections": ("passages_observed", "detections_observed"),
    "pairs of satellites; joined": ("passage_pairs", "passages_joined"),
    "tracklets that are no object; joined wrongly": ("tracklets_false", "joined_wrong"),
    "object epochs found": ("object_recall",),
    "ghosts; objects lost; exchanged ids": ("ghosts", "objects_lost", "id_swaps"),
}
RATIOS = {
    "ids per object": "ids_per_target",
    "squared error over covariance: positions": "nees_mean",
    "the same: states": "states_nees_mean",
}


def measure(satellites: int, seed: int, near: bool, seconds: float | None) -> Report:
    """Return the report of a constellation."""
    with tempfile.TemporaryDirectory() as folder:
        logs, out = Path(folder) / "logs", Path(folder) / "out"
        size = {"satellites": satellites, "near": near, "seconds": seconds}
        simulate("constellation", logs, seed=seed, **size)  # type: ignore[arg-type]
        whole_run(logs, out, {}, lambda _: 0.0)
        return evaluate(out, Path(f"{logs}.truth"))


def main() -> None:
    """Print a column for each seed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--satellites", type=int, default=16)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--seconds", type=float, default=None)
    parser.add_argument("--apart", action="store_true")
    chosen = parser.parse_args()
    reports = [
        measure(chosen.satellites, seed, not chosen.apart, chosen.seconds) for seed in chosen.seeds
    ]
    print(f"| seed | {' | '.join(map(str, chosen.seeds))} |\n|---|{'---|' * len(reports)}")
    for label, names in MEASURES.items():
        cells = ["; ".join(figure(n, getattr(report, n)) for n in names) for report in reports]
        print(f"| {label} | {' | '.join(cells)} |")
    for label, name in RATIOS.items():
        values = [getattr(report, name) for report in reports]
        cells = ["-" if value is None else f"{value:.2f}" for value in values]
        print(f"| {label} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
