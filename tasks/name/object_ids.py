"""Object ids: one for each object of the night, kept through gaps and over midnight."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Literal

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.work.work_layout import SolvedParts
from epipole.schemas.arrays import Array
from epipole.schemas.bridge import concat, from_polars, stack_covariance, to_polars
from epipole.schemas.columns import POSITION, STATE_AXES, VELOCITY
from epipole.schemas.settings import StateSettings
from epipole.schemas.spans import Span
from epipole.schemas.stages import Stage
from epipole.schemas.work_tables import OBJECT_DETECTIONS
from epipole.tasks.algorithms.constants import SECOND_NS
from epipole.tasks.algorithms.orbits.object_linking import ObservedMotions, chains, link_by_motion
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.name.earlier_objects import EarlierViews

# Objects that are detected again after a gap keep their earlier id.


@stage_task(Stage.NAME, "objects")
def link_objects(positions: pa.Table, states: pa.Table, settings: StateSettings) -> dict[str, str]:
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
        *(
            ends.select(_named(side, [*POSITION, *VELOCITY])).to_numpy()
            for side in ("head", "tail")
        ),
        *(stack_covariance(ends, f"{side}_cov_{{}}", STATE_AXES) for side in ("head", "tail")),
    )
    before, _ = link_by_motion(seen, gap_s=settings.link_gap_s, log_odds=settings.link_log_odds)
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
    position = positions.sort(keys).select(*keys, *POSITION, pl.col("^cov_.*$"))
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


# Objects that are followed over midnight keep their id. A night is solved with half an hour of the
# night before. An object there and one of the published night before are the same if they share
# detections.

_DETECTION = ["sensor_id", "frame_number", "centroid"]
# A frame has one time in both nights, but for corrections of its clock: these differ by less.
SAME_FRAME_S = 0.1


def counted_alike(before: EarlierViews, frames: Mapping[str, tuple[Array, Array]]) -> pa.Table:
    """Return the OBJECT_DETECTIONS of the night before with this night's numbers of frames.

    Where a counter restarts, numbers go on from the highest one before in the night: so each night
    has other numbers. What they differ by is the same in all frames of both nights.

    Parameters
    ----------
    frames
        Times [ns] and numbers of this night's frames, by sensor. Those near the last frame of the
        night before are enough.
    """
    shifts: dict[str, int] = {}
    for name, number, time_ns in zip(*map(before.frames.column, range(3)), strict=True):
        times, numbers = frames.get(name.as_py(), (np.zeros(0), np.zeros(0)))
        off_s = np.abs(times - time_ns.cast(pa.int64()).as_py()) / SECOND_NS
        if off_s.min(initial=np.inf) < SAME_FRAME_S:
            shifts[name.as_py()] = int(numbers[np.argmin(off_s)]) - number.as_py()
    shift = pl.col("sensor_id").replace_strict(shifts, default=0, return_dtype=pl.Int64)
    rows = to_polars(before.detections).with_columns(pl.col("frame_number") + shift)
    return from_polars(OBJECT_DETECTIONS, rows)


def followed_objects(solved: Iterable[pa.Table], published: pa.Table) -> dict[str, str]:
    """Return the ids of the night before, by this night's names of the same objects.

    Parameters
    ----------
    solved
        OBJECT_DETECTIONS before midnight, of this night's solution.
    published
        OBJECT_DETECTIONS of the night before; see `counted_alike`. Views of other times do no
        harm.

    Notes
    -----
    The object that shares most detections gets the id, if more than half of its detections that
    have an id have this one. No two objects get one id.
    """
    ours, theirs = _detections(concat(OBJECT_DETECTIONS, solved)), _detections(published)
    shared = ours.join(theirs.rename({"object_id": "id"}), on=_DETECTION)
    counts = shared.group_by("object_id", "id").len()
    counts = counts.with_columns(share=pl.col("len") / pl.col("len").sum().over("object_id"))
    matches = counts.filter(pl.col("share") > 0.5).sort(
        "len", "id", "object_id", descending=[True, False, False]
    )
    first = matches.unique("id", keep="first", maintain_order=True)
    return dict(zip(first["object_id"], first["id"], strict=True))


def _detections(views: pa.Table) -> pl.DataFrame:
    """Return the detections that positions were solved with, each once, and their objects."""
    used = to_polars(views).filter("used").drop_nulls("centroid")
    return used.select("object_id", *_DETECTION).unique(maintain_order=True)


# One id in the night for each object of the spans that has a position in it.

Names = dict[str, dict[str, str]]  # by the folder of a span: old name, new name


def number_objects(solved: SolvedParts, spans: Sequence[Span]) -> Names:
    """Return the number of each span's objects, by the folder of the span.

    Objects are numbered in the order of first appearance. The numbers have leading zeros, so that
    they are in order as text.

    Parameters
    ----------
    solved
        The parts of `solve`: an object has one number in all spans.
    spans
        The spans that have a part, in order.
    """
    numbers: dict[int, str] = {}
    names = {}
    for span in spans:
        tables = [
            to_polars(rows) for rows in solved.read(span, "positions", ["epoch", "object_id"])
        ]
        rows = pl.concat(tables) if tables else pl.DataFrame(schema=["epoch", "object_id"])
        first = rows.group_by("object_id").agg(pl.col("epoch").min()).sort("epoch", "object_id")
        names[span.folder] = {
            old: numbers.setdefault(number_of(old), f"{len(numbers) + 1:09d}")
            for old in first["object_id"].to_list()
        }
    return names


def name_objects(
    numbers: Names, spans: Sequence[Span], night: str, earlier: Mapping[str, str]
) -> Names:
    """Return the ids in the night of each span's objects, by the folder of the span.

    An object that was followed from the night before keeps its id. Others get the date of the
    night and a number, in the order of first appearance. Objects that have a position only before
    or after the night have no id: the night has no row of them.

    Parameters
    ----------
    numbers
        As of `number_objects`, of all spans.
    spans
        The spans of the night, in order.
    night
        UTC date.
    earlier
        Ids of the night before, by number.
    """
    date, ids, new = night.replace("-", ""), dict[str, str](), 0
    for span in spans:
        for number in numbers.get(span.folder, {}).values():
            if number not in ids:
                new += number not in earlier
                ids[number] = earlier.get(number, f"{date}-{new:05d}")
    return {
        folder: {old: ids[number] for old, number in of_span.items() if number in ids}
        for folder, of_span in numbers.items()
    }


def number_of(span_name: str) -> int:
    """Return the number in the night of an object, from its id in a span."""
    return int(span_name.rpartition("-")[2])
