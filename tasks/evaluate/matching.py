"""Match a dataset with the truth: centroids, objects at each epoch, positions of true objects."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import polars as pl
import pyarrow as pa

from epipole.io.simulation.truth import Truth, elements_of
from epipole.schemas.arrays import Array, Indices
from epipole.schemas.bridge import array, stack, to_polars
from epipole.tasks.algorithms.evaluation import SampledOrbits, interpolate_orbits, majority
from epipole.tasks.algorithms.simulation.paths import state_at

# Centroids: which star or object each shows.

Measures = dict[str, Any]  # by their names in `Report`

FRAME = ["sensor_id", "frame_number"]
POINT = [*FRAME, "centroid"]
ESTIMATE = ["epoch", "object_id"]
STAR, OBJECT = 0, 1  # values of `kind` in the truth


def with_truth(rows: pl.DataFrame, points: pl.DataFrame) -> pl.DataFrame:
    """Return rows that name a centroid, with the `kind` and `source` that the truth gives it.

    Both are null where the truth does not have the centroid. The order of the rows is kept.
    """
    return rows.join(points, on=POINT, how="left", maintain_order="left")


def true_objects(rows: pl.DataFrame) -> Indices:
    """Return the true object of each row of `with_truth`, -1 where it shows no object."""
    of_object = pl.when(pl.col("kind") == OBJECT).then("source").otherwise(-1)
    return rows.select(of_object.cast(pl.Int64)).to_series().to_numpy()


def detected_objects(detections: pl.DataFrame, points: pl.DataFrame) -> pl.DataFrame:
    """Return the detections that the dataset calls objects, as `with_truth` returns them."""
    called = detections.filter(pl.col("kind") == "object").drop("kind")
    return with_truth(called, points)


def integers(rows: pl.DataFrame, name: str) -> Indices:
    """Return a column as an int64 array."""
    return rows[name].to_numpy().astype(np.int64)


def share(part: float, whole: float) -> float:
    """Return part / whole, and 0 where both are 0."""
    return part / max(whole, 1)


# Objects: the true object of each one that the dataset reports at an epoch.

MIN_VIEWS = 2  # of one true object; with fewer an estimate is a ghost


def match_views(
    associations: pl.DataFrame, detections: pl.DataFrame, points: pl.DataFrame
) -> pl.DataFrame:
    """Return the used views: `estimate` numbers the estimates, `true_object` is what a view shows.

    A view without a centroid (a miss) shows what most detections of its tracklet show.
    `true_object` is -1 where that is not an object. `detections` are those of `detected_objects`.
    """
    views = with_truth(associations.filter(pl.col("used")), points)
    views = views.with_columns(
        estimate=pl.struct(ESTIMATE).rank("dense").cast(pl.Int64) - 1,
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
    return _with_hidden_objects(views.sort("has_centroid", descending=True, maintain_order=True))


def _with_hidden_objects(views: pl.DataFrame) -> pl.DataFrame:
    """Let a centroid with the light of two objects show the one that its estimate is of."""
    hidden = views.filter(pl.col("has_centroid") & (pl.col("also") >= 0))
    if not hidden.height:
        return views
    either = pl.concat(
        [views.select("estimate", "true_object"), hidden.select("estimate", true_object="also")]
    )
    n_estimates = int(integers(views, "estimate").max()) + 1
    most = majority(integers(either, "estimate"), integers(either, "true_object"), n_estimates)
    of_estimate = pl.Series(most.value[integers(views, "estimate")], dtype=pl.Int64)
    is_hidden = pl.col("has_centroid") & (pl.col("also") == of_estimate) & (of_estimate >= 0)
    return views.with_columns(
        true_object=pl.when(is_hidden.fill_null(False)).then(of_estimate).otherwise("true_object")
    )


def blended_objects(points: pl.DataFrame) -> list[int]:
    """Return the objects that share a centroid with another object in some frame.

    Such a centroid is the centre of both lights: the errors of these objects are not measured.
    """
    blended = points.filter(pl.col("also") >= 0)
    of_objects = blended.filter(pl.col("kind") == OBJECT)["source"]
    return sorted({*of_objects.to_list(), *blended["also"].to_list()})


def faulty_sensors(truth: Truth) -> list[str]:
    """Return the sensors whose clock, ephemeris or prior attitude the truth calls wrong.

    What they show may be found, but is not expected to be.
    """
    return [
        sensor["id"]
        for sensor in truth.scenario["sensors"]
        if sensor.get("clock_s")
        or any(sensor.get("pos_off_km") or [0])
        or sensor.get("prior_bias_vec_arcsec") is not None
    ]


def _match_tracklets(detections: pl.DataFrame) -> pl.DataFrame:
    """Return each `tracklet_id` with the object that most of its detections show, or -1."""
    tracked = detections.drop_nulls("tracklet_id")
    tracklets = tracked.select("tracklet_id").unique(maintain_order=True).with_row_index("number")
    tracked = tracked.join(tracklets, on="tracklet_id", how="left", maintain_order="left")
    most = majority(integers(tracked, "number"), true_objects(tracked), tracklets.height)
    return tracklets.select("tracklet_id", by_tracklet=pl.Series(most.value))


def match_estimates(views: pl.DataFrame) -> pl.DataFrame:
    """Return the estimates in the order of their numbers, each with its `true_object`.

    `true_object` is the one that most views of the estimate show; -1 (a ghost) where fewer than two
    views show it.
    """
    estimates = views.select(*ESTIMATE, "estimate").unique("estimate").sort("estimate")
    most = majority(integers(views, "estimate"), integers(views, "true_object"), estimates.height)
    of_estimate = np.where(most.votes >= MIN_VIEWS, most.value, -1)
    return estimates.with_columns(true_object=pl.Series(of_estimate, dtype=pl.Int64))


def possible_estimates(
    points: pl.DataFrame, epochs: pl.DataFrame, faulty: Sequence[str] = ()
) -> pl.DataFrame:
    """Return `epoch`, `true_object` and `n_views` where two frames or more show the object.

    Frames of `faulty` sensors are not counted.
    """
    sound = epochs.filter(~pl.col("sensor_id").is_in(list(faulty)))
    shown = points.filter(pl.col("kind") == OBJECT).join(sound, on=FRAME, how="inner")
    n_views = shown.group_by("epoch", true_object="source").agg(n_views=pl.len())
    return n_views.filter(pl.col("n_views") >= MIN_VIEWS)


def match_positions(positions: pa.Table, estimates: pl.DataFrame) -> pl.DataFrame:
    """Return `epoch`, `object_id` and `true_object` of each position, in the order of the rows.

    `true_object` is -1 where the estimate of the position is a ghost or missing.
    """
    rows = to_polars(positions.select(ESTIMATE))
    rows = rows.join(estimates, on=ESTIMATE, how="left", maintain_order="left")
    return rows.select(*ESTIMATE, pl.col("true_object").fill_null(-1))


# Positions and velocities of true objects.


def locate_objects(truth: Truth, objects: Indices, time_ns: Indices) -> tuple[Array, Array]:
    """Return the position and velocity of a true object at a time, for each row.

    Objects move by the sampled orbits of the truth where it has them, else by their elements.

    Parameters
    ----------
    objects : (n,) int
        Numbers of true objects, 0 or more.
    time_ns : (n,) int
        UTC since 1970 [ns].

    Returns
    -------
    r_km, v_km_s : (n, 3) float
        GCRF [km and km/s].
    """
    t0_ns = int(truth.scenario["t0_ns"])
    t_s = (time_ns - t0_ns) / 1e9
    if truth.orbits is None:
        return state_at(elements_of(truth)[objects], t_s)
    return interpolate_orbits(_sampled(truth.orbits, t0_ns), objects, t_s)


def _sampled(orbits: pa.Table, t0_ns: int) -> SampledOrbits:
    number, time_ns = array(orbits, "object"), array(orbits, "t_ns")
    order = np.lexsort((time_ns, number))
    return SampledOrbits(
        object=number[order],
        t_s=(time_ns[order] - t0_ns) / 1e9,
        r_km=stack(orbits, "{}")[order],
        v_km_s=stack(orbits, "v{}")[order],
    )
