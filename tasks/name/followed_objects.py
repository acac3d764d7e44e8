"""Followed objects: those that were followed over midnight, and so keep the id of the night before.

A night is solved with half an hour of the night before. An object there is the same as one of the
published night before, if they share detections.
"""

from collections.abc import Iterable

import polars as pl
import pyarrow as pa

from epipole.schemas.bridge import concat, to_polars
from epipole.schemas.tables import ASSOCIATIONS

_DETECTION = ["sensor_id", "frame_number", "centroid"]
VIEWS = pa.schema([ASSOCIATIONS.field(name) for name in ("object_id", *_DETECTION, "used")])


def followed_objects(own: Iterable[pa.Table], published: pa.Table) -> dict[str, str]:
    """Return the ids of the night before, by this night's names of the same objects.

    Parameters
    ----------
    own
        `VIEWS` before midnight, of this night's solution.
    published
        `VIEWS` of the night before, as published. Views of other times do no harm.

    Notes
    -----
    The object that shares most detections gets the id, if more than half of its detections that
    have an id have this one. No two objects get one id.
    """
    mine, theirs = _detections(concat(VIEWS, own)), _detections(published)
    shared = mine.join(theirs.rename({"object_id": "id"}), on=_DETECTION)
    counts = shared.group_by("object_id", "id").len()
    counts = counts.with_columns(share=pl.col("len") / pl.col("len").sum().over("object_id"))
    claims = counts.filter(pl.col("share") > 0.5).sort(
        "len", "id", "object_id", descending=[True, False, False]
    )
    first = claims.unique("id", keep="first", maintain_order=True)
    return dict(zip(first["object_id"], first["id"], strict=True))


def _detections(views: pa.Table) -> pl.DataFrame:
    """Return the detections that positions were solved with, each once, and their objects."""
    used = to_polars(views).filter("used").drop_nulls("centroid")
    return used.select("object_id", *_DETECTION).unique(maintain_order=True)
