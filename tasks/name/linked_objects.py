"""Linked objects: the tracklets that an orbit joins to an object become members of it.

Association judges windows of ten minutes at most; an orbit joins tracklets over hours. Where two
sensors saw such an object at the same epochs, it has positions there like any other.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import polars as pl
import pyarrow as pa
from scipy.special import chdtrc

from epipole.io.work.parts import NUMBERED, write_part
from epipole.io.work.work_layout import SolvedParts, ViewedParts
from epipole.schemas.arrays import Indices
from epipole.schemas.bridge import array, from_polars, to_polars
from epipole.schemas.spans import Span, spans_between
from epipole.schemas.stages import Stage
from epipole.schemas.work_tables import LINKED_TRACKLETS, OBJECT_MEMBERS
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.name.object_ids import Names, number_of
from epipole.tasks.solve.align_epochs import SERVED_NS
from epipole.tasks.solve.number_objects import in_pieces, within
from epipole.tasks.solve.positions import solve_positions
from epipole.tasks.solve.solve_piece import Piece, gather_views
from epipole.tasks.solve.states import MIN_PROBABILITY
from epipole.tasks.solve.view_groups import ViewGroups, unpack_views, with_larger_errors

# Least share of a linked tracklet's views that agree with those of other sensors at their epochs.
# Nearly all of a true one do; of a wrong pair in a scene of six sensors 6 of 31.
MIN_AGREEING = 0.5
_NO_VIEWS = pl.DataFrame(
    schema={"object": pl.Int64, "tracklet_id": pl.String, "agrees": pl.Boolean}
)


class LinkedMembers(NamedTuple):
    """Members of linked objects: the `pieces` to solve, and the ids of objects by `number_of`.

    `refused` are linked tracklets whose lines of sight do not meet those of their objects.
    """

    pieces: list[Piece]
    ids: dict[int, str]
    refused: list[str]


def tracklets_at_once(tracklets: pl.DataFrame, linked: pa.Table) -> pl.DataFrame:
    """Return the linked tracklets that may have an epoch with another sensor's of their object.

    Parameters
    ----------
    tracklets
        TRACKLETS of the run, with their objects.
    linked
        LINKED_TRACKLETS.

    Returns
    -------
    polars.DataFrame
        tracklet_id, track_id, sensor_id, object_id, start_time, end_time.
    """
    columns = ["tracklet_id", "track_id", "sensor_id", "object_id", "start_time", "end_time"]
    rows = tracklets.select(columns).drop_nulls("object_id")
    is_linked = pl.col("tracklet_id").is_in(linked["tracklet_id"].to_pylist())
    rows = rows.with_columns(linked=is_linked).filter(pl.col("linked").any().over("object_id"))
    rows = rows.sort("object_id", "start_time", "tracklet_id")
    seen_until = pl.col("end_time").cum_max().shift().over("object_id")
    begins = pl.col("start_time") > seen_until + pl.duration(nanoseconds=SERVED_NS)
    together = rows.with_columns(run=begins.fill_null(True).cum_sum())
    several = pl.col("sensor_id").n_unique().over("run") > 1
    return together.filter(several, "linked").select(columns)


@stage_task(Stage.NAME, "members of linked objects")
def add_linked_members(
    joined: pl.DataFrame,
    sensors: Mapping[str, int],
    spans: Sequence[Span],
    names: Names,
    margin_ns: int,
    max_views: int,
    reject_sigma: float,
    viewed: ViewedParts,
    solved: SolvedParts,
) -> LinkedMembers:
    """Write the members of the spans in which linked tracklets share epochs with other sensors.

    Those whose lines of sight miss the others' at most of these epochs are none of their object's:
    an attributable has no curvature, and two short ones may fit one orbit by accident.

    Parameters
    ----------
    joined
        As of `tracklets_at_once`.
    sensors
        Numbers of the sensors in the run, by their ids.
    spans
        Those with a part of `solved`, in order.
    names
        Ids of the night, after linking.
    margin_ns, max_views
        As of `number_objects`.
    reject_sigma
        As of `solve_positions`.
    solved
        `objects` is read; those of `with_links` get a part for each span with such a tracklet.
    """
    ids = {number_of(old): new for of_span in names.values() for old, new in of_span.items()}
    first = _next_number(solved, spans)
    new = sorted(set(joined["object_id"]) - set(ids.values()))
    ids |= {number_of_member + 1: name for number_of_member, name in enumerate(new, first)}
    member = {name: number - 1 for number, name in sorted(ids.items(), reverse=True)}
    joined = joined.with_columns(
        object=pl.col("object_id").replace_strict(member, return_dtype=pl.Int64),
        sensor=pl.col("sensor_id").replace_strict(sensors, return_dtype=pl.Int64),
    )
    one = {number - 1: member[name] for number, name in ids.items()}
    found = {}
    for span in spans:
        linked = _linked_members(joined, span.widened(margin_ns), viewed)
        if len(linked):
            members = _renumbered(solved.objects.read(span, "members"), one, linked)
            seen = _shared_views(members, linked, span.widened(margin_ns), viewed, max_views)
            errors = solved.shared_errors(span)
            agreeing = [_agreeing_views(*each, linked, errors, reject_sigma) for each in seen]
            found[span] = members, linked, pl.concat([_NO_VIEWS, *agreeing])
    refused = _refused([views for *_, views in found.values()])
    pieces = []
    for span, (members, linked, views) in found.items():
        kept = pl.col("tracklet_id").is_in(refused).not_()
        shared = views.filter(kept)["object"].unique().to_list()
        if shared:
            rows, changed = _with_linked(members, linked.filter(kept), shared, span, max_views)
            if changed:  # else the linked ones have views beside the span only
                tables = {"members": from_polars(OBJECT_MEMBERS, rows)}
                write_part(solved.with_links().objects.of(span), NUMBERED, tables)
                pieces += changed
    return LinkedMembers(pieces, ids, refused)


def _next_number(solved: SolvedParts, spans: Sequence[Span]) -> int:
    """Return the number after those of all objects of the night."""
    last = [array(solved.objects.read(span, "members"), "object").max(initial=-1) for span in spans]
    return int(max(last, default=-1)) + 1


def _linked_members(joined: pl.DataFrame, time: Span, viewed: ViewedParts) -> pl.DataFrame:
    """Return OBJECT_MEMBERS of the linked tracklets with views within a time."""
    start, end = (pl.col(name).cast(pl.Int64) for name in ("start_time", "end_time"))
    near = joined.filter(end + SERVED_NS >= time.start_ns, start - SERVED_NS < time.end_ns)
    rows = [pl.DataFrame(schema=to_polars(OBJECT_MEMBERS.empty_table()).schema)]
    for (sensor,), of_sensor in near.group_by("sensor", maintain_order=True):
        parts = viewed[int(str(sensor))]
        for span in spans_between(*time):
            if parts.holds(span):
                found = _with_views(
                    of_sensor, parts.read(span, "tracklets"), parts.read(span, "views")
                )
                rows.append(found)
    return within(pl.concat(rows), time)


def _with_views(joined: pl.DataFrame, tracklets: pa.Table, views: pa.Table) -> pl.DataFrame:
    """Return OBJECT_MEMBERS of the tracklets that have views in a part of their sensor."""
    where = to_polars(tracklets.select(["tracklet_id", "first_view", "n_views"]))
    rows = joined.join(where.filter(pl.col("n_views") > 0), on="tracklet_id", maintain_order="left")
    first = rows["first_view"].to_numpy()
    epoch = views["epoch"].combine_chunks()
    return rows.with_columns(
        first_epoch=pl.Series(epoch.take(pa.array(first))),
        last_epoch=pl.Series(epoch.take(pa.array(first + rows["n_views"].to_numpy() - 1))),
        piece=pl.lit(0, pl.Int64),
    ).select(OBJECT_MEMBERS.names)


def _renumbered(members: pa.Table, one: Mapping[int, int], linked: pl.DataFrame) -> pl.DataFrame:
    """Return members; the numbers that are `one` object with linked tracklets become one."""
    number = pl.col("object").replace(one)
    is_linked = number.is_in(linked["object"].unique().implode())
    return to_polars(members).with_columns(
        object=pl.when(is_linked).then(number).otherwise("object")
    )


def _shared_views(
    members: pl.DataFrame, linked: pl.DataFrame, time: Span, viewed: ViewedParts, max_views: int
) -> Iterator[tuple[pa.Table, Indices]]:
    """Yield the views of some objects with linked tracklets after others; see `gather_views`."""
    of_linked = members.filter(pl.col("object").is_in(linked["object"].unique().implode()))
    rows = in_pieces(pl.concat([of_linked, linked]), time, max_views)
    for _, of_piece in rows.group_by("piece", maintain_order=True):
        yield gather_views(viewed, from_polars(OBJECT_MEMBERS, of_piece), time)


def _agreeing_views(
    views: pa.Table, number: Indices, linked: pl.DataFrame, errors: pa.Table, reject_sigma: float
) -> pl.DataFrame:
    """Return the views of linked tracklets, and which agree with those of others in a position.

    Two views make a position however far they miss each other: its chi-square tells.
    """
    seen = with_larger_errors(unpack_views(views, number), errors)
    groups = solve_positions(seen, reject_sigma)
    fits = groups.solved & (chdtrc(_dof(groups), groups.chi2) > MIN_PROBABILITY)
    columns = {
        "object": groups.views.object_number,
        "tracklet_id": groups.views.labels["tracklet_id"].to_pylist(),
        "agrees": groups.used & fits[groups.group],
    }
    rows = pl.DataFrame(columns, schema=_NO_VIEWS.schema)
    return rows.filter(pl.col("tracklet_id").is_in(linked["tracklet_id"].implode()))


def _dof(groups: ViewGroups) -> Indices:
    """Return the degrees of freedom of each position: two angles of each view, less three."""
    return np.maximum(2 * groups.n_used - 3, 1)


def _refused(agreeing: Sequence[pl.DataFrame]) -> list[str]:
    """Return the tracklets of which too few views agree."""
    views = pl.concat([_NO_VIEWS, *agreeing])
    shares = views.group_by("tracklet_id").agg(pl.col("agrees").mean())
    return sorted(shares.filter(pl.col("agrees") < MIN_AGREEING)["tracklet_id"])


def without_refused(linked: pa.Table, refused: Sequence[str], names: Names) -> pa.Table:
    """Return LINKED_TRACKLETS without those refused, nor a single one that is left of an object.

    `names` has the objects that have other tracklets.
    """
    rows = to_polars(linked).filter(pl.col("tracklet_id").is_in(refused).not_())
    known = {name for of_span in names.values() for name in of_span.values()}
    several = (pl.len().over("object_id") > 1) | pl.col("object_id").is_in(list(known))
    return from_polars(LINKED_TRACKLETS, rows.filter(several) if refused else rows)


def _with_linked(
    members: pl.DataFrame, linked: pl.DataFrame, shared: Sequence[int], span: Span, max_views: int
) -> tuple[pl.DataFrame, list[Piece]]:
    """Return the members of a span with the linked ones, and the pieces that have changed.

    Objects stay in their pieces: that of their first number. New ones get further pieces.
    """
    n_before = members["piece"].to_numpy().max(initial=-1) + 1
    changed = members.filter(pl.col("object").is_in(shared))
    pieces = changed.group_by("object").agg(pl.col("piece").min())
    linked = linked.filter(pl.col("object").is_in(shared))
    is_new = pl.col("object").is_in(changed["object"].unique().implode()).not_()
    rest = members.filter(pl.col("object").is_in(shared).not_())
    known = pl.concat([changed, linked.filter(is_new.not_())]).drop("piece")
    new = in_pieces(linked.filter(is_new), span, max_views)
    rows = pl.concat([
        rest, known.join(pieces, on="object").select(rest.columns),
        new.with_columns(pl.col("piece") + n_before),
    ]).sort("piece", "object", "sensor", "tracklet_id", "first_epoch")  # fmt: skip
    n_pieces = max(n_before, rows["piece"].to_numpy().max(initial=-1) + 1)
    numbers = sorted({*changed["piece"], *range(n_before, n_pieces)})
    return rows, [Piece(span, number, int(n_pieces)) for number in numbers]


def names_with_linked(names: Names, solved: SolvedParts, members: LinkedMembers) -> Names:
    """Return the names of each span's objects, also of those that linked tracklets gave positions.

    `solved` are the parts with links.
    """
    found = dict(names)
    for span in {piece.span for piece in members.pieces}:
        tables = [to_polars(rows) for rows in solved.read(span, "positions", ["object_id"])]
        old_ids = pl.concat(tables)["object_id"].unique().to_list()
        known = {old: members.ids.get(number_of(old)) for old in old_ids}
        found[span.folder] = {old: name for old, name in known.items() if name is not None}
    return found
