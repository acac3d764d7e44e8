"""Objects held against a catalogue that ages: which are named, and which of them rightly.

    python tests/benchmarks/bench_known_objects.py [ELEMENTS...] [--objects 400] [--ages 3 10 30]

The truth moves by element sets: of the files given, or made up. A catalogue has two thirds of the
satellites, aged as `scenes/aged_elements.py` says, and others that are not observed. An object has
3 to 20 positions over 20 s to 3 hours, with errors that it has in a night: half of their variance
common to all. Objects within `TOGETHER_KM` of another satellite are counted by themselves.
"""

import argparse
import sys
import time
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from scenes.aged_elements import aged
from scenes.walker import DAY_NS, NIGHT_NS, satellites

from epipole.io.catalogues.element_sets import parse_element_sets
from epipole.schemas.settings import KnownObjectSettings
from epipole.schemas.star_lists import ElementSet
from epipole.tasks.algorithms.known_objects.matching import Observed, spread_rows
from epipole.tasks.algorithms.known_objects.prediction import predict, satellites_of
from epipole.tasks.name.elements_of_night import ElementsOfNight
from epipole.tasks.name.known_objects import judge_objects

TOGETHER_KM = 20.0
LISTED = 2 / 3
ARCS_S = (20.0, 120.0, 600.0, 10_800.0)
LOW_SIGMAS_KM, HIGH_SIGMAS_KM = (0.02, 0.1, 0.5), (0.2, 1.0, 3.0)


class Scene(NamedTuple):
    """Satellites that are observed, and a catalogue that has some of them, and others."""

    truth: list[ElementSet]
    observed: dict[str, Observed]
    catalogue: list[ElementSet]
    listed: np.ndarray
    together: np.ndarray


def observe(each: ElementSet, night_ns: int, rng: np.random.Generator) -> Observed:
    """Return positions of a satellite at some times of the night."""
    count, arc_s = int(rng.integers(3, 20)), rng.choice(ARCS_S)
    start_ns = night_ns + rng.uniform(-0.4, 0.4) * DAY_NS
    times = np.sort((start_ns + rng.uniform(0, arc_s, count) * 1e9).astype(np.int64))
    rows = spread_rows(times, np.ones(count, bool))
    times = times[rows]
    r_km = predict(satellites_of(np.array([each.elements])), times)[0, :, :3]
    shape = rng.normal(size=(3, 3))
    cov = shape @ shape.T
    cov *= 3 * rng.choice(LOW_SIGMAS_KM if each.elements[8] > 0.03 else HIGH_SIGMAS_KM) ** 2
    cov /= np.trace(cov)
    half = np.linalg.cholesky(cov / 2)
    noise = half @ rng.normal(size=3) + rng.normal(size=(len(times), 3)) @ half.T
    return Observed(times, r_km + noise, np.tile(cov, (len(times), 1, 1)))


def make_scene(sets: list[ElementSet], count: int, most_days: float, seed: int) -> Scene:
    """Return a scene from true element sets; ages are exponential, up to `most_days`."""
    rng = np.random.default_rng(seed)
    night_ns = int(np.median([each.epoch_ns for each in sets])) // DAY_NS * DAY_NS + DAY_NS // 2
    states = predict(
        satellites_of(np.array([each.elements for each in sets])), np.array([night_ns])
    )
    moving = [each for each, at in zip(sets, states[:, 0], strict=True) if np.isfinite(at).all()]
    order = rng.permutation(len(moving))
    truth, others = ([moving[k] for k in part] for part in (order[:count], order[count:]))
    others = others[:count]  # ageing a whole catalogue takes minutes
    ages = rng.exponential(most_days / 3, len(truth) + len(others)).clip(0.1, most_days)
    known = aged([*truth, *others], night_ns, ages, rng)
    listed = rng.random(len(truth)) < LISTED
    observed = {f"{k:06d}": observe(each, night_ns, rng) for k, each in enumerate(truth)}
    catalogue = [k for k, keep in zip(known, [*listed, *[True] * len(others)], strict=True) if keep]
    return Scene(truth, observed, catalogue, listed, _together(truth, moving, observed))


def _together(
    truth: list[ElementSet], others: list[ElementSet], observed: dict[str, Observed]
) -> np.ndarray:
    """Return which observed satellites have another one near them."""
    made = satellites_of(np.array([each.elements for each in others]))
    numbers = np.array([each.number for each in others])
    near = []
    for each, seen in zip(truth, observed.values(), strict=True):
        k = seen.anchor
        places = predict(made, seen.time_ns[[k]])[:, 0, :3]
        apart = np.linalg.norm(places - seen.r_km[k], axis=1)
        near.append(bool((apart[numbers != each.number] < TOGETHER_KM).any()))
    return np.array(near)


def count_verdicts(scene: Scene) -> tuple[Counter[tuple[str, str]], list[str], float]:
    """Return the verdicts by kind of object, the wrong ones, and the CPU time [s]."""
    known = ElementsOfNight("", scene.catalogue)
    start = time.process_time()
    verdicts, _ = judge_objects(scene.observed, known, KnownObjectSettings().probability)
    cpu_s = time.process_time() - start
    counts: Counter[tuple[str, str]] = Counter()
    wrong = []
    for k, (each, verdict) in enumerate(zip(scene.truth, verdicts.values(), strict=True)):
        kind = "listed" if scene.listed[k] else "not listed"
        kind += ", near another" if scene.together[k] else ""
        how = verdict.status
        if how == "known" and verdict.best is not None:
            named = scene.catalogue[verdict.best.row]
            if named.number != each.number:
                how = "wrong"
                wrong.append(f"{each.label} named {named.label}, {verdict.best.distance_km:.1f} km")
        counts[kind, how] += 1
    return counts, wrong, cpu_s


def main() -> None:
    """Print a table for each largest age, and the time of a large catalogue."""
    parser = argparse.ArgumentParser()
    parser.add_argument("elements", nargs="*", type=Path)
    parser.add_argument("--objects", type=int, default=400)
    parser.add_argument("--ages", type=float, nargs="+", default=[3.0, 10.0, 30.0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--catalogue", type=int, default=15_000, help="0: no timing")
    asked = parser.parse_args()
    sets = {
        s.number: s for path in asked.elements for s in parse_element_sets(path.read_bytes())[0]
    }
    truth = list(sets.values()) or satellites(2 * asked.objects, np.random.default_rng(asked.seed))
    for days in asked.ages:
        scene = make_scene(truth, min(asked.objects, len(truth)), days, asked.seed)
        counts, wrong, cpu_s = count_verdicts(scene)
        print(
            f"ages to {days:g} days, {len(scene.catalogue)} in the catalogue, {cpu_s:.1f} s of CPU"
        )
        for (kind, how), count in sorted(counts.items()):
            print(f"{count:6} {kind}: {how}")
        for line in wrong:
            print(f"       wrong: {line}")
    if asked.catalogue:
        time_large(scene, asked.catalogue, asked.seed)


def time_large(scene: Scene, size: int, seed: int) -> None:
    """Print the CPU time of the same objects against a catalogue of this many satellites."""
    rng = np.random.default_rng(seed)
    others = satellites(size - len(scene.catalogue), rng, high=0.1)
    shift_ns = scene.catalogue[0].epoch_ns - NIGHT_NS
    moved = [
        each._replace(
            epoch_ns=each.epoch_ns + shift_ns,
            elements=(each.elements[0] + shift_ns / DAY_NS, *each.elements[1:]),
        )
        for each in others
    ]
    large = scene._replace(catalogue=[*scene.catalogue, *moved])
    _, _, cpu_s = count_verdicts(large)
    print(f"{len(scene.observed)} objects against {len(large.catalogue)} satellites: "
          f"{cpu_s:.1f} s of CPU")  # fmt: skip


if __name__ == "__main__":
    main()
