"""Judge tracklets: the outcome of each that was compared with other sensors in a span."""

from collections.abc import Iterable

import polars as pl
import pyarrow as pa
import pyarrow.compute as pc

from epipole.schemas.bridge import empty, from_polars, table, to_polars
from epipole.schemas.rejects import Outcome
from epipole.schemas.work_tables import TRACKLET_OUTCOMES
from epipole.tasks.common.lone_detections import published_ids

_RANK = {outcome.value: rank for rank, outcome in enumerate(Outcome)}


def judge_views(associations: pa.Table) -> pa.Table:
    """Return TRACKLET_OUTCOMES of the views of objects: used by a position, or rejected.

    Lone detections, which are not published, have none.
    """
    used, ids = associations["used"], associations["tracklet_id"]
    return best_outcomes(
        [
            outcomes(ids.filter(used), Outcome.OBJECT),
            outcomes(ids.filter(pc.invert(used)), Outcome.DISAGREES),
        ]
    )


def best_outcomes(tables: Iterable[pa.Table]) -> pa.Table:
    """Return TRACKLET_OUTCOMES of several tables: of each tracklet the first in `Outcome`."""
    rows = pl.concat(
        to_polars(rows).select("tracklet_id", "outcome")
        for rows in (empty(TRACKLET_OUTCOMES), *tables)
    )
    best = (
        rows.drop_nulls("tracklet_id")
        .with_columns(rank=pl.col("outcome").replace_strict(_RANK, return_dtype=pl.Int64))
        .sort("tracklet_id", "rank")
        .unique("tracklet_id", keep="first", maintain_order=True)
    )
    return from_polars(TRACKLET_OUTCOMES, best)


def outcomes(tracklet_id: pa.ChunkedArray, outcome: Outcome) -> pa.Table:
    """Return TRACKLET_OUTCOMES: one outcome for all these tracklets, lone detections excepted."""
    ids = pc.unique(published_ids(tracklet_id)).drop_null()
    values = pa.array([outcome.value] * len(ids), pa.string())
    return table(TRACKLET_OUTCOMES, {"tracklet_id": ids, "outcome": values})
