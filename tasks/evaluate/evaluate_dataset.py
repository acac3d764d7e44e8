"""Evaluate a dataset: compare its tables with the truth of the simulated logs.

A plain function, not a Prefect task, because an evaluation is not scheduled.
"""

import math
from collections.abc import Mapping
from typing import Any

import polars as pl
import pyarrow as pa

from epipole.io.simulation.truth import Truth
from epipole.schemas.bridge import to_polars
from epipole.schemas.evaluation import Report
from epipole.tasks.evaluate.matching import (
    Measures,
    blended_objects,
    detected_objects,
    faulty_sensors,
    match_estimates,
    match_positions,
    match_views,
    possible_estimates,
)
from epipole.tasks.evaluate.measures import (
    measure_associations,
    measure_attitudes,
    measure_coverage,
    measure_ids,
    measure_lost_objects,
    measure_observations,
    measure_orbits,
    measure_positions,
    measure_stars,
    measure_states,
    measure_tracks,
)
from epipole.tasks.evaluate.passages import measure_passages


def evaluate_dataset(tables: Mapping[str, pa.Table], truth: Truth) -> Report:
    """Return the measures of the tables of a dataset against the truth.

    Parameters
    ----------
    tables
        `frames`, `stars`, `tracklets`, `detections`, `epochs`, `associations`, `positions`,
        `observations`, `states`, `orbits` and `identifications` of the nights of the truth.
    truth
        The truth of all logs of these nights.

    Notes
    -----
    An estimate is an object that the dataset reports at an epoch. `Report` defines each measure.
    """
    points = to_polars(truth.points)
    measures = measure_stars(to_polars(tables["stars"]), points)
    measures |= measure_attitudes(to_polars(tables["frames"]), to_polars(truth.frames))
    if truth.scenario["targets"]:
        measures |= _measure_objects(tables, truth, points)
    return Report(**{name: _finite(value) for name, value in measures.items()})


def _measure_objects(
    tables: Mapping[str, pa.Table], truth: Truth, points: pl.DataFrame
) -> Measures:
    detections = detected_objects(to_polars(tables["detections"]), points)
    epochs = to_polars(tables["epochs"])
    views = match_views(to_polars(tables["associations"]), detections, points)
    estimates = match_estimates(views)
    possible = possible_estimates(points, epochs, faulty_sensors(truth))
    blended = blended_objects(points)
    matched = match_positions(tables["positions"], estimates)
    measures = measure_associations(views, estimates, possible, epochs)
    measures |= measure_lost_objects(possible, estimates)
    measures |= measure_positions(tables["positions"], matched, truth, blended)
    n_positions = measures["positions"] + measures["positions_blended"]
    measures |= measure_coverage(n_positions, truth, to_polars(truth.frames), points)
    measures |= measure_ids(matched)
    measures |= measure_observations(tables["observations"], points, matched, truth, blended)
    measures |= measure_states(tables["states"], matched, truth, blended)
    measures |= measure_orbits(tables["orbits"], tables["observations"], points, truth, blended)
    measures |= measure_passages(tables, points, truth)
    return measures | measure_tracks(detections, points)


def _finite(value: Any) -> Any:
    """Return the value, or None where it is not finite: JSON has no infinity."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
