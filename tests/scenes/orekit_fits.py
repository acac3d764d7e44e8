"""Orbits that Orekit fits to the exported messages of a night, against the truth of its log.

As a process: `scenes.orekit_fits LOG DATASET MESSAGES [medians]` prints the table as JSON.
"""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl

from epipole.flows.export import export
from epipole.io.simulation.truth import Truth, read_truth
from epipole.schemas.bridge import to_polars
from epipole.schemas.options import Message
from epipole.tasks.algorithms.evaluation import squared_normalised_errors
from epipole.tasks.evaluate.matching import locate_objects, true_objects, with_truth
from scenes.orekit_process import printed_by, started_example

ENOUGH_S, ENOUGH_SENSORS = 10.0, 2  # what a fit needs: less tells no velocity, or no distance


def orekit_fits(log: Path, dataset: Path, messages: Path, medians: bool = False) -> pl.DataFrame:
    """Return a row for each object of a night: how Orekit's fit went, and its errors.

    Parameters
    ----------
    log
        A simulated log with its truth beside it.
    dataset
        The dataset of this log, of one night.
    messages
        The folder for the exported messages; those that it has are used.
    medians
        Whether all directions have the median sigmas of the messages' comments, not their own.

    Returns
    -------
    DataFrame
        `object`, `directions`, `enough`: whether it has sensors and seconds enough, `converged`;
        `chi2` and its degrees of `freedom`, `nees`: the squared error over the covariance, over 6,
        and `km`: the error of the position, all null without a fit.
    """
    asked = ["medians"] if medians else []
    return printed_by("orekit_fits", log, dataset, messages, *asked)


def main(log: Path, dataset: Path, messages: Path, *medians: Path) -> None:
    """Print the table of `orekit_fits`."""
    (night,) = (path.name.removeprefix("night=") for path in dataset.glob("night=*"))
    if not messages.exists():
        export(Message.tdm, str(dataset), night, messages)
    example = started_example()
    truth, shown = read_truth(log), objects_shown(log, dataset)
    rows = []
    for path in sorted(messages.glob("*.tdm")):
        if path.with_suffix(".oem").exists():
            continue  # of a sensor: its tracklets that belong to no object
        seen = example.read(path)
        if not medians:
            seen = example.with_own_sigmas(seen, path.stem, dataset)
        seen = example.half_hour(seen)
        arc_s, sensors = max(seen.date).durationFrom(min(seen.date)), len(set(seen.sensor))
        enough = arc_s >= ENOUGH_S and sensors >= ENOUGH_SENSORS
        row = {"object": path.stem, "directions": len(seen.date), "enough": enough}
        rows.append(row | fitted(example, seen, truth, shown[path.stem]))
    print(pl.DataFrame(rows, infer_schema_length=None).write_json())


def objects_shown(log: Path, dataset: Path) -> dict[str, int]:
    """Return which true object each object shows mostly."""
    observations = pl.read_parquet(f"{dataset}/night=*/observations/*.parquet")
    observations = observations.drop_nulls("object_id")
    of = true_objects(with_truth(observations, to_polars(read_truth(log).points)))
    named = observations.select("object_id", shown=pl.Series(of)).filter(pl.col("shown") >= 0)
    return dict(named.group_by("object_id").agg(pl.col("shown").mode().first()).iter_rows())


def fitted(example: SimpleNamespace, seen: Any, truth: Truth, shown: int) -> dict[str, Any]:
    """Return how the fit of one object went."""
    try:
        epoch, state, cov, chi2, freedom = example.fit(seen)
    except example.OrekitException:
        return dict.fromkeys(("chi2", "freedom", "nees", "km")) | {"converged": False}
    at_ns = np.array([np.datetime64(str(epoch).rstrip("Z"), "ns")]).astype(np.int64)
    r_km, v_km_s = locate_objects(truth, np.array([shown]), at_ns)
    error = state - np.hstack([r_km[0], v_km_s[0]])
    nees = float(squared_normalised_errors(error[None], cov[None])[0]) / 6
    km = float(np.linalg.norm(error[:3]))
    return {"chi2": chi2, "freedom": freedom, "nees": nees, "km": km, "converged": True}


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
