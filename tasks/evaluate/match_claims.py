"""Match claims with the truth: the true object of each object reported at an epoch."""

import numpy as np
import polars as pl
import pyarrow as pa

from epipole.schemas.bridge import to_polars
from epipole.tasks.algorithms.evaluation import majority
from epipole.tasks.evaluate.match_points import (
    CLAIM,
    FRAME,
    OBJECT,
    integers,
    true_objects,
    with_truth,
)

FEWEST_VIEWS = 2  # of one true object; with fewer a claim is a ghost


def match_views(
    associations: pl.DataFrame, detections: pl.DataFrame, points: pl.DataFrame
) -> pl.DataFrame:
    """Return the used views: `claim` numbers the claims, `true_object` is what the view shows.

    A view without a centroid (a miss) shows what most detections of its tracklet show.
    `true_object` is -1 where that is no object. `detections` are those of `detected_objects`.
    """
    views = with_truth(associations.filter(pl.col("used")), points)
    views = views.with_columns(
        claim=pl.struct(CLAIM).rank("dense").cast(pl.Int64) - 1,
        has_centroid=pl.col("centroid").is_not_null(),
        by_centroid=pl.Series(true_objects(views), dtype=pl.Int64),
    )
    views = views.join(
        _match_tracklets(detections), on="tracklet_id", how="left", maintain_order="left"
    )
    by_tracklet = pl.col("by_tracklet").fill_null(-1)
    views = views.with_columns(
        true_object=pl.when("has_centroid").then("by_centroid").otherwise(by_tracklet)
    )
    # Views with a centroid come first: they decide where two true objects have as many views.
    return views.sort("has_centroid", descending=True, maintain_order=True)


def _match_tracklets(detections: pl.DataFrame) -> pl.DataFrame:
    """Return each `tracklet_id` with the object that most of its detections show, or -1."""
    tracked = detections.drop_nulls("tracklet_id")
    tracklets = tracked.select("tracklet_id").unique(maintain_order=True).with_row_index("number")
    tracked = tracked.join(tracklets, on="tracklet_id", how="left", maintain_order="left")
    most = majority(integers(tracked, "number"), true_objects(tracked), tracklets.height)
    return tracklets.select("tracklet_id", by_tracklet=pl.Series(most.value))


def match_claims(views: pl.DataFrame) -> pl.DataFrame:
    """Return the claims in the order of their numbers, each with its `true_object`.

    `true_object` is the one that most views of the claim show; -1 (a ghost) where fewer than two
    views show it.
    """
    claims = views.select(*CLAIM, "claim").unique("claim").sort("claim")
    most = majority(integers(views, "claim"), integers(views, "true_object"), claims.height)
    of_claim = np.where(most.votes >= FEWEST_VIEWS, most.value, -1)
    return claims.with_columns(true_object=pl.Series(of_claim, dtype=pl.Int64))


def possible_claims(points: pl.DataFrame, epochs: pl.DataFrame) -> pl.DataFrame:
    """Return `epoch`, `true_object` and `n_views` where two frames or more show the object."""
    shown = points.filter(pl.col("kind") == OBJECT).join(epochs, on=FRAME, how="inner")
    n_views = shown.group_by("epoch", true_object="source").agg(n_views=pl.len())
    return n_views.filter(pl.col("n_views") >= FEWEST_VIEWS)


def match_positions(positions: pa.Table, claims: pl.DataFrame) -> pl.DataFrame:
    """Return `epoch`, `object_id` and `true_object` of each position, in the order of the rows.

    `true_object` is -1 where the claim of the position is a ghost or missing.
    """
    rows = to_polars(positions.select(CLAIM))
    rows = rows.join(claims, on=CLAIM, how="left", maintain_order="left")
    return rows.select(*CLAIM, pl.col("true_object").fill_null(-1))
