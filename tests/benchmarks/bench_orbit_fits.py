"""Orbits fitted to `observations` alone: do their errors agree with their covariances?

    python tests/benchmarks/bench_orbit_fits.py [LOG...] [--seeds 12] [--scene four_sensor_geo]

The fit is that of `examples/fit_orbit.py`: the Earth's mass and flattening, light time, and what
all frames of a sensor share as unknowns with their stated sigmas. Without a log, one is simulated
for each seed, with biases of its own. A log has its truth beside it.

Objects of one log share the biases of its sensors: so the standard error is over logs.
"""

import argparse
import runpy
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from whole_runs import whole_run

from epipole.flows.simulate import simulate
from epipole.io.simulation.truth import read_truth
from epipole.schemas.bridge import to_polars
from epipole.tasks.algorithms.evaluation import squared_normalised_errors
from epipole.tasks.evaluate.matching import locate_objects, true_objects, with_truth

EXAMPLE = Path(__file__).parents[2] / "examples" / "fit_orbit.py"
STATE = [*(f"{a}_km" for a in "xyz"), *(f"v{a}_km_s" for a in "xyz")]


def fits_of(log: Path, folder: Path, fit: Callable[..., Any]) -> pl.DataFrame:
    """Return, for each state of a log, the fitted orbit's errors against the truth."""
    whole_run(log, folder / "out", {}, lambda _: 0.0)
    states, observations = (
        pl.read_parquet(folder / f"out/night=*/{name}/*.parquet")
        for name in ("states", "observations")
    )
    truth = read_truth(log)
    shown = true_objects(with_truth(observations, to_polars(truth.points)))
    found = []
    for row in states.iter_rows(named=True):
        mine = observations["object_id"].eq_missing(row["object_id"]).to_numpy()
        own = observations.filter(pl.Series(mine))
        guess = np.array([row[name] for name in STATE])
        state, cov, chi2, freedom = fit(own, row["epoch"], guess)
        of_object = np.bincount(shown[mine][shown[mine] >= 0]).argmax()
        at_ns = states.filter(object_id=row["object_id"])["epoch"].dt.epoch("ns").to_numpy()[:1]
        r_km, v_km_s = locate_objects(truth, np.array([of_object]), at_ns)
        error = state - np.hstack([r_km[0], v_km_s[0]])
        nees = squared_normalised_errors(error[None], cov[None])[0] / 6
        km = float(np.linalg.norm(error[:3]))
        found.append((row["object_id"], len(own), nees, chi2 / freedom, km))
    names = ("object", "observations", "nees", "chi2", "km")
    return pl.DataFrame(found, schema=names, orient="row")


def main() -> None:
    """Print a line per log, and all together."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("logs", nargs="*", type=Path)
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--scene", default="four_sensor_geo")
    parser.add_argument("--objects", type=int, help="of the scene's first group")
    asked = parser.parse_args()
    fit = runpy.run_path(str(EXAMPLE))["fit"]
    of_logs = []
    print(f"{'log':32} objects  chi2/dof  NEES/6  error [km]")
    for number in range(len(asked.logs) or asked.seeds):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            log = asked.logs[number] if asked.logs else folder / f"{asked.scene}_{number + 1}.mcap"
            if not asked.logs:
                simulate(asked.scene, log, seed=number + 1, objects=asked.objects)
            fits = fits_of(log, folder, fit)
        of_logs.append(fits)
        chi2, nees, km = fits["chi2"].mean(), fits["nees"].mean(), fits["km"].median()
        print(f"{log.stem:32} {len(fits):7} {chi2:9.2f} {nees:7.2f} {km:11.3f}", flush=True)
    means = np.array([float(fits["nees"].mean()) for fits in of_logs])  # type: ignore[arg-type]
    error = means.std(ddof=1) / np.sqrt(len(means)) if len(means) > 1 else np.nan
    total = sum(len(fits) for fits in of_logs)
    print(f"{total} orbits: NEES/6 {means.mean():.2f} +- {error:.2f} (expected: 1)")


if __name__ == "__main__":
    main()
