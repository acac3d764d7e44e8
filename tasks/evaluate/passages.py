"""Measure passages: what becomes of each passage of an object through the field of a sensor.

Most passages of a constellation are seen by one sensor only, so neither estimates nor positions
show how many are found.
"""

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
import polars as pl
import pyarrow as pa

from epipole.io.simulation.truth import Truth
from epipole.schemas.bridge import to_polars
from epipole.tasks.evaluate.matching import (
    FRAME,
    OBJECT,
    POINT,
    Array,
    Measures,
    integers,
    locate_objects,
    share,
    with_truth,
)

# What the measures are defined by, as in the independent tool that the tests compare them with.
MAX_GAP_NS = 2_000_000_000  # a longer gap begins another passage
MIN_FRAMES = 5  # of a passage
FAST_DEG_S = 2.0
MAIN_SHARE = 0.5  # of the detections that a tracklet or an object must have


def measure_passages(
    tables: Mapping[str, pa.Table], points: pl.DataFrame, truth: Truth
) -> Measures:
    """Return how many passages have a tracklet, observations, and the same id as another one.

    Parameters
    ----------
    tables
        `detections`, `tracklets`, `observations` and `identifications`.
    points
        The centroids of the truth.
    """
    shown = _shown_in_passages(points, to_polars(truth.frames))
    if not shown.height:
        return {}
    detections = to_polars(tables["detections"]).drop_nulls("tracklet_id")
    passages = _passages(shown, detections, to_polars(tables["observations"]), truth)
    tracklets = _objects_of_tracklets(detections, points)
    ids = to_polars(tables["tracklets"]).select("tracklet_id", "object_id").drop_nulls()
    fast = passages.filter(pl.col("rate_deg_s") > FAST_DEG_S)
    return {
        "passages": passages.height,
        "passages_tracked": _share_with_tracklet(passages),
        "passages_fast": fast.height,
        "passages_fast_tracked": _share_with_tracklet(fast),
        "passages_observed": _mean(passages["n_observed"] >= MAIN_SHARE * passages["n"]),
        "detections_observed": share(
            int(integers(passages, "n_observed").sum()), int(integers(passages, "n").sum())
        ),
        "tracklets": tracklets.height,
        "tracklets_false": tracklets.filter(pl.col("true_object") < 0).height,
        "joined_wrong": _joined_wrong(tracklets, ids),
        **_joined(passages, ids, truth),
        **_named(tracklets, ids, to_polars(tables["identifications"]), truth),
    }


def _shown_in_passages(points: pl.DataFrame, frames: pl.DataFrame) -> pl.DataFrame:
    """Return the centroids of objects with the number of their `passage`."""
    shown = points.filter(pl.col("kind") == OBJECT).join(frames, on=FRAME)
    shown = shown.sort("sensor_id", "source", "t_ns")
    begins = (
        (pl.col("t_ns").diff() > MAX_GAP_NS)
        | (pl.col("sensor_id") != pl.col("sensor_id").shift())
        | (pl.col("source") != pl.col("source").shift())
    )
    shown = shown.with_columns(passage=begins.fill_null(True).cast(pl.Int64).cum_sum())
    return shown.filter(pl.len().over("passage") >= MIN_FRAMES)


def _passages(
    shown: pl.DataFrame, detections: pl.DataFrame, observations: pl.DataFrame, truth: Truth
) -> pl.DataFrame:
    """Return a row per passage: sensor, object, rate, its main tracklet, how much is observed."""
    observed = observations.select(POINT).unique().with_columns(is_observed=True)
    shown = shown.with_columns(direction=pl.Series(_directions(shown, truth)))
    shown = shown.join(detections.select(*POINT, "tracklet_id"), on=POINT, how="left")
    shown = shown.join(observed, on=POINT, how="left").sort("passage", "t_ns", maintain_order=True)
    per_passage = shown.group_by("passage", maintain_order=True).agg(
        pl.col("sensor_id").first(),
        true_object=pl.col("source").first(),
        n=pl.len(),
        n_observed=pl.col("is_observed").fill_null(False).sum(),
        first=pl.col("direction").first(),
        last=pl.col("direction").last(),
        lasts_s=(pl.col("t_ns").last() - pl.col("t_ns").first()) / 1e9,
    )
    cosine = np.einsum("ni,ni->n", *(per_passage[end].to_numpy() for end in ("first", "last")))
    turned_deg = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    rate_deg_s = turned_deg / np.maximum(per_passage["lasts_s"].to_numpy(), 1e-9)
    counts = shown.drop_nulls("tracklet_id").group_by("passage", "tracklet_id").len()
    main = counts.sort("len", "tracklet_id", descending=[True, False]).unique(
        "passage", keep="first", maintain_order=True
    )
    found = per_passage.join(main, on="passage", how="left", maintain_order="left")
    is_main = pl.col("len") >= MAIN_SHARE * pl.col("n")
    return found.with_columns(
        rate_deg_s=pl.Series(rate_deg_s), tracklet_id=pl.when(is_main).then("tracklet_id")
    )


def _directions(shown: pl.DataFrame, truth: Truth) -> Array:
    """Return unit vectors from the sensor to where the object is at the time of each row."""
    r_km, _ = locate_objects(truth, integers(shown, "source"), integers(shown, "t_ns"))
    line_km = r_km - shown.select("x", "y", "z").to_numpy()
    return np.asarray(line_km / np.linalg.norm(line_km, axis=1)[:, None])


def _objects_of_tracklets(detections: pl.DataFrame, points: pl.DataFrame) -> pl.DataFrame:
    """Return each tracklet with the object that at least half of its detections show, else -1."""
    rows = with_truth(detections.select(*POINT, "tracklet_id"), points)
    is_object = pl.col("kind") == OBJECT
    most = pl.col("source").filter(is_object).mode().sort().first()
    tracklets = rows.group_by("tracklet_id").agg(
        n=pl.len(), true_object=most, votes=(is_object & (pl.col("source") == most)).sum()
    )
    is_main = pl.col("votes") >= MAIN_SHARE * pl.col("n")
    return tracklets.select(
        "tracklet_id",
        true_object=pl.when(is_main).then("true_object").otherwise(-1).fill_null(-1),
    )


def _joined_wrong(tracklets: pl.DataFrame, ids: pl.DataFrame) -> int:
    joined = ids.join(tracklets, on="tracklet_id")
    main = pl.col("true_object").mode().sort().first().over("object_id")
    return joined.filter(pl.col("true_object") != main).height


def _joined(passages: pl.DataFrame, ids: pl.DataFrame, truth: Truth) -> Measures:
    """Return the pairs of passages of an object through different satellites, and those joined."""
    satellite = {s["id"]: s.get("sat", s["id"]) for s in truth.scenario["sensors"] if "id" in s}
    tracked = passages.drop_nulls("tracklet_id").join(ids, on="tracklet_id", how="left")
    n_pairs = n_joined = 0
    for _, of_object in tracked.group_by("true_object"):
        rows = of_object.select("sensor_id", "object_id").rows()
        for (a, id_a), (b, id_b) in itertools.combinations(rows, 2):
            if satellite[a] != satellite[b]:
                n_pairs += 1
                n_joined += id_a is not None and id_a == id_b
    return {"passage_pairs": n_pairs, "passages_joined": n_joined / n_pairs if n_pairs else None}


def _named(
    tracklets: pl.DataFrame, ids: pl.DataFrame, identifications: pl.DataFrame, truth: Truth
) -> Measures:
    """Return how many tracklets have the catalogue number of their object, and another one."""
    numbers = _catalogue_numbers(truth.scenario["targets"])
    if not numbers:
        return {}
    known = identifications.filter(pl.col("status") == "known")
    of_objects = known.drop_nulls("object_id").unique("object_id", keep="last")
    of_tracklets = known.drop_nulls("tracklet_id").select("tracklet_id", of_it="norad_id")
    named = (
        tracklets.join(ids, on="tracklet_id", how="left")
        .join(of_objects.select("object_id", "norad_id"), on="object_id", how="left")
        .join(of_tracklets, on="tracklet_id", how="left")
        .select("true_object", norad_id=pl.coalesce("of_it", "norad_id"))
        .drop_nulls("norad_id")
    )
    right = sum(numbers.get(k) == n for k, n in named.iter_rows())
    n_real = tracklets.filter(pl.col("true_object") >= 0).height
    return {"named_right": share(right, n_real), "named_wrong": named.height - right}


def _catalogue_numbers(targets: list[dict[str, Any]]) -> dict[int, int]:
    """Return the catalogue numbers of the true objects that have one."""
    found = {}
    for k, target in enumerate(targets):
        number = target.get("norad", target.get("norad_id"))
        if number is not None:
            found[target.get("object", k)] = number
    return found


def _share_with_tracklet(passages: pl.DataFrame) -> float | None:
    return _mean(passages["tracklet_id"].is_not_null())


def _mean(values: pl.Series) -> float | None:
    return float(values.to_numpy().mean()) if len(values) else None
