"""Untold optics: errors of attitudes and positions over their sigmas where the log is wrong.

    python tests/benchmarks/bench_untold_optics.py [--sensors N] [--frames N] [--fields DEG ...]
        [--untold KIND ...] [--place drawn|told] [--sigma PX] [--seed S] [--objects] [--tiny]

Sensors that turn over the sky, none with a prior attitude; each has its own true optics, and the
log tells a pinhole of the nominal field. Each kind of departure has N sensors in each field, with a
random sign. Principal point as told, and drawn with 5.1 px per axis together with tangential terms
of 5e-4. One run of `epipole run` per field and draw.

Printed per kind: sensors whose optics were fitted, frames with an attitude from stars, median error
across the boresight, stated sigma, and the mean of (error / sigma)^2 across the boresight and about
it, over sensors: an error of the optics is one draw per sensor.

With `--objects`: six sensors that look at 20 geostationary objects, positions and states against
the truth.
"""

import argparse
import json
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import polars as pl
from scipy.spatial.transform import Rotation
from whole_runs import COMMAND

from epipole.flows.simulate import simulate

KINDS: dict[str, dict[str, float]] = {
    "k1 0.1": {"k1": 0.1},
    "k1 0.3": {"k1": 0.3},
    "k1 1": {"k1": 1.0},
    "f 1 %": {"focal": 0.01},
    "f 3 %": {"focal": 0.03},
    "f 2 %, k1 0.3": {"focal": 0.02, "k1": 0.3},
    "principal point 3 to 10 px": {},
    "none": {},
}
LIMITS = {8.0: 7.3, 12.0: 6.6, 20.0: 5.7, 27.0: 5.2}  # magnitudes of 20 to 25 stars
PLACE_PX, TANGENTIAL = 5.12, 5e-4
MEASURES = (
    "frames_solved", "att_cross_arcsec_median", "pair_precision", "object_recall",
    "pos_err_km_median", "nees_mean", "nees_in_99", "states_nees_mean",
)  # fmt: skip

SKY = """
name = "untold_optics"
start = 2026-03-01T02:00:00Z
duration_s = {seconds}
seed = {seed}
[sensor_defaults]
magnitude_limit = {limit}
rate_hz = 1.0
orbit = {{ a_km = 42164.0, i_deg = 60.0 }}
pointing = {{ rate_deg_s = 0.5 }}
detection = {{ sigma_px = 0.15, false_points = 1.0, star_drop = 0.05 }}
"""
SENSOR = """
[[sensors]]
id = "{name}"
pointing = {{ mode = "spin", ra_deg = {ra:.2f}, dec_deg = {dec:.2f}, axis = {axis} }}
camera = {{ width = 1024, height = 1024, fov_deg = {field}, departure = {departure} }}
"""
RING = """
name = "untold_optics_objects"
start = 2026-03-01T02:00:00Z
duration_s = {seconds}
seed = {seed}
[sensor_defaults]
orbit = {{ random = "leo" }}
in_view = true
pointing = {{ mode = "track", orbit = {{ position_km = [-39353.5, 15130.6, 452.2] }} }}
magnitude_limit = {limit}
object_limit = 7.5
rate_hz = 1.0
detection = {{ sigma_px = 0.15, false_points = 3.0, star_drop = 0.05, target_drop = 0.05 }}
[[targets]]
count = 20
orbit = {{ position_km = [-39353.5, 15130.6, 452.2] }}
spread_km = 700.0
magnitude = [5.0, 7.4]
"""
VIEWER = """
[[sensors]]
id = "s{k}"
camera = {{ width = 1024, height = 1024, fov_deg = {field}, departure = {departure} }}
"""


def departure_of(kind: str, drawn: bool, rng: np.random.Generator) -> dict[str, float]:
    """Return the true optics minus the told ones."""
    if kind == "none":
        return {}
    off = {name: size * rng.choice([-1.0, 1.0]) for name, size in KINDS[kind].items()}
    if drawn:
        off |= {name: rng.normal(0, PLACE_PX) for name in ("cx_px", "cy_px")}
        off |= {name: rng.normal(0, TANGENTIAL) for name in ("p1", "p2")}
    if not KINDS[kind]:
        size, turn = rng.uniform(3, 10), rng.uniform(0, 2 * np.pi)
        off |= {"cx_px": size * np.cos(turn), "cy_px": size * np.sin(turn)}
    return off


def inline(values: dict[str, float]) -> str:
    """Return an inline table of TOML."""
    return "{ " + ", ".join(f"{name} = {value:.8f}" for name, value in values.items()) + " }"


def run(scene: str, folder: Path, sigma_px: float | None) -> tuple[Path, Path]:
    """Simulate a scene and run its log; return the dataset and the log.

    `sigma_px` is the setting `sensors.principal_point_sigma_px`.
    """
    path, log, out = folder / "scene.toml", folder / "night.mcap", folder / "out"
    path.write_text(scene)
    simulate(str(path), log)
    settings = folder / "settings.toml"
    told = "" if sigma_px is None else f"[sensors]\nprincipal_point_sigma_px = {sigma_px}\n"
    settings.write_text(told)
    command = [*COMMAND, "run", str(log), "--out", str(out), "--settings", str(settings), "--quiet"]
    subprocess.run(command, check=True)
    return out, log


def sky(field: float, drawn: bool, asked: argparse.Namespace) -> str:
    """Return a scene of so many sensors of each kind that is asked for."""
    rng = np.random.default_rng([int(field), drawn, *[asked.seed] * (asked.seed > 0)])
    text = SKY.format(seconds=asked.frames, seed=int(field) + asked.seed, limit=LIMITS[field])
    for kind_number, kind in enumerate(KINDS):
        for k in range(asked.sensors * (kind in asked.untold)):
            text += SENSOR.format(
                name=f"{kind_number}-{k:03d}", ra=rng.uniform(0, 360), dec=rng.uniform(-60, 60),
                axis=rng.normal(size=3).round(3).tolist(), field=field,
                departure=inline(departure_of(kind, drawn, rng)),
            )  # fmt: skip
    return text


def attitude_errors(out: Path, log: Path) -> pl.DataFrame:
    """Return the frames with the errors of their attitudes about the sensor axes [arcsec]."""
    frames = pl.read_parquet(f"{out}/night=*/frames/*.parquet")
    key = ["sensor_id", "frame_number"]
    both = frames.join(pl.read_parquet(f"{log}.truth/frames.parquet"), on=key, suffix="_true")
    solved = both.filter(pl.col("attitude_source") == "stars")
    got, true = (
        Rotation.from_quat(solved.select(f"q{a}{end}" for a in "xyzw").to_numpy())
        for end in ("", "_true")
    )
    off = np.degrees((got * true.inv()).as_rotvec()) * 3600
    errors = solved.select(*key, "sigma_x_arcsec", "sigma_y_arcsec", "sigma_z_arcsec")
    return errors.with_columns(
        **{f"off_{a}": off[:, k] for k, a in enumerate("xyz")},
        kind=pl.col("sensor_id").str.split("-").list.first().cast(int),
    )


def table_of(field: float, draw: str, out: Path, log: Path, split: bool) -> list[str]:
    """Return a line per kind of departure; with `split`, fitted sensors have one of their own."""
    errors = attitude_errors(out, log)
    square = {a: (pl.col(f"off_{a}") / pl.col(f"sigma_{a}_arcsec")) ** 2 for a in "xyz"}
    by_sensor = errors.group_by("kind", "sensor_id").agg(
        n=pl.len(),
        off=(pl.col("off_x") ** 2 + pl.col("off_y") ** 2).sqrt().median(),
        sigma=pl.col("sigma_x_arcsec").median(),
        across=((square["x"] + square["y"]) / 2).mean(),
        about=square["z"].mean(),
    )
    frames = pl.read_parquet(f"{log}.truth/frames.parquet").group_by("sensor_id").len()["len"][0]
    fitted_arcsec = 0.2 * 3600 * field / 1024  # stars alone: 0.03 px
    enough = pl.read_parquet(f"{out}/night=*/calibrations/*.parquet")["sensor_id"]
    lines = []
    for number, kind in enumerate(KINDS):
        own = by_sensor.filter(pl.col("kind") == number)
        fitted = own.filter(
            pl.col("sigma") > fitted_arcsec, pl.col("sensor_id").is_in(enough.implode())
        )
        as_told = own.join(fitted, "sensor_id", "anti")
        parts = {"fitted": fitted, "as told": as_told} if split else {"all": own}
        for which, some in parts.items():
            if len(some):
                share = some["n"].sum() / (frames * len(some))
                lines.append(
                    f"| {field:g} | {kind} | {draw} | {which} | {len(some)} | {share:.1%} "
                    f"| {some['off'].median():.1f} | {some['sigma'].median():.1f} "
                    f"| {some['across'].mean():.2f} | {some['about'].mean():.2f} |"
                )
    return lines


def objects(field: float, kind: str, seed: int, asked: argparse.Namespace) -> str:
    """Return a line: what six sensors with untold optics find, against the truth."""
    rng = np.random.default_rng(seed)
    limit = LIMITS[field]
    text = RING.format(seconds=asked.frames, seed=seed, limit=limit)
    for k in range(6):
        departure = inline(departure_of(kind, True, rng))
        text += VIEWER.format(k=k, field=field, departure=departure)
    with tempfile.TemporaryDirectory() as folder:
        out, log = run(text, Path(folder), asked.sigma)
        evaluate = [*COMMAND, "evaluate", str(out), "--truth", f"{log}.truth", "--json"]
        made = subprocess.run(evaluate, check=True, capture_output=True, text=True)
        found = json.loads(made.stdout)
    known = (found[name] for name in MEASURES)  # null where nothing was found
    numbers = " | ".join("" if value is None else f"{value:.4g}" for value in known)
    return f"| {field:g} | {kind} | {seed} | {numbers} |"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--sensors", type=int, default=20, help="per kind and field")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--fields", type=float, nargs="+", default=list(LIMITS))
    parser.add_argument("--untold", nargs="+", default=list(KINDS), metavar="KIND")
    parser.add_argument("--place", choices=("told", "drawn"), help="principal point; else both")
    parser.add_argument("--sigma", type=float, help="of principal points, told to the run [px]")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--objects", action="store_true")
    parser.add_argument("--tiny", action="store_true", help="one field, two sensors per kind")
    asked = parser.parse_args()
    if asked.tiny:
        asked.sensors, asked.fields = 2, asked.fields[-1:]
    if asked.objects:
        print(f"| field deg | untold | seed | {' | '.join(MEASURES)} |")
        print("|" + "---|" * (3 + len(MEASURES)))
        for field in asked.fields:
            for kind in ("none", "k1 0.3", "k1 1", "f 1 %"):
                for seed in range(1, 2 if asked.tiny else 4):
                    print(objects(field, kind, seed, asked), flush=True)
        return
    print("| field deg | untold | principal point | optics | sensors | frames | error \" "
          "| sigma \" | across | about |\n|---|---|---|---|---|---|---|---|---|---|")  # fmt: skip
    for field in asked.fields:
        for place in (asked.place,) if asked.place else ("told", "drawn"):
            with tempfile.TemporaryDirectory() as folder:
                scene = sky(field, place == "drawn", asked)
                out, log = run(scene, Path(folder), asked.sigma)
                lines = table_of(field, place, out, log, asked.sigma is None)
            print("\n".join(lines), flush=True)


if __name__ == "__main__":
    main()
