"""Evaluate a dataset: compare its tables with the truth of the simulated logs.

A plain function, not a Prefect task, because an evaluation is not scheduled.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl
import pyarrow as pa

from epipole.io.simulation.truth import Truth, elements_of
from epipole.schemas.bridge import array, stack, stack_covariance, to_polars
from epipole.schemas.report import Report
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.evaluation import (
    attitude_errors,
    majority,
    pairs_within,
    squared_normalised_errors,
)
from epipole.tasks.algorithms.simulation.orbits import state_at

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Measures = dict[str, Any]

FRAME = ["sensor_id", "frame_number"]
SPOT = [*FRAME, "centroid"]
CLAIM = ["epoch", "object_id"]
STAR, TARGET = 0, 1
WRONG_CROSS_ARCSEC, WRONG_ROLL_ARCSEC = 360.0, 1800.0
INSIDE_99 = 11.345  # chi-square of 3 degrees of freedom


def evaluate_dataset(tables: Mapping[str, pa.Table], truth: Truth) -> Report:
    """Return the measures of the tables of a dataset against the truth.

    Parameters
    ----------
    tables
        `frames`, `stars`, `detections`, `epochs`, `associations` and `positions` of the nights
        of the truth.
    truth
        The truth of all logs of these nights.

    Notes
    -----
    A claim is an object that the dataset reports at an epoch. The true object of a claim is the one
    that most of its views show; with fewer than two views of one true object it is a ghost. A view
    without a centroid (a miss) shows what most detections of its tracklet show. A pair is two views
    of a claim that have centroids. The number of possible pairs is that of any two centroids of one
    object in the frames of an epoch.
    """
    frames, points = to_polars(truth.frames), to_polars(truth.points)
    measures = _stars(to_polars(tables["stars"]), points)
    measures |= _attitudes(to_polars(tables["frames"]), frames)
    if truth.scenario["targets"]:
        detections = to_polars(tables["detections"]).filter(pl.col("kind") == "object")
        detections = detections.drop("kind").join(
            points, on=SPOT, how="left", maintain_order="left"
        )
        claims = _claims(to_polars(tables["associations"]), detections, points)
        of_claims, associations = _associations(claims, to_polars(tables["epochs"]), points)
        measures |= associations
        measures |= _positions(tables["positions"], of_claims, truth)
        measures["positions_per_truth"] = _per_truth(measures["positions"], truth, frames, points)
        measures |= _tracks(detections.drop_nulls("track_id"), points)
    return Report(**measures)


def _share(part: float, whole: float) -> float:
    return part / max(whole, 1)


def _stars(stars: pl.DataFrame, points: pl.DataFrame) -> Measures:
    held = stars.select(*SPOT, "star_id").join(points, on=SPOT, how="inner")
    right = held.filter((pl.col("kind") == STAR) & (pl.col("source") == pl.col("star_id"))).height
    n_true = points.filter(pl.col("kind") == STAR).height
    return {
        "stars_claimed": stars.height,
        "star_precision": _share(right, stars.height),
        "star_recall": _share(right, n_true),
    }


def _attitudes(frames: pl.DataFrame, true: pl.DataFrame) -> Measures:
    once = frames.unique(FRAME, keep="first", maintain_order=True)
    solved = once.filter(pl.col("attitude_source") == "stars").join(
        true, on=FRAME, how="inner", suffix="_true"
    )
    names = ["qx", "qy", "qz", "qw"]
    q_found = solved.select(names).to_numpy()
    q_true = solved.select([f"{name}_true" for name in names]).to_numpy()
    cross, roll = (v / ARCSEC for v in attitude_errors(q_found, q_true))
    roll = np.abs(roll)
    measures: Measures = {
        "frames": frames.height,
        "frames_duplicated": frames.height - once.height,
        "frames_solved": _share(solved.height, true.height),
    }
    if solved.height:
        measures |= {
            "att_cross_arcsec_median": float(np.median(cross)),
            "att_cross_arcsec_p99": float(np.quantile(cross, 0.99)),
            "att_roll_arcsec_median": float(np.median(roll)),
            "att_wrong": int(np.sum((cross > WRONG_CROSS_ARCSEC) | (roll > WRONG_ROLL_ARCSEC))),
        }
    return measures


def _claims(
    associations: pl.DataFrame, detections: pl.DataFrame, points: pl.DataFrame
) -> pl.DataFrame:
    """Return the used views: `claim` is the number of the claim, `target` the true object."""
    tracked = detections.drop_nulls("tracklet_id")
    numbers = tracked.select("tracklet_id").unique(maintain_order=True).with_row_index("number")
    number = tracked.join(numbers, on="tracklet_id", how="left", maintain_order="left")["number"]
    mostly = majority(number.to_numpy().astype(np.int64), _target(tracked), numbers.height)
    numbers = numbers.with_columns(of_tracklet=pl.Series(mostly.value)).drop("number")
    views = associations.filter(pl.col("used"))
    views = views.join(points, on=SPOT, how="left", maintain_order="left")
    views = views.join(numbers, on="tracklet_id", how="left", maintain_order="left")
    views = views.with_columns(
        claim=pl.struct(CLAIM).rank("dense").cast(pl.Int64) - 1,
        has_centroid=pl.col("centroid").is_not_null(),
        target=pl.Series(_target(views), dtype=pl.Int64),
    )
    missed = pl.col("of_tracklet").fill_null(-1)
    views = views.with_columns(target=pl.when("has_centroid").then("target").otherwise(missed))
    # Views with a centroid come first: they decide where two true objects have as many views.
    return views.sort("has_centroid", descending=True, maintain_order=True)


def _target(spots: pl.DataFrame) -> Indices:
    """Return the true object of each spot, -1 where it shows none."""
    of_target = pl.when(pl.col("kind") == TARGET).then("source").otherwise(-1)
    return spots.select(of_target.cast(pl.Int64)).to_series().to_numpy()


def _associations(
    views: pl.DataFrame, epochs: pl.DataFrame, points: pl.DataFrame
) -> tuple[pl.DataFrame, Measures]:
    """Return the true object of each claim (-1: a ghost), and the measures of claims and pairs."""
    claims = views.select(*CLAIM, "claim").unique("claim").sort("claim")
    mostly = majority(_ints(views, "claim"), _ints(views, "target"), claims.height)
    of = np.where(mostly.votes >= 2, mostly.value, -1)
    claims = claims.with_columns(target=pl.Series(of, dtype=pl.Int64))
    with_centroid = views.filter("has_centroid")
    n_pairs, n_right = pairs_within(
        _ints(with_centroid, "claim"), _ints(with_centroid, "target"), claims.height
    )
    possible = points.filter(pl.col("kind") == TARGET).join(epochs, on=FRAME, how="inner")
    possible = possible.group_by("epoch", target="source").len().filter(pl.col("len") >= 2)
    n = _ints(possible, "len")
    recalled = claims.join(possible, on=["epoch", "target"], how="semi").select("epoch", "target")
    return claims, {
        "epochs": epochs["epoch"].n_unique(),
        "groups": claims.height,
        "pair_precision": _share(n_right, n_pairs),
        "pair_recall": _share(n_right, int(np.sum(n * (n - 1) // 2))),
        "object_recall": _share(recalled.unique().height, possible.height),
        "ghosts": int(np.sum(of < 0)),
    }


def _ints(frame: pl.DataFrame, name: str) -> Indices:
    return frame[name].to_numpy().astype(np.int64)


def _positions(positions: pa.Table, claims: pl.DataFrame, truth: Truth) -> Measures:
    rows = to_polars(positions.select(CLAIM))
    rows = rows.join(claims, on=CLAIM, how="left", maintain_order="left")
    target = rows["target"].fill_null(-1).to_numpy()
    real = target >= 0
    measures: Measures = {"positions": int(real.sum()), "positions_of_ghosts": int((~real).sum())}
    if not real.any():
        return measures | {"nees_in_99": 0.0}
    of_real = positions.filter(pa.array(real))
    t_s = (array(of_real, "time") - int(truth.scenario["t0_ns"])) / 1e9
    r_true_km, _ = state_at(elements_of(truth)[target[real]], t_s)
    error = stack(of_real, "{}_km") - r_true_km
    off = np.linalg.norm(error, axis=1)
    nees = squared_normalised_errors(error, stack_covariance(of_real, "cov_{}"))
    x, y, z = np.sqrt(np.mean(error**2, axis=0)).tolist()
    middle = float(np.median(nees))
    ids = rows.filter(pl.Series(real)).group_by("target", "object_id").len()
    ids = ids.group_by("target").agg(
        n=pl.len(), main=pl.col("len").max() / pl.col("len").sum().cast(pl.Float64)
    )
    return measures | {
        "pos_err_km_median": float(np.median(off)),
        "pos_err_km_p95": float(np.quantile(off, 0.95)),
        "pos_err_km_max": float(off.max()),
        "axis_rms_km": (x, y, z),
        "nees_median": middle if np.isfinite(middle) else None,
        "nees_in_99": float(np.mean(nees < INSIDE_99)),
        "ids_per_target": float(np.mean(ids["n"].to_numpy())),
        "longest_id_share": float(np.mean(ids["main"].to_numpy())),
    }


def _per_truth(n: int, truth: Truth, frames: pl.DataFrame, points: pl.DataFrame) -> float:
    """Return the number of positions as a share of the possible ones.

    One is possible per object and frame interval of the slowest sensor, if two sensors see it.
    """
    rate = min(sensor["rate_hz"] for sensor in truth.scenario["sensors"])
    since = pl.col("t_ns") - int(truth.scenario["t0_ns"])
    possible = points.filter(pl.col("kind") == TARGET).join(frames.select(*FRAME, "t_ns"), on=FRAME)
    possible = possible.with_columns(interval=(since * (rate / 1e9)).floor())
    possible = possible.group_by("interval", "source").agg(n=pl.col("sensor_id").n_unique())
    return _share(n, possible.filter(pl.col("n") >= 2).height)


def _tracks(tracked: pl.DataFrame, points: pl.DataFrame) -> Measures:
    if not tracked.height:
        return {"tracks": 0}
    tracks = tracked.select("sensor_id", "track_id").unique(maintain_order=True)
    tracks = tracks.with_row_index("track")
    track = tracked.join(tracks, on=["sensor_id", "track_id"], how="left", maintain_order="left")
    mostly = majority(_ints(track, "track"), _target(track), tracks.height)
    right = int(mostly.votes.sum())
    of = tracks.select("sensor_id", target=pl.Series(mostly.value)).filter(pl.col("target") >= 0)
    each = of.group_by("sensor_id", "target").len()["len"]
    n_true = points.filter(pl.col("kind") == TARGET).height
    return {
        "tracks": tracks.height,
        "track_purity": _share(right, tracked.height),
        "track_completeness": _share(right, n_true),
        "tracks_per_target": float(np.mean(each.to_numpy())) if len(each) else None,
    }
