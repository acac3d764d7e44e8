"""Associate blocks: the objects of each block of time, and the outcome of each tracklet.

1. The views of all sensors in a block are read.
2. Views of each window of time are associated (`associate_objects`).
3. Each tracklet without an object gets an outcome: ambiguous, undecided, seen by one sensor, or
   of a sensor that is left out.
4. Members of objects, outcomes and rejects are written as parts.
"""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.work.kept_parts import part_key
from epipole.io.work.parts import ASSOCIATED, Parts, write_part
from epipole.io.work.work_layout import NOTHING_ADDED, AddedErrors, ViewedParts
from epipole.schemas.bridge import array, concat, empty, from_polars, table, to_polars
from epipole.schemas.rejects import Outcome, Reason, reject_rows
from epipole.schemas.settings import AssociationSettings
from epipole.schemas.spans import BLOCK_NS, Sensor, Span
from epipole.schemas.stages import Stage
from epipole.schemas.tables import REJECTS
from epipole.schemas.work_tables import OBJECT_MEMBERS, TRACKLET_OUTCOMES
from epipole.tasks.common.grouping import group_offsets
from epipole.tasks.common.sightings import published_ids
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.solve.associate_objects import Associated, associate_objects
from epipole.tasks.solve.association_input import BlockViews, SensorViews
from epipole.tasks.solve.view_groups import with_added_errors

_RANK = {outcome.value: rank for rank, outcome in enumerate(Outcome)}


def view_outcomes(associations: pa.Table) -> pa.Table:
    """Return TRACKLET_OUTCOMES of the views of objects: used by a position, or rejected.

    Lone detections are left out: they are not published.
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
    """Return TRACKLET_OUTCOMES: one outcome for all these tracklets, without lone detections."""
    ids = pc.unique(published_ids(tracklet_id)).drop_null()
    values = pa.array([outcome.value] * len(ids), pa.string())
    return table(TRACKLET_OUTCOMES, {"tracklet_id": ids, "outcome": values})


@stage_task(Stage.SOLVE, "objects {blocks[0]}")
def associate_blocks(
    sensors: Sequence[Sensor],
    viewed: ViewedParts,
    blocks: Sequence[Span],
    cameras: pa.Table,
    left_out: Mapping[str, Reason],
    settings: AssociationSettings,
    half_width_s: float,
    max_views: int,
    parts: Parts,
    added: AddedErrors = NOTHING_ADDED,
) -> None:
    """Find the objects of some blocks of one span, unless the parts exist.

    Parameters
    ----------
    sensors
        In the order of their ids.
    viewed
        The parts of their views.
    left_out
        Sensors at fault, each with its reason; their views are not used.
    half_width_s
        Time on each side of an epoch in which the direction of a view was fitted.
    max_views
        Limit of the views that a task has in memory at the same time.
    parts
        Where the parts go: `ASSOCIATED` of each block.
    added
        Errors that sensors have beside the stated ones.
    """
    missing = [block for block in blocks if not parts.holds(block)]
    span = blocks[0].span
    seeing = [sensor for sensor in sensors if viewed[sensor.number].holds(span)]
    read = [viewed[sensor.number].of(span) for sensor in seeing] if missing else []
    of_span = part_key([seeing, left_out, added], parts=read)
    for block in missing:
        key = None if of_span is None else part_key([Stage.SOLVE, block, of_span])
        if not parts.take(block, key):
            views = [
                sensor_views(sensor, viewed[sensor.number], block.span, added) for sensor in seeing
            ]
            taking_part = [
                sensor
                for sensor in views
                if sensor.sensor_id not in left_out and sensor.epochs.num_rows
            ]
            block_views = None
            if any(sensor.tracklets.num_rows for sensor in taking_part):
                block_views = BlockViews(
                    taking_part, cameras, block, settings.window_s, half_width_s
                )
            tables = _associate(block_views, settings, max_views)
            faulty = [sensor for sensor in views if sensor.sensor_id in left_out]
            tables = _with_faulty(tables, faulty, block, left_out)
            write_part(parts.of(block), ASSOCIATED, tables, key=key)


def blocks_of(span: Span, settings: AssociationSettings) -> list[Span]:
    """Return the blocks of a span, or the span itself if windows are longer than a block."""
    return [span] if settings.window_s * 1e9 > BLOCK_NS else span.blocks


def sensor_views(
    sensor: Sensor,
    viewed: Parts,
    span: Span,
    added: AddedErrors = NOTHING_ADDED,
) -> SensorViews:
    """Return the views of a sensor in a span, mapped into memory."""
    return SensorViews(
        sensor.number,
        sensor.sensor_id,
        lambda: with_added_errors(viewed.read(span, "views"), added),
        viewed.read(span, "epochs"),
        viewed.read(span, "tracklets"),
    )


def _associate(
    block: BlockViews | None, settings: AssociationSettings, max_views: int
) -> dict[str, pa.Table]:
    """Return the tables of a block; empty ones for a block without views."""
    if block is None:
        schemas = {"members": OBJECT_MEMBERS, "rejects": REJECTS, "outcomes": TRACKLET_OUTCOMES}
        return {name: empty(schema) for name, schema in schemas.items()}
    associated = associate_objects(block, settings, max_views)
    return {
        "members": object_members(block, associated),
        "rejects": associated.rejects,
        "outcomes": best_outcomes(_item_outcomes(block, associated)),
    }


def _with_faulty(
    tables: Mapping[str, pa.Table],
    faulty: Sequence[SensorViews],
    block: Span,
    left_out: Mapping[str, Reason],
) -> dict[str, pa.Table]:
    """Return the tables of a block with the rejects and outcomes of the sensors at fault."""
    outcomes_of_faulty = _sensor_outcomes(faulty, Outcome.SENSOR_LEFT_OUT)
    return {
        "members": tables["members"],
        "rejects": concat(REJECTS, [_rejects(faulty, block, left_out), tables["rejects"]]),
        "outcomes": best_outcomes([outcomes_of_faulty, tables["outcomes"]]),
    }


def object_members(block: BlockViews, associated: Associated) -> pa.Table:
    """Return OBJECT_MEMBERS of a block: successive windows of one object and tracklet are a row."""
    items, number = block.items, associated.object_number
    order = np.lexsort((items.window, items.tracklet))
    tracklet, object_ = items.tracklet[order], number[order]
    bounds = group_offsets(tracklet, object_)
    first, last = bounds[:-1], bounds[1:] - 1
    n_views = np.add.reduceat(items.n_views[order], first) if len(first) else first
    rows = np.flatnonzero(object_[first] >= 0)
    rows = rows[np.lexsort((tracklet[first[rows]], object_[first[rows]]))]
    first, last, n_views = first[rows], last[rows], n_views[rows]
    numbers = np.array([sensor.number for sensor in block.sensors])
    of_tracklet = block.tracklets.take(tracklet[first])
    return table(
        OBJECT_MEMBERS,
        {
            "object": object_[first],
            "sensor": numbers[items.sensor[order][first]],
            "tracklet_id": of_tracklet["tracklet_id"],
            "track_id": of_tracklet["track_id"],
            "first_epoch": items.first_ns[order][first],
            "last_epoch": items.last_ns[order][last],
            "n_views": n_views,
            "piece": np.zeros(len(first), np.int64),
        },
    )


def _item_outcomes(block: BlockViews, associated: Associated) -> list[pa.Table]:
    """Return the outcomes of the tracklets of a block, except those of objects."""
    tracklet = block.items.tracklet
    agreeing = associated.agreeing

    def outcomes_of(rows: np.ndarray, outcome: Outcome) -> pa.Table:
        ids = block.tracklets["tracklet_id"].take(np.unique(tracklet[rows]))
        return outcomes(ids, outcome)

    return [
        outcomes_of(np.ones(len(tracklet), bool), Outcome.SEEN_BY_ONE),
        outcomes_of(associated.undecided & agreeing, Outcome.UNDECIDED),
        outcomes_of(associated.ambiguous & agreeing, Outcome.AMBIGUOUS),
        outcomes_of(~agreeing, Outcome.SENSOR_LEFT_OUT),
    ]


def _sensor_outcomes(sensors: Sequence[SensorViews], outcome: Outcome) -> pa.Table:
    """Return TRACKLET_OUTCOMES: the same outcome for all tracklets of some sensors."""
    tables = [outcomes(sensor.tracklets["tracklet_id"], outcome) for sensor in sensors]
    return concat(TRACKLET_OUTCOMES, tables)


def _rejects(
    sensors: Sequence[SensorViews], block: Span, left_out: Mapping[str, Reason]
) -> pa.Table:
    """Return a row of `rejects` per sensor that is left out, with the number of its views."""
    tables = [empty(REJECTS)]
    for sensor in sensors:
        epoch_ns = array(sensor.read_views(), "epoch")
        epoch_ns = epoch_ns[block.holds(epoch_ns)]
        if len(epoch_ns):
            tables.append(
                reject_rows(
                    left_out[sensor.sensor_id],
                    sensor_id=sensor.sensor_id,
                    time=[int(epoch_ns.min())],
                    count=[len(epoch_ns)],
                )
            )
    return concat(REJECTS, tables)
