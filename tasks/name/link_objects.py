"""Link objects: an object that is detected again after a gap gets its earlier id."""

from collections.abc import Mapping
from typing import Literal

import numpy as np
import numpy.typing as npt
import polars as pl
import pyarrow as pa
import pyarrow.compute as pc

from epipole.schemas.bridge import stack_covariance
from epipole.schemas.columns import PLACE, STATE_AXES, VELOCITY
from epipole.schemas.settings import Settings
from epipole.schemas.stages import Stage
from epipole.tasks.algorithms.orbits.object_linking import ObservedMotions, chains, link_by_motion
from epipole.tasks.common.stage_tasks import stage_task

Array = npt.NDArray[np.float64]

COUNTS = ("n_epochs", "n_views", "dof", "chi2")  # of a state, not of its motion


@stage_task(Stage.NAME, "objects")
def link_objects(positions: pa.Table, states: pa.Table, settings: Settings) -> dict[str, str]:
    """Return the new ids of objects that are the same as an earlier object: the earlier one's id.

    Only the first and last position of each object are used (see `outermost`), and its first and
    last state. Both tables are of a whole night, in any order.
    """
    ends = _ends(pl.DataFrame(positions), pl.DataFrame(states))
    if not len(ends):
        return {}
    origin = ends["first"].min()
    seen = ObservedMotions(
        *(_seconds(ends, name, origin) for name in ("first", "last", "head_epoch", "tail_epoch")),
        *(ends.select(_named(side, [*PLACE, *VELOCITY])).to_numpy() for side in ("head", "tail")),
        *(stack_covariance(ends, f"{side}_cov_{{}}", STATE_AXES) for side in ("head", "tail")),
    )
    before, _ = link_by_motion(
        seen, gap_s=settings.states.link_gap_s, log_odds=settings.states.link_log_odds
    )
    names, head = ends["object_id"].to_list(), chains(before)
    return {names[k]: names[h] for k, h in enumerate(head.tolist()) if h != k}


def outermost(rows: pa.Table) -> pa.Table:
    """Return each object's first and last row."""
    frame = pl.DataFrame(rows).with_row_index("row").sort("epoch", "row")
    ends = frame.group_by("object_id").agg(first=pl.col("row").first(), last=pl.col("row").last())
    return rows.take(np.unique(ends.select("first", "last").to_numpy().ravel()))


def renamed(rows: pa.Table, new_id: Mapping[str, str]) -> pa.Table:
    """Return the rows with new ids, where objects have one."""
    if not new_id:
        return rows
    at = rows.schema.get_field_index("object_id")
    old = pc.index_in(rows["object_id"], pa.array(list(new_id), pa.string()))
    new = pa.array(list(new_id.values()), pa.string()).take(old.combine_chunks())
    return rows.set_column(at, rows.schema.field(at), pc.coalesce(new, rows["object_id"]))


def _ends(positions: pl.DataFrame, states: pl.DataFrame) -> pl.DataFrame:
    """Return a row per object, sorted by id: first and last epoch, and the motion at both.

    The motion is that of the first or last state. Without a state it is only the position.
    """
    keys = ["object_id", "epoch"]
    position = positions.sort(keys).select(*keys, *PLACE, pl.col("^cov_.*$"))
    missing = [name for name in states.columns if name not in position.columns]
    position = position.with_columns(
        pl.lit(None, pl.Float64).alias(name)
        for name in missing
        if name not in ("n_epochs", "n_views", "dof", "chi2")
    )
    state = states.sort(keys).select(position.columns)
    ends = position.group_by("object_id", maintain_order=True).agg(
        first=pl.col("epoch").first(), last=pl.col("epoch").last()
    )
    sides: tuple[tuple[str, Literal["first", "last"]], ...] = (("head", "first"), ("tail", "last"))
    for side, keep in sides:
        known = [rows.unique("object_id", keep=keep, maintain_order=True) for rows in
                 (state, position)]  # fmt: skip
        motion = pl.concat(known).unique("object_id", keep="first", maintain_order=True)
        motion = motion.rename({name: f"{side}_{name}" for name in motion.columns[1:]})
        ends = ends.join(motion, on="object_id", how="left", maintain_order="left")
    return ends


def _named(side: str, names: list[str]) -> list[str]:
    return [f"{side}_{name}" for name in names]


def _seconds(ends: pl.DataFrame, name: str, origin: object) -> Array:
    return (ends[name] - origin).cast(pl.Duration("ns")).cast(pl.Int64).to_numpy() / 1e9
