"""Logs with one mistake each: is it named, and what do the positions of such a night tell?

    python tests/benchmarks/bench_mistakes.py [--kinds geo low fixed] [--seconds 22 60] [--seed 1]
        [--seeds 1] [--only TEXT] [--sound] [--out FOLDER]

Sound logs of geostationary objects before four low sensors (`geo`), of low satellites (`low`), and
of a constellation with its sensors fixed to the body (`fixed`) are written again with each mistake
of `scenes/log_mistakes.py`, in all sensors and in one, and run. With --sound only the logs as they
are: whatever is named then is a false alarm.

A line for each log: the positions, the share of them outside their 99 % ellipsoids (HARM: more
than 5 %), and what was named, with the sensors. Results are kept in FOLDER, so a run that is
stopped goes on.
"""

import argparse
import json
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from bench_real_orbits import Orbits, low_scene
from four_sensors import SCENE

sys.path.append(str(Path(__file__).parents[1]))  # for the helpers in tests/scenes
from scenes.log_mistakes import MISTAKES, rewritten

from epipole.flows.evaluate import evaluate
from epipole.flows.nightly import nightly
from epipole.flows.prefect.defaults import embedded_prefect, quiet_console
from epipole.flows.simulate import simulate
from epipole.io.datasets.dataset import nights_in, read_table
from epipole.io.logs.reader import read_log
from epipole.schemas.bridge import to_polars
from epipole.schemas.errors import EpipoleError, SceneError
from epipole.schemas.log_checks import CheckVerdict
from epipole.schemas.rejects import Reason, Trait
from epipole.schemas.scene import validate_scene

MAX_OUTSIDE = 0.05  # share of positions outside their 99 % ellipsoids, without harm
ATTEMPTS = 200


def sound_log(kind: str, seconds: int, seed: int, out: Path) -> Path:
    """Simulate a log, and return it."""
    log = out / f"{kind}{seconds}-{seed}.mcap"
    if log.exists():
        return log
    if kind == "fixed":
        simulate("constellation", log, seed=seed, satellites=12, near=True, seconds=float(seconds))
    elif kind == "geo":
        scene = tomllib.loads(SCENE.read_text()) | {"seed": seed, "duration_s": float(seconds)}
        simulate(validate_scene(scene, "geo"), log)
    else:
        simulate(_low_scene(seconds, seed), log)
    return log


def _low_scene(seconds: int, seed: int) -> Any:
    low, geo = Orbits(["real_leo.tle", "real_sensors.tle"]), Orbits(["real_geo.tle"])
    rng = np.random.default_rng([seed, 7])
    for _ in range(ATTEMPTS):
        try:
            values = low_scene(rng, low, geo) | {"name": "low", "seed": seed}
            values |= {"element_age_days": 30.0, "duration_s": float(seconds)}
            for sensor in values["sensors"]:
                sensor["rate_hz"] = 1.0  # exposures of a second end before the next
            return validate_scene(values, "low")
        except SceneError:
            continue
    raise SystemExit("no hour has sensors where they are needed")


class Outcome(NamedTuple):
    """What a run said of a log, and what its positions were.

    `causes` has the sensors by what was named of them.
    """

    causes: dict[str, list[str]]
    positions: int
    outside: float

    @property
    def is_harmful(self) -> bool:
        """Whether more positions than `MAX_OUTSIDE` lie outside their 99 % ellipsoids."""
        return self.positions > 0 and self.outside > MAX_OUTSIDE


def run(log: Path, truth: Path, out: Path) -> Outcome:
    """Run a log, and return what was said of it."""
    try:
        nightly([str(log)], str(out))
    except EpipoleError as error:
        return Outcome({f"error: {error}": []}, 0, 0.0)
    causes: dict[str, set[str]] = {}
    faults = {reason.value for reason in Reason.having(Trait.SENSOR_FAULT)}
    for night in nights_in(str(out)):
        checks, rejects = (to_polars(read_table(str(out), name, night))
                           for name in ("checks", "rejects"))  # fmt: skip
        wrong = checks.filter(verdict=CheckVerdict.WRONG).select("cause", "sensor_id")
        left_out = rejects.filter(pl.col("reason").is_in(faults)).select("reason", "sensor_id")
        for cause, sensor in [*wrong.iter_rows(), *left_out.iter_rows()]:
            causes.setdefault(cause, set()).add(sensor)
    report = evaluate(out, truth)
    outside = 1.0 - (report.nees_in_99 or 0.0) if report.positions else 0.0
    return Outcome({k: sorted(v) for k, v in causes.items()}, report.positions or 0, outside)


def logs(chosen: argparse.Namespace) -> Iterator[tuple[str, Path, str, str]]:
    """Yield each log to run: its name, the sound log, the mistake and who has it."""
    for kind in chosen.kinds:
        for seconds in chosen.seconds:
            for seed in range(chosen.seed, chosen.seed + chosen.seeds):
                sound = sound_log(kind, seconds, seed, chosen.out)
                name = f"{kind}{seconds}-{seed}"
                yield f"{name} sound", sound, "", "none"
                for mistake in [] if chosen.sound else MISTAKES:
                    if chosen.only in mistake:
                        for who in ("all", "one"):
                            yield f"{name} {mistake} {who}", sound, mistake, who


def outcome_of(name: str, sound: Path, mistake: str, who: str, out: Path) -> Outcome:
    """Return the outcome of a log, from FOLDER if it is there."""
    kept = out / f"{name.replace(' ', '_').replace('/', '_')}.json"
    if not kept.exists():
        log, truth, dataset = sound, Path(f"{sound}.truth"), out / f"{kept.stem}.out"
        if mistake:
            content = read_log(sound)
            sensors = sorted(set(content.states["sensor_id"].to_pylist()))
            names = sensors if who == "all" else sensors[1:2]
            log = rewritten(MISTAKES[mistake][0](content, names), kept.with_suffix(".mcap"))
        found = run(log, truth, dataset)
        kept.write_text(json.dumps(found._asdict()) + "\n")
    return Outcome(**json.loads(kept.read_text()))


def main() -> None:
    """Print what was named, log by log, and how many harmful ones have no name."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kinds", nargs="+", default=["geo", "low", "fixed"])
    parser.add_argument("--seconds", type=int, nargs="+", default=[22, 60])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--only", default="")
    parser.add_argument("--sound", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("mistakes"))
    chosen = parser.parse_args()
    chosen.out.mkdir(parents=True, exist_ok=True)
    quiet_console()
    harmful, silent, count = 0, [], 0
    with embedded_prefect():
        for name, *log in logs(chosen):
            found = outcome_of(name, *log, chosen.out)
            harm = "HARM" if found.is_harmful else ""
            count, harmful = count + 1, harmful + found.is_harmful
            silent += [name] if found.is_harmful and not found.causes else []
            print(
                f"{name:55} {found.positions:6d} {found.outside:6.3f} {harm:5} {found.causes}",
                flush=True,
            )


if __name__ == "__main__":
    main()
