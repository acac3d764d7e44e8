"""Number objects: one number in the night for the objects of all blocks, and the pieces of spans.

A piece is a part of a span's objects, whose views fit in the memory of a task. Pieces depend on the
data and the settings only, never on the workers.
"""

from collections.abc import Sequence

import numpy as np
import polars as pl
import pyarrow as pa

from epipole.io.work.parts import NUMBERED, Parts, write_part
from epipole.io.work.work_layout import SolvedParts
from epipole.schemas.arrays import Indices
from epipole.schemas.bridge import from_polars, to_polars
from epipole.schemas.settings import AssociationSettings
from epipole.schemas.spans import Span
from epipole.schemas.stages import Stage
from epipole.schemas.work_tables import OBJECT_MEMBERS
from epipole.tasks.algorithms.orbits.object_motion import ObjectRegistry
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.solve.associate_block import blocks_of


@stage_task(Stage.SOLVE, "numbers of objects")
def number_objects(
    spans: Sequence[Span],
    margin_ns: int,
    settings: AssociationSettings,
    max_views: int,
    solved: SolvedParts,
) -> list[int]:
    """Number the objects of all blocks, unless the parts exist; return each span's pieces.

    Parameters
    ----------
    spans
        In order.
    margin_ns
        Views within this time outside a span are needed for the motion of objects at its ends.
    max_views
        Limit of the views in the memory of a task.
    solved
        `blocks` is read, `objects` gets a part for each span.

    Notes
    -----
    An object keeps its number as long as one of its tracks continues.
    """
    if not all(solved.objects.holds(span) for span in spans):
        numbered = _number(spans, settings, solved.blocks)
        for k, span in enumerate(spans):
            near = [numbered[j] for j in (k - 1, k, k + 1) if 0 <= j < len(spans)]
            rows = within(pl.concat(near), span.widened(margin_ns))
            members = from_polars(OBJECT_MEMBERS, in_pieces(rows, span, max_views))
            write_part(solved.objects.of(span), NUMBERED, {"members": members})
    return [_count_pieces(solved.objects.read(span, "members", ["piece"])) for span in spans]


def _count_pieces(members: pa.Table) -> int:
    return int(members["piece"].to_numpy().max(initial=-1)) + 1


def _number(
    spans: Sequence[Span], settings: AssociationSettings, blocks: Parts
) -> list[pl.DataFrame]:
    """Return the members of each span's objects, with the numbers of the night."""
    registry = ObjectRegistry()
    track_number: dict[str, int] = {}
    out = []
    for span in spans:
        of_span = []
        for block in blocks_of(span, settings):
            rows = to_polars(blocks.read(block, "members"))
            tracks = _tracks(rows, track_number)
            numbers = registry.name_groups(list(tracks.values()))
            of_block = dict(zip(tracks, numbers, strict=True))
            of_span.append(
                rows.with_columns(pl.col("object").replace_strict(of_block, return_dtype=pl.Int64))
            )
        out.append(pl.concat(of_span))
    return out


def _tracks(members: pl.DataFrame, known: dict[str, int]) -> dict[int, Indices]:
    """Return the numbers of each object's tracks, in the order of their last epochs."""
    rows = (
        members.group_by("object", "track_id")
        .agg(pl.col("last_epoch").max())
        .sort("object", "last_epoch", "track_id")
    )
    tracks: dict[int, list[int]] = {}
    for object_, track in zip(rows["object"].to_list(), rows["track_id"].to_list(), strict=True):
        tracks.setdefault(object_, []).append(known.setdefault(track, len(known)))
    return {object_: np.array(of_object, np.int64) for object_, of_object in tracks.items()}


def within(members: pl.DataFrame, time: Span) -> pl.DataFrame:
    """Return the members with views within a time."""
    first, last = (pl.col(name).cast(pl.Int64) for name in ("first_epoch", "last_epoch"))
    return members.filter((last >= time.start_ns) & (first < time.end_ns))


def in_pieces(members: pl.DataFrame, span: Span, max_views: int) -> pl.DataFrame:
    """Return the members of the objects in a span, each object in one piece."""
    inside = within(members, span)
    size = inside.group_by("object").agg(pl.col("n_views").sum()).sort("object")
    piece_of, number, n_in_piece = [], 0, 0
    for n_views in size["n_views"].to_list():
        if n_in_piece and n_in_piece + n_views > max_views:
            number, n_in_piece = number + 1, 0
        n_in_piece += n_views
        piece_of.append(number)
    pieces = size.select("object", piece=pl.Series(piece_of, dtype=pl.Int64))
    return (
        members.drop("piece")
        .join(pieces, on="object")
        .sort("piece", "object", "sensor", "tracklet_id", "first_epoch")
        .select(OBJECT_MEMBERS.names)
    )
