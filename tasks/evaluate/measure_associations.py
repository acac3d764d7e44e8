"""Measure claims: pairs, ghosts, true objects that were found, and those that were lost."""

import numpy as np
import polars as pl

from epipole.tasks.algorithms.evaluation import pairs_within
from epipole.tasks.evaluate.match_points import Measures, integers, share

LONG_EPOCHS = 10  # an object possible at fewer epochs is not counted as lost
LOST_SHARE = 0.5  # found at a smaller share of its possible epochs: lost


def measure_associations(
    views: pl.DataFrame, claims: pl.DataFrame, possible: pl.DataFrame, epochs: pl.DataFrame
) -> Measures:
    """Return how many pairs of views and how many claims are right.

    A pair is two views of one claim that have centroids. The possible pairs are all pairs of
    centroids of one object in the frames of one epoch.
    """
    with_centroid = views.filter("has_centroid")
    n_pairs, n_right = pairs_within(
        integers(with_centroid, "claim"), integers(with_centroid, "true_object"), claims.height
    )
    n_views = integers(possible, "n_views")
    n_possible = int(np.sum(n_views * (n_views - 1) // 2))
    return {
        "epochs": epochs["epoch"].n_unique(),
        "groups": claims.height,
        "pair_precision": share(n_right, n_pairs),
        "pair_recall": share(n_right, n_possible),
        "object_recall": share(_found(possible, claims).height, possible.height),
        "ghosts": claims.filter(pl.col("true_object") < 0).height,
    }


def measure_lost_objects(possible: pl.DataFrame, claims: pl.DataFrame) -> Measures:
    """Return how many objects two frames show at ten epochs or more, and how many were lost.

    An object is lost where the dataset has it at less than half of these epochs.
    """
    n_found = _found(possible, claims).group_by("true_object").agg(n_found=pl.len())
    objects = possible.group_by("true_object").agg(n_possible=pl.len())
    objects = objects.filter(pl.col("n_possible") >= LONG_EPOCHS)
    objects = objects.join(n_found, on="true_object", how="left")
    is_lost = pl.col("n_found").fill_null(0) < LOST_SHARE * pl.col("n_possible")
    return {
        "objects_seen_by_two": objects.height,
        "objects_lost": objects.filter(is_lost).height,
    }


def _found(possible: pl.DataFrame, claims: pl.DataFrame) -> pl.DataFrame:
    """Return the possible claims that the dataset has."""
    return possible.join(claims, on=["epoch", "true_object"], how="semi")
