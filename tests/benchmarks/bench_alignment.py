"""Alignment: position errors of sensors that never expose together, or always do.

python tests/benchmarks/bench_alignment.py [--seeds N] [--seconds N]
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from night_stages import position_errors, see, solve, track

from epipole.flows.simulate import simulate
from epipole.io.simulation.scenes import read_scene
from epipole.schemas.arrays import Array
from epipole.schemas.scene import Scene
from epipole.schemas.settings import Settings
from epipole.tasks.solve.positions import position_table

APART = {"phase": None}
ROUGH = APART | {"time_jitter_s": 0.01, "frame_drop": 0.05}
CASES = {
    "together, all at 1 Hz": ([1.0] * 4, {"phase": 0.0}),
    "together, 1, 4, 5, 10 Hz": ([1.0, 4.0, 5.0, 10.0], {"phase": 0.0}),
    "apart, 1, 3.7, 5, 10 Hz": ([1.0, 3.7, 5.0, 10.0], APART),
    "the same, jitter, drop-outs": ([1.0, 3.7, 5.0, 10.0], ROUGH),
    "apart, 0.1, 1, 10, 50 Hz": ([0.1, 1.0, 10.0, 50.0], APART),
}


def scene_of(rates_hz: list[float], changes: dict[str, float | None], seconds: float) -> Scene:
    """Return four low sensors and nine geostationary objects at other frame rates."""
    scene = read_scene("four_sensor_geo")
    sensors = [
        sensor.model_copy(update={"rate_hz": rate, **changes})
        for sensor, rate in zip(scene.sensors, rates_hz, strict=True)
    ]
    return scene.model_copy(update={"sensors": sensors, "duration_s": seconds})


def errors_of(scene: Scene, seed: int) -> Array:
    """Return the position errors [km] of a simulated log, at most one epoch per second."""
    settings = Settings()
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "night.mcap"
        simulate(scene, log, seed=seed)
        night = see(log, settings)
        solved = solve(night, track(night, settings), settings)
        return position_errors(log, position_table(solved))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=60.0, help="of each scene")
    chosen = parser.parse_args()
    print(f"{'exposures':<28} {'positions':>9} {'median km':>9} {'rms km':>7} {'95 % km':>8}")
    for name, (rates_hz, changes) in CASES.items():
        scene = scene_of(rates_hz, changes, chosen.seconds)
        found = np.concatenate([errors_of(scene, seed) for seed in range(chosen.seeds)])
        rms, high = np.sqrt(np.mean(found**2)), np.quantile(found, 0.95)
        print(
            f"{name:<28} {len(found):>9} {np.median(found):>9.3f} {rms:>7.3f} {high:>8.3f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
