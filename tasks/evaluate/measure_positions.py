"""Measure positions: errors, whether covariances agree with them, and what ids stand for."""

import numpy as np
import polars as pl
import pyarrow as pa

from epipole.io.simulation.truth import Truth
from epipole.schemas.bridge import array, stack, stack_covariance
from epipole.tasks.algorithms.evaluation import (
    count_changes,
    mean_of_group_means,
    squared_normalised_errors,
)
from epipole.tasks.evaluate.locate_objects import locate_objects
from epipole.tasks.evaluate.match_points import FRAME, OBJECT, Measures, integers, share

INSIDE_99 = 11.345  # 99 % of the chi-square of 3 degrees of freedom
AXES = 3


def measure_positions(positions: pa.Table, matched: pl.DataFrame, truth: Truth) -> Measures:
    """Return the number and the errors of positions of true objects.

    Parameters
    ----------
    positions
        POSITIONS.
    matched
        The rows of `match_positions`, in the same order.
    """
    of_object = integers(matched, "true_object")
    real = of_object >= 0
    counts = {"positions": int(real.sum()), "positions_of_ghosts": int((~real).sum())}
    if not real.any():
        return counts | {"nees_in_99": 0.0}
    positions, of_object = positions.filter(pa.array(real)), of_object[real]
    r_true_km, _ = locate_objects(truth, of_object, array(positions, "time"))
    error_km = stack(positions, "{}_km") - r_true_km
    distance_km = np.linalg.norm(error_km, axis=1)
    nees = squared_normalised_errors(error_km, stack_covariance(positions, "cov_{}"))
    mean, sigma = mean_of_group_means(of_object, nees / AXES)
    return counts | {
        "pos_err_km_median": float(np.median(distance_km)),
        "pos_err_km_p95": float(np.quantile(distance_km, 0.95)),
        "pos_err_km_max": float(distance_km.max()),
        "axis_rms_km": tuple(np.sqrt(np.mean(error_km**2, axis=0)).tolist()),
        "nees_median": float(np.median(nees)),
        "nees_in_99": float(np.mean(nees < INSIDE_99)),
        "nees_mean": mean,
        "nees_mean_sigma": sigma,
    }


def measure_ids(matched: pl.DataFrame) -> Measures:
    """Return how many ids true objects have, and how often an id passes to another object.

    `matched` are the rows of `match_positions`.
    """
    real = matched.filter(pl.col("true_object") >= 0).sort("object_id", "epoch", "true_object")
    ids = real["object_id"].rank("dense").to_numpy().astype(np.int64)
    swaps = {"id_swaps": count_changes(ids, integers(real, "true_object"))}
    if not real.height:
        return swaps
    per_id = real.group_by("true_object", "object_id").agg(n=pl.len())
    of_object = per_id.group_by("true_object").agg(
        ids=pl.len(), main=pl.col("n").max() / pl.col("n").sum().cast(pl.Float64)
    )
    return swaps | {
        "ids_per_target": float(np.mean(of_object["ids"].to_numpy())),
        "longest_id_share": float(np.mean(of_object["main"].to_numpy())),
    }


def measure_coverage(n: int, truth: Truth, frames: pl.DataFrame, points: pl.DataFrame) -> Measures:
    """Return the number `n` of positions as a share of the possible ones.

    A position is possible per object and frame interval of the slowest sensor, if two sensors
    see the object in it.
    """
    rate_hz = min(sensor["rate_hz"] for sensor in truth.scenario["sensors"])
    since_ns = pl.col("t_ns") - int(truth.scenario["t0_ns"])
    shown = points.filter(pl.col("kind") == OBJECT).join(frames.select(*FRAME, "t_ns"), on=FRAME)
    shown = shown.with_columns(interval=(since_ns * (rate_hz / 1e9)).floor())
    n_sensors = shown.group_by("interval", "source").agg(n=pl.col("sensor_id").n_unique())
    return {"positions_per_truth": share(n, n_sensors.filter(pl.col("n") >= 2).height)}
