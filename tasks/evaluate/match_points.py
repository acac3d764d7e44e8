"""Match centroids with the truth: which star or which object each of them shows."""

from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Measures = dict[str, Any]  # by their names in `Report`

FRAME = ["sensor_id", "frame_number"]
POINT = [*FRAME, "centroid"]
CLAIM = ["epoch", "object_id"]
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
