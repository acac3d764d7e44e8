"""Association: points at one instant, many sensors, tracklets, and the published method.

``python tests/benchmarks/bench_association.py [TABLE ...] [--seeds N] [--false N ...]``,
tables: points, openptv, floor, scale, tracklets.

Points: F1 over the objects that at least three sensors detect. A group is right if it holds at
least three points of its object and no other point. OpenPTV runs on the same points if `optv` is
installed (the group ``bench``). Times are CPU times.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

from epipole.tasks.algorithms.constants import ARCSEC

sys.path.insert(0, str(Path(__file__).parent))

from points import PIXEL_RAD, Points, Score, judge, oracle_groups, scene

from epipole.schemas.settings import AssociationSettings
from epipole.tasks.algorithms.association.epipolar_lines import associate_by_lines
from epipole.tasks.algorithms.association.likelihood import Shell, associate_tracklets
from epipole.tasks.algorithms.association.samples import Groups, Samples
from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.algorithms.orbits.orbit_fit import propagate

FALSE = (10, 100, 300, 1000)
BANDS_PX = (0.4, 0.5, 0.6, 0.8, 1.0, 1.3)  # widths of OpenPTV's epipolar band, to take the best
LINES_PX = 1.0  # the published method's threshold: about 3 sigma of these points
DEFAULT = AssociationSettings()


def associate(samples: Samples) -> Groups:
    """Associate with the default settings of a run."""
    return associate_tracklets(
        samples,
        gate_sigma=DEFAULT.gate_sigma,
        min_altitude_km=DEFAULT.min_altitude_km,
        max_range_km=DEFAULT.max_range_km,
        min_log_odds=DEFAULT.min_log_odds,
        ambiguity_log_odds=DEFAULT.ambiguity_log_odds,
        shells=[Shell(s.lowest_km, s.highest_km, s.share) for s in DEFAULT.shells],
    )


def by_lines(samples: Samples) -> Groups:
    """Associate by the published method."""
    focal_px = np.full(len(samples.half_field), 1 / PIXEL_RAD)
    return associate_by_lines(samples, focal_px, LINES_PX)


def judge_once(points: Points, group: np.ndarray) -> Score:
    """Score like `judge`, but count an object with two groups only once."""
    score = judge(points, group)
    found = [
        int(own[0])
        for g in range(group.max(initial=-1) + 1)
        if len(own := points.who[group == g]) >= 3 and own[0] >= 0 and (own == own[0]).all()
    ]
    return score._replace(right=len(set(found)))


def cell(
    method, n_sensors: int, n_objects: int, n_false: int, seeds: int
) -> tuple[float, Score, float]:
    """Return F1 [%], the sum of the scores, and the median time [ms] of one density."""
    scores, took = [], []
    for seed in range(seeds):
        points = scene(seed, n_sensors, n_objects, n_false)
        begun = time.thread_time()
        groups = method(points.samples)
        took.append(time.thread_time() - begun)
        scores.append(judge_once(points, groups.group))
    total = Score(*(sum(column) for column in zip(*scores, strict=True)))
    return 100 * total.f1, total, 1e3 * float(np.median(took))


def openptv_table(seeds: int, false: list[int]) -> None:
    """Print OpenPTV's F1 on the same points, 4 sensors, by the width of its epipolar band."""
    try:
        from openptv import associate_by_openptv
    except ImportError:
        print("\nOpenPTV: not installed (pip install --group bench)")
        return
    print("\nOpenPTV, groups in all four sensors or in three: F1 % (median ms) by band, px")
    for n_false in false:
        best = []
        for eps_px in BANDS_PX:

            def method(samples: Samples, eps_px: float = eps_px) -> Groups:
                group = associate_by_openptv(samples, eps_px)
                nothing = np.zeros(len(group), bool)
                scores = np.zeros(group.max(initial=-1) + 1)
                return Groups(group, scores, nothing, nothing, np.zeros(4))

            f1, _, ms = cell(method, 4, 20, n_false, seeds)
            best.append(f"{eps_px}: {f1:.2f} ({ms:.1f})")
        print(f"4 | {n_false} | " + " | ".join(best), flush=True)


def points_table(seeds: int, false: list[int]) -> None:
    """Print the table of points at one instant."""
    associate(scene(0, 4, 20, 10).samples)  # compiles, before the timing
    print(f"\nPoints at one instant, 20 objects, {seeds} seeds per cell: F1 % (median ms)")
    print("sensors | false points | default | wanted, groups, right | published, L = 1 px")
    for n_sensors in (4, 8, 20):
        for n_false in false:
            f1, total, ms = cell(associate, n_sensors, 20, n_false, seeds)
            few = max(seeds // 10, 3) if n_sensors > 4 else seeds
            lines, _, lines_ms = cell(by_lines, n_sensors, 20, n_false, min(few, seeds, 10))
            print(
                f"{n_sensors} | {n_false} | {f1:.2f} ({ms:.1f}) | {total.wanted}, "
                f"{total.groups}, {total.right} | {lines:.1f} ({lines_ms:.0f})",
                flush=True,
            )


def scale_table(seeds: int) -> None:
    """Print the result for 100 sensors with 1,000 objects and 1,000 false points each."""
    print("\n100 sensors, 1,000 objects, 1,000 false points each, one core")
    associate(scene(0, 8, 20, 10).samples)
    for seed in range(seeds):
        points = scene(seed, 100, 1000, 1000)
        took = []
        for _ in range(5):
            begun = time.thread_time()
            groups = associate(points.samples)
            took.append(time.thread_time() - begun)
        score = judge_once(points, groups.group)
        ghosts = score.groups - score.right - score.strays
        print(
            f"seed {seed}: {1e3 * np.median(took):.0f} ms, {len(points.who)} points, "
            f"{score.wanted} objects, "
            f"{score.right} right, {score.strays} with a stray, {ghosts} ghosts",
            flush=True,
        )


def orbit(state: np.ndarray, ahead_s: np.ndarray) -> np.ndarray:
    """Return the positions of an object at times `ahead_s` after its state."""
    return np.array([propagate(state, t)[:3] for t in ahead_s])


def tracklets(seed: int, n_sensors: int, n_lone: int, times_s: np.ndarray, n_objects: int = 20):
    """Return tracklets at independent instants, and the object of each (-1: unrelated).

    Sensors in low orbits, GEO objects that all sensors see, and `n_lone` unrelated tracklets for
    each sensor with motions that differ by 2"/s.
    """
    rng = np.random.default_rng(seed)
    geo, v = np.array([-39359.89, 15125.76, 64.30]), np.array([-1.103, -2.870, 0.0])
    ahead_s = times_s - times_s.mean()
    r = np.empty((n_sensors, len(times_s), 3))
    for s in range(n_sensors):
        while True:
            out, along = rng.normal(size=(2, 3))
            out /= np.linalg.norm(out)
            if out @ geo > 0.3 * np.linalg.norm(geo):
                break
        along = np.cross(out, along)
        along /= np.linalg.norm(along)
        angle = ahead_s[:, None] * 7.5 / 7000.0
        r[s] = 7000.0 * (np.cos(angle) * out + np.sin(angle) * along)
    centre = orbit(np.concatenate([geo, v]), ahead_s)
    look = centre - r
    look /= np.linalg.norm(look, axis=2, keepdims=True)
    u, sensor, who = [], [], []
    for k in range(n_objects):
        start, drift = rng.normal(size=3) * 200.0, rng.normal(size=3) * 0.02
        path = orbit(np.concatenate([geo + start, v + drift]), ahead_s)
        for s in range(n_sensors):
            u.append(path - r[s])
            sensor.append(s)
            who.append(k)
    for s in range(n_sensors):
        rate = rng.normal(size=(n_lone, 2)) * 2 * ARCSEC
        off = rng.uniform(-1, 1, (n_lone, 2)) * np.radians(1.0)
        steps = off[:, None] + ahead_s[:, None] * rate[:, None]
        u.extend(look[s] + np.einsum("nka,kai->nki", steps, tangent_basis(look[s])))
        sensor += [s] * n_lone
        who += [-1] * n_lone
    sight = np.array(u)
    sight /= np.linalg.norm(sight, axis=2, keepdims=True)
    shake = rng.normal(size=(*sight.shape[:2], 2)) * ARCSEC
    sight += np.einsum("nka,nkai->nki", shake, tangent_basis(sight))
    sight /= np.linalg.norm(sight, axis=2, keepdims=True)
    # An object out of the field has no view.
    inside = np.einsum("nki,nki->nk", sight, look[np.array(sensor)]) > np.cos(np.radians(1.4))
    first = np.array([times_s[np.flatnonzero(row)[0]] if row.any() else 0.0 for row in inside])
    last = np.array([times_s[np.flatnonzero(row)[-1]] if row.any() else 0.0 for row in inside])
    samples = Samples(
        np.array(sensor), first, last, inside, sight,
        np.tile(np.eye(2) * ARCSEC**2, (*sight.shape[:2], 1, 1)),
        np.full(sight.shape[:2], 0.02), times_s, r,
        np.concatenate([tangent_basis(look), look[:, :, None]], axis=2),
        np.full((n_sensors, 2), np.tan(np.radians(1.0))),
    )  # fmt: skip
    return samples, np.array(who)


def pair_score(who: np.ndarray, group: np.ndarray) -> tuple[int, int, int]:
    """Return how many pairs of tracklets are true, grouped, and both."""

    def pairs(label: np.ndarray) -> set[tuple[int, int]]:
        out = set()
        for k in range(label.max(initial=-1) + 1):
            members = np.flatnonzero(label == k).tolist()
            out |= {(i, j) for i in members for j in members if i < j}
        return out

    true, grouped = pairs(who), pairs(group)
    return len(true), len(grouped), len(true & grouped)


def floor_table(seeds: int) -> None:
    """Print what is possible with known positions, for several thresholds of the log-odds."""
    print("\nPositions of the objects known: objects with a false view %, F1 %, true views kept %")
    for n_sensors, n_objects, n_false in ((8, 20, 1000), (20, 20, 1000), (100, 1000, 1000)):
        scenes = [scene(k, n_sensors, n_objects, n_false) for k in range(seeds)]
        for least, lead in ((0.0, 0.0), (5.0, 3.0), (5.0, 5.0), (7.0, 5.0), (8.5, 5.0)):
            total, kept, true = np.zeros(4), 0, 0
            for points in scenes[: 1 if n_sensors == 100 else None]:
                group = oracle_groups(points, least, lead)
                total += np.array(judge_once(points, group))
                kept += int(((group == points.who) & (group >= 0)).sum())
                true += int((points.who >= 0).sum())
            score = Score(*total.astype(int).tolist())
            print(
                f"{n_sensors} | {n_false} | {least:.1f}, {lead:.1f} | "
                f"{100 * score.strays / score.wanted:.2f} | {100 * score.f1:.2f} | "
                f"{100 * kept / true:.1f}",
                flush=True,
            )


def tracklet_table(seeds: int) -> None:
    """Print pair precision and recall of tracklets, by the length of the data."""
    cases = (
        (4, 1000, np.arange(6.0, 60, 12)),
        (2, 100, np.arange(6.0, 60, 12)),
        (2, 100, np.linspace(25, 575, 12)),
    )
    print("\nTracklets, 20 objects, lone tracklets per sensor")
    for n_sensors, n_lone, times_s in cases:
        total, took = np.zeros(3, int), []
        for seed in range(seeds):
            samples, who = tracklets(seed, n_sensors, n_lone, times_s)
            begun = time.thread_time()
            groups = associate(samples)
            took.append(time.thread_time() - begun)
            total += pair_score(who, groups.group)
        true, grouped, right = total.tolist()
        print(
            f"{n_sensors} sensors, {n_lone} lone, {len(times_s)} instants in "
            f"{np.ptp(times_s) + 12:.0f} s: precision {100 * right / max(grouped, 1):.2f} %, "
            f"recall {100 * right / max(true, 1):.2f} % of {true} pairs, "
            f"{1e3 * np.median(took):.0f} ms",
            flush=True,
        )


def main() -> None:
    """Run the requested tables, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "tables", nargs="*", default=["points", "openptv", "floor", "scale", "tracklets"]
    )
    parser.add_argument("--seeds", type=int, default=30, help="scenes a cell")
    parser.add_argument("--false", type=int, nargs="+", default=FALSE, help="false points")
    args = parser.parse_args()
    if "points" in args.tables:
        points_table(args.seeds, args.false)
    if "openptv" in args.tables:
        openptv_table(args.seeds, args.false)
    if "floor" in args.tables:
        floor_table(args.seeds)
    if "scale" in args.tables:
        scale_table(min(args.seeds, 3))
    if "tracklets" in args.tables:
        tracklet_table(min(args.seeds, 10))


if __name__ == "__main__":
    main()
