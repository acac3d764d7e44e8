"""Solve a piece: the positions and states of some objects of a span, part to part.

Margins before and after the span are solved too: the velocities at its first and last epochs need
positions on both sides. Rows of the margins are not kept: they belong to the neighbouring spans.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.work.kept_parts import part_key, take_part
from epipole.io.work.parts import JUDGED, SOLVED, is_written, read_part, write_part
from epipole.io.work.work_layout import NOTHING_ADDED, AddedErrors, SolvedParts, ViewedParts
from epipole.schemas.arrays import Indices
from epipole.schemas.bridge import array, concat, to_polars
from epipole.schemas.settings import PositionSettings, StateSettings
from epipole.schemas.spans import DAY_NS, Span, spans_between
from epipole.schemas.stages import Stage
from epipole.schemas.tables import REJECTS
from epipole.schemas.work_tables import VIEWS
from epipole.tasks.common.grouping import group_offsets
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.solve.associate_block import view_outcomes
from epipole.tasks.solve.pairs import association_table, pair_table
from epipole.tasks.solve.positions import position_table, reject_table, solve_positions
from epipole.tasks.solve.sample_sight_lines import (
    LineSampling,
    moving_objects,
    object_views,
    sample_sight_lines,
)
from epipole.tasks.solve.states import fit_states, judge_errors, refuse_misfits
from epipole.tasks.solve.view_groups import (
    ObjectViews,
    ViewGroups,
    unpack_views,
    with_added_errors,
    with_larger_errors,
    with_stated_errors,
)


def gather_views(
    viewed: ViewedParts,
    members: pa.Table,
    time: Span,
    every_ns: int = 1,
    added: AddedErrors = NOTHING_ADDED,
) -> tuple[pa.Table, Indices]:
    """Return the VIEWS of objects within a time, and the number of the object of each.

    Parameters
    ----------
    viewed
        The parts of the views of the sensors.
    members
        OBJECT_MEMBERS of the objects.
    every_ns
        Only epochs that are multiples of this time since midnight.
    added
        Errors that sensors have beside the stated ones.

    Notes
    -----
    Two tracklets of one sensor may both have a view of an object at an epoch. Only one counts: the
    one with a centroid in the frame, or else the first. Views at epochs at which no other sensor
    has a view of the object are left out.
    """
    tables, numbers, sensors = [], [], []
    for sensor, members_of_sensor in _by_sensor(members, time):
        parts = viewed[sensor]
        for span in spans_between(*time):
            if not parts.holds(span):
                continue
            views = parts.read(span, "views")
            rows, number = _rows(views, parts.read(span, "tracklets"), members_of_sensor)
            kept = array(views, "epoch")[rows] % DAY_NS % every_ns == 0
            rows, number = rows[kept], number[kept]
            tables.append(with_added_errors(views.take(rows), added))
            numbers.append(number)
            sensors.append(np.full(len(number), sensor))
    views = concat(VIEWS, tables)
    number, sensor_number = (
        np.concatenate([*parts, np.zeros(0, np.int64)]) for parts in (numbers, sensors)
    )
    kept = _seen_by_two(views, number, sensor_number)
    return views.take(kept), number[kept]


class _Member(NamedTuple):
    """A tracklet of an object, with the first and the last epoch at which it is one."""

    tracklet_id: str
    number: int  # of the object
    first_ns: int
    last_ns: int


def _by_sensor(members: pa.Table, time: Span) -> Iterator[tuple[int, list[_Member]]]:
    """Yield each sensor with its OBJECT_MEMBERS, in their order, their epochs cut to a time."""
    sensor = array(members, "sensor")
    columns = (
        members["tracklet_id"].to_pylist(),
        array(members, "object").tolist(),
        np.maximum(array(members, "first_epoch"), time.start_ns).tolist(),
        np.minimum(array(members, "last_epoch"), time.end_ns - 1).tolist(),
    )
    rows = [_Member(*row) for row in zip(*columns, strict=True)]
    order = np.argsort(sensor, kind="stable")
    for at in np.split(order, np.flatnonzero(np.diff(sensor[order])) + 1):
        if len(at):
            yield int(sensor[at[0]]), [rows[k] for k in at]


def _rows(
    views: pa.Table, tracklets: pa.Table, members: Sequence[_Member]
) -> tuple[Indices, Indices]:
    """Return the rows of one sensor's views that show objects, and the object of each."""
    epoch_ns = array(views, "epoch")
    names = tracklets["tracklet_id"].to_pylist()
    first = dict(zip(names, array(tracklets, "first_view").tolist(), strict=True))
    count = dict(zip(names, array(tracklets, "n_views").tolist(), strict=True))
    rows, numbers = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for name, number, start_ns, end_ns in members:
        if name not in first:
            continue
        begin, end = first[name], first[name] + count[name]
        lo = begin + int(np.searchsorted(epoch_ns[begin:end], start_ns))
        hi = max(begin + int(np.searchsorted(epoch_ns[begin:end], end_ns, side="right")), lo)
        rows.append(np.arange(lo, hi))
        numbers.append(np.full(hi - lo, number))
    return np.concatenate(rows), np.concatenate(numbers)


def _seen_by_two(views: pa.Table, number: Indices, sensor: Indices) -> Indices:
    """Return the rows of views, one per sensor, of objects that two sensors see at the epoch; in
    the order of epochs, objects and sensors."""
    missed = ~views["centroid"].is_valid().to_numpy()
    epoch_ns = array(views, "epoch")
    order = np.lexsort((missed, sensor, number, epoch_ns))
    order = order[group_offsets(epoch_ns[order], number[order], sensor[order])[:-1]]
    count = np.diff(group_offsets(epoch_ns[order], number[order]))
    return order[np.repeat(count, count) >= 2]


class Piece(NamedTuple):
    """Some objects of a span: the number of the piece, and how many pieces there are."""

    span: Span
    number: int
    of: int

    def __str__(self) -> str:
        """Return the times of day, the number of the piece (from 1) and the number of pieces."""
        return f"{self.span}" + (f" {self.number + 1}/{self.of}" if self.of > 1 else "")


@stage_task(Stage.SOLVE, "{piece}")
def solve_piece(
    viewed: ViewedParts,
    piece: Piece,
    margin_ns: int,
    sampling: LineSampling,
    positions: PositionSettings,
    states: StateSettings,
    solved: SolvedParts,
) -> int:
    """Write the positions and states of some objects, `SOLVED`, unless the part exists.

    Parameters
    ----------
    viewed
        The parts of the views of the sensors.
    sampling
        Lines of sight that are kept for the check of the sensors.
    solved
        `objects` and `errors` are read; the part goes to `piece`.

    Returns
    -------
    int
        Number of positions.
    """
    part = solved.piece(piece.span, piece.number)
    if is_written(part):
        return _n_positions(part)
    members = solved.objects.read(piece.span, "members")
    members = members.filter(pa.compute.field("piece") == piece.number)
    time = piece.span.widened(margin_ns)
    errors = solved.errors.read(piece.span, "errors")
    made_from = ["positions", piece, margin_ns, sampling, solved.added]
    key = _key(viewed, time, made_from, [members, errors])
    if not take_part(part, solved.kept, key):
        views = unpack_views(*gather_views(viewed, members, time, added=solved.added))
        groups = solve_positions(
            with_larger_errors(views, errors), positions.reject_sigma, piece.span
        )
        stated = with_stated_errors(groups.views, errors, solved.added)
        tables = _tables(groups, stated, sampling, positions.all_pairs, states)
        write_part(part, SOLVED, tables, key=key)
    return _n_positions(part)


def _n_positions(part: Path) -> int:
    return read_part(part, "positions").num_rows


def _key(
    viewed: ViewedParts, time: Span, made_from: Sequence[object], rows: Sequence[pa.Table]
) -> str | None:
    """Return the key of a part that is made from the views of objects within a time.

    `rows` begin with the OBJECT_MEMBERS of the objects.
    """
    numbers = sorted(pc.unique(rows[0]["sensor"]).to_pylist())
    read = [part for n in numbers for part in viewed[n].written(spans_between(*time))]
    return part_key([Stage.SOLVE, time, *made_from], rows, read)


def _tables(
    groups: ViewGroups,
    stated: ObjectViews,
    sampling: LineSampling,
    all_pairs: bool,
    states: StateSettings,
) -> dict[str, pa.Table]:
    """Return the tables of a solved piece; `stated` are its views with the stated errors."""
    positions, associations = position_table(groups), association_table(groups)
    fitting, misfits = refuse_misfits(fit_states(groups, states))
    objects = moving_objects(positions, sampling.every_ns)
    return {
        "associations": associations,
        "positions": positions,
        "pairs": pair_table(groups, all_pairs),
        "states": fitting,
        "rejects": concat(REJECTS, [reject_table(groups), misfits]),
        "outcomes": view_outcomes(associations),
        # The check of the sensors compares the lines with the errors that the sensors state.
        "lines": sample_sight_lines(groups._replace(views=stated), objects, sampling),
        "object_views": object_views(groups.views, objects),
        "objects": objects,
    }


MIN_OBJECTS = 8  # from which the errors of a sensor are estimated


@stage_task(Stage.SOLVE, "errors {span}")
def judge_span(
    viewed: ViewedParts,
    span: Span,
    margin_ns: int,
    every_ns: int,
    max_views: int,
    positions: PositionSettings,
    states: StateSettings,
    solved: SolvedParts,
) -> None:
    """Write SHARED_ERRORS of a span, `JUDGED`, unless the part exists.

    Parameters
    ----------
    viewed
        The parts of the views of the sensors.
    every_ns, max_views
        Only epochs that are multiples of `every_ns` since midnight are solved, and some objects
        with at most `max_views` views together at all epochs.
    solved
        `objects` is read, `errors` gets the part.
    """
    if solved.errors.holds(span):
        return
    members = sample_objects(solved.objects.read(span, "members"), max_views)
    time = span.widened(margin_ns)
    key = _key(viewed, time, ["errors", every_ns, solved.added], [members])
    if solved.errors.take(span, key):
        return
    gathered = gather_views(viewed, members, time, every_ns, solved.added)
    views = unpack_views(*gathered)
    groups = solve_positions(views, positions.reject_sigma, span)
    # Directions as fitted, not corrected: the motion that the fits neglect is in their noise.
    fitted = groups._replace(views=views.take(groups.row))
    tables = {"errors": judge_errors(fitted, states)}
    write_part(solved.errors.of(span), JUDGED, tables, key=key)


def sample_objects(members: pa.Table, max_views: int) -> pa.Table:
    """Return the OBJECT_MEMBERS of some objects, with at most `max_views` views together.

    If these are not all objects, each sensor gets some. Sensors with few objects choose first, and
    choose those of which they have the most views.
    """
    rows = to_polars(members)
    if rows["n_views"].sum() <= max_views:
        return members
    size = dict(rows.group_by("object").agg(pl.col("n_views").sum()).iter_rows())
    seen = (
        rows.group_by("sensor", "object")
        .agg(pl.col("n_views").sum())
        .with_columns(objects=pl.len().over("sensor"))
        .sort("objects", "sensor", "n_views", "object", descending=[False, False, True, False])
    )
    of_sensor: dict[int, list[int]] = {}
    for sensor, object_ in seen.select("sensor", "object").iter_rows():
        of_sensor.setdefault(sensor, []).append(object_)
    sees = {o: set(s) for o, s in seen.group_by("object").agg(pl.col("sensor")).iter_rows()}
    chosen: set[int] = set()
    n_chosen = dict.fromkeys(of_sensor, 0)  # objects of each sensor
    n_views = 0
    for sensor, objects in of_sensor.items():
        for object_ in objects:
            if n_chosen[sensor] >= MIN_OBJECTS:
                break
            if object_ not in chosen:
                if chosen and n_views + size[object_] > max_views:
                    break
                chosen.add(object_)
                n_views += size[object_]
                for seeing in sees[object_]:
                    n_chosen[seeing] += 1
    return members.filter(pa.array(np.isin(rows["object"].to_numpy(), sorted(chosen))))
