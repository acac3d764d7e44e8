"""Identity: nine objects are observed for a minute, then not for a while, then again.

python tests/benchmarks/bench_identity.py [--gaps 120 300 ...] [--seeds 1 2 3]
"""

import argparse
from typing import Any

import polars as pl
from four_sensors import runs

GAPS_S = (120, 300, 900, 1800)
SEEDS = (1, 2, 3)


def main() -> None:
    """Print for each gap: objects on both sides, recognised, and mistaken for another."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gaps", type=int, nargs="+", default=GAPS_S, help="seconds")
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS)
    chosen = parser.parse_args()
    print("| gap s | on both sides | recognised | mistaken |")
    with runs() as run:
        for gap_s in chosen.gaps:
            both = again = mistaken = 0
            for seed in chosen.seeds:

                def gap(scene: dict[str, Any], gap_s: int = gap_s, seed: int = seed) -> None:
                    scene |= {"seed": seed, "duration_s": 120.0 + gap_s}
                    for sensor in scene["sensors"]:
                        sensor["outages_s"] = [[60.0, 60.0 + gap_s]]

                _, out, log = run(gap)
                ids = _whose(out, log, gap_s)
                both += len(ids)
                again += sum(before & after != set() for before, after in ids.values())
                before = {name: key for key, (names, _) in ids.items() for name in names}
                mistaken += sum(
                    before.get(name, key) != key
                    for key, (_, after) in ids.items()
                    for name in after
                )
            print(f"| {gap_s} | {both} | {again} | {mistaken} |", flush=True)


def _whose(out: Any, log: Any, gap_s: float) -> dict[int, tuple[set[str], set[str]]]:
    """Return the ids before and after the gap of each true object observed on both sides."""
    views = pl.read_parquet(f"{out}/night=*/associations/*.parquet").drop_nulls("centroid")
    truth = pl.read_parquet(f"{log}.truth/points.parquet").filter(pl.col("kind") == 1)
    views = views.join(truth, on=["sensor_id", "frame_number", "centroid"])
    later = pl.col("epoch") > pl.col("epoch").min() + pl.duration(seconds=60 + gap_s / 2)
    sides: list[dict[int, set[str]]] = [{}, {}]
    for source, name, after in views.select("source", "object_id", later.alias("x")).iter_rows():
        sides[after].setdefault(source, set()).add(name)
    return {key: (sides[0][key], sides[1][key]) for key in sorted(sides[0].keys() & sides[1])}


if __name__ == "__main__":
    main()
