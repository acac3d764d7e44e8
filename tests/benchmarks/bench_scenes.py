"""Built-in scenes, simulated, run and held against their truth: the README's table.

    python tests/benchmarks/bench_scenes.py [--scenes SCENE ...] [--night-hours 1]

The same as `epipole simulate SCENE`, `epipole run`, `epipole evaluate`, each with its defaults. The
scene `night` has six sensors.
"""

import argparse
import math
import tempfile
from pathlib import Path

from whole_runs import whole_run

from epipole.flows.evaluate import evaluate
from epipole.flows.simulate import simulate
from epipole.schemas.evaluation import Report

SCENES = ("four_sensor_geo", "six_sensor_wide", "lost_in_space", "real_geo", "real_leo", "night")
MEASURES = {
    "frames": ("frames",),
    "frames with an attitude from stars": ("frames_solved",),
    "wrong attitudes": ("att_wrong",),
    "star precision / recall": ("star_precision", "star_recall"),
    "pair precision / recall": ("pair_precision", "pair_recall"),
    "object epochs found": ("object_recall",),
    "ghosts / objects lost / exchanged ids": ("ghosts", "objects_lost", "id_swaps"),
    "position error, median": ("pos_err_km_median",),
    "positions in their 99 % ellipsoid": ("nees_in_99",),
}


def figure(name: str, value: float | None) -> str:
    """Return a measure as text: counts as they are, errors in km, shares in percent."""
    if value is None:
        return "-"
    if isinstance(value, int):
        return f"{value:,}"
    if "km" in name:
        return f"{value:.2f} km"
    return f"{math.floor(value * 1e4 + 1e-9) / 100:g} %"  # rounded down: 100 % means all


def measure(scene: str, hours: float) -> Report:
    """Return the report of a scene."""
    size = {"hours": hours, "sensors": 6} if scene == "night" else {}
    with tempfile.TemporaryDirectory() as folder:
        log, out = Path(folder) / "log.mcap", Path(folder) / "out"
        simulate(scene, log, **size)  # type: ignore[arg-type]
        whole_run(log, out, {}, lambda _: 0.0)
        return evaluate(out, Path(f"{log}.truth"))


def main() -> None:
    """Print a column for each scene."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=SCENES)
    parser.add_argument("--night-hours", type=float, default=1.0)
    chosen = parser.parse_args()
    reports = [measure(scene, chosen.night_hours) for scene in chosen.scenes]
    print(f"| | {' | '.join(chosen.scenes)} |\n|---|{'---|' * len(reports)}")
    for label, names in MEASURES.items():
        cells = [" / ".join(figure(n, getattr(report, n)) for n in names) for report in reports]
        cells = ["" if set(cell) <= set("-/ ") else cell for cell in cells]
        print(f"| {label} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
