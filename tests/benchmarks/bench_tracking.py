"""Frame to frame: IDF1 and CPU time per detection, against the number of false detections.

python tests/benchmarks/bench_tracking.py
python tests/benchmarks/bench_tracking.py --few    five frames, one in 40 s: shares found
"""

import argparse
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.schemas.arrays import Array
from epipole.tasks.algorithms.tracking.runs import SkyDetections, follow_detections

sys.path.append(str(Path(__file__).parents[1]))  # what tests share
from scenes.few_frames import FIELD_RAD as SMALL_FIELD_RAD
from scenes.few_frames import INTERVAL_S, few_frames, found_and_false
from scenes.identity_score import identity_f1

Labels = npt.NDArray[np.int64]

FIELD_RAD = np.radians(8.0)
SIGMA_RAD = 0.15 * FIELD_RAD / 1024
FASTEST_RAD_S = np.radians(0.05)
MISSED = 0.05


class Night(NamedTuple):
    """Detections of one sensor at 1 Hz, and the object of each (-1: false alarm)."""

    time_s: Array
    offsets: Labels
    u_icrs: Array
    truth: Labels


def night(seed: int, n_objects: int, n_false: int, n_frames: int) -> Night:
    """Return a field of 8 degrees that always holds so many objects.

    They move on great circles at 0 to 180 arcsec/s, any direction; one that leaves is replaced
    by one that comes in over an edge.
    """
    rng = np.random.default_rng(seed)
    place = rng.uniform(-0.5, 0.5, (n_objects, 2)) * FIELD_RAD
    rate = _rates(rng, n_objects)
    number = np.arange(n_objects)
    offsets, spots, truth = [0], [], []
    for _ in range(n_frames):
        seen = rng.random(n_objects) > MISSED
        false = rng.uniform(-0.5, 0.5, (rng.poisson(n_false), 2)) * FIELD_RAD
        found = np.vstack([place[seen] + rng.normal(size=(seen.sum(), 2)) * SIGMA_RAD, false])
        who = np.concatenate([number[seen], np.full(len(false), -1)])
        order = rng.permutation(len(found))
        spots.append(found[order])
        truth.append(who[order])
        offsets.append(offsets[-1] + len(order))
        place = place + rate
        out = np.flatnonzero((np.abs(place) > FIELD_RAD / 2).any(axis=1))
        if len(out):
            number[out] = number.max() + 1 + np.arange(len(out))
            rate[out] = _rates(rng, len(out))
            place[out] = _edge(rng, rate[out])
    spot = np.concatenate(spots)
    # Great circles are straight on the plane that touches the sky in the middle of the field.
    u = np.column_stack([spot, np.ones(len(spot))]) @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return Night(np.arange(n_frames) + 0.0, np.array(offsets), u, np.concatenate(truth))


def _rates(rng: np.random.Generator, n: int) -> Array:
    heading = rng.uniform(0, 2 * np.pi, n)
    speed = rng.uniform(0, FASTEST_RAD_S, n)
    return speed[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])


def _edge(rng: np.random.Generator, rate: Array) -> Array:
    """Return places on the edge of the field where objects with these rates enter."""
    place = rng.uniform(-0.5, 0.5, rate.shape) * FIELD_RAD
    axis = np.argmax(np.abs(rate), axis=1)
    rows = np.arange(len(rate))
    place[rows, axis] = -np.sign(rate[rows, axis]) * FIELD_RAD / 2
    return place


def follow(scene: Night, **changes: float) -> Labels:
    """Return the tracks, with the default settings of the pipeline."""
    options = {
        "max_rate_rad_s": np.radians(2.0),
        "max_coast_s": 4.5,
        "max_missed": 3,
        "min_detections": 3,
        "gate_sigma": 4.0,
        "field_sr": FIELD_RAD**2,
        "false_alarm": 1e-4,
    }
    sigma = np.full(len(scene.u_icrs), SIGMA_RAD)
    seen = SkyDetections(scene.time_s, scene.offsets, scene.u_icrs, sigma)
    return follow_detections(seen, **(options | changes))


def few(n_false: float, seeds: int, missed: float, **changes: float) -> tuple[float, float, float]:
    """Return the shares of objects found that are in all five frames, and in three or more; and
    the number of false tracks per sequence."""
    options = {
        "max_rate_rad_s": np.radians(2.0),
        "max_coast_s": 4.5 * INTERVAL_S,
        "max_missed": 3,
        "min_detections": 3,
        "gate_sigma": 4.0,
        "field_sr": SMALL_FIELD_RAD.prod(),
        "false_alarm": 1e-4,
    }
    whole, some = np.zeros(3), np.zeros(3)
    for seed in range(seeds):
        scene = few_frames(seed, 2, n_false, sigma_px=0.8, missed=missed)
        track = follow_detections(SkyDetections(*scene[:4]), **(options | changes))
        whole += found_and_false(scene, track, 5)
        some += found_and_false(scene, track, 3)
    return whole[0] / whole[1], some[0] / some[1], whole[2] / seeds


def tell_few(seeds: int) -> None:
    print("| strays per frame | accepted | in all five % | in 3 to 5 % | false per sequence |")
    for n_false in (5, 20):
        for accepted in (5e-4, 1.0):  # the first is the rate per frame, as for long sequences
            whole, some, false = few(n_false, seeds, MISSED, false_alarm_sequence=accepted)
            print(
                f"| {n_false} | {accepted} | {100 * whole:.1f} | {100 * some:.1f} | {false:.3f} |"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--objects", type=int, default=250)
    parser.add_argument("--false", type=int, nargs="*", default=[2, 10, 30, 100, 300, 1000])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--few", action="store_true", help="five frames instead")
    parser.add_argument("--seeds", type=int, default=500, help="of --few")
    chosen = parser.parse_args()
    if chosen.few:
        tell_few(chosen.seeds)
        return
    follow(night(0, 5, 5, 20))
    print(f"{'objects':>7} {'false':>6} {'IDF1 %':>7} {'us a detection':>15}")
    for n_false in chosen.false:
        scene = night(1, chosen.objects, n_false, chosen.frames)
        seconds = []
        for _ in range(chosen.repeats):
            began = time.process_time()
            track = follow(scene)
            seconds.append(time.process_time() - began)
        score = 100 * identity_f1(scene.truth, track)
        cost = 1e6 * np.median(seconds) / len(track)
        print(f"{chosen.objects:>7} {n_false:>6} {score:>7.2f} {cost:>15.2f}", flush=True)


if __name__ == "__main__":
    main()
