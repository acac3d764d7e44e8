"""Judge tracklets: the outcome of each that was compared with other sensors in a span."""

from collections.abc import Iterable

import polars as pl
import pyarrow as pa
import pyarrow.compute as pc

from epipole.schemas.bridge import empty, from_polars, to_polars
from epipole.schemas.rejects import Outcome
from epipole.schemas.work_tables import TRACKLET_OUTCOMES
from epipole.tasks.common.lone_detections import published_ids

_RANK = {outcome.value: rank for rank, outcome in enumerate(Outcome)}


def judge_tracklets(
    views: pa.Table, left_out: pa.Table, undecided: pa.Table, associations: pa.Table
) -> pa.Table:
    """Return TRACKLET_OUTCOMES of a span. Lone detections, which are not published, have none.

    Parameters
    ----------
    views
        VIEWS that were compared.
    left_out
        VIEWS of sensors that were left out because they are at fault.
    undecided
        Rows of (tracklet_id, outcome), as `associate_objects` returns them.
    associations
        ASSOCIATIONS of the span.
    """
    used = associations["used"]
    ids = associations["tracklet_id"]
    return best_outcomes(
        [
            _outcomes(published_ids(views["tracklet_id"]), Outcome.SEEN_BY_ONE),
            _outcomes(published_ids(left_out["tracklet_id"]), Outcome.SENSOR_LEFT_OUT),
            pa.table({"tracklet_id": published_ids(undecided["tracklet_id"]),
                      "outcome": undecided["outcome"]}),
            _outcomes(ids.filter(used), Outcome.OBJECT),
            _outcomes(ids.filter(pc.invert(used)), Outcome.DISAGREES),
        ]
    )  # fmt: skip


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


def _outcomes(tracklet_id: pa.ChunkedArray, outcome: Outcome) -> pa.Table:
    values = pa.array([outcome.value] * len(tracklet_id), pa.string())
    return pa.table({"tracklet_id": tracklet_id, "outcome": values})
