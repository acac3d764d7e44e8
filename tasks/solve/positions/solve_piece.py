"""Solve a piece: the positions and states of some objects of a span, part to part.

Margins before and after the span are solved too, so that the velocities at its first and last
epochs rest on as much as all others. Rows of the margins are not kept: they belong to the
neighbouring spans.
"""

from typing import NamedTuple

import pyarrow as pa

from epipole.io.work.part_tables import SOLVED
from epipole.io.work.parts import is_written, read_part, write_part
from epipole.io.work.places import SolvedParts, ViewedParts
from epipole.schemas.bridge import concat
from epipole.schemas.settings import Settings
from epipole.schemas.spans import Span
from epipole.schemas.stages import Stage
from epipole.schemas.tables import REJECTS
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.solve.judge_tracklets import judge_views
from epipole.tasks.solve.positions.fit_states import (
    fit_states,
    refuse_misfits,
    with_larger_errors,
    with_stated_errors,
)
from epipole.tasks.solve.positions.gather_views import gather_views
from epipole.tasks.solve.positions.sample_sight_lines import (
    LineSampling,
    claimed_views,
    moving_objects,
    sample_sight_lines,
)
from epipole.tasks.solve.positions.solve_positions import solve_positions


class Piece(NamedTuple):
    """Some objects of a span: the piece's number, and of how many."""

    span: Span
    number: int
    of: int

    def __str__(self) -> str:
        """Return the times of day, and which piece of how many."""
        return f"{self.span}" + (f" {self.number + 1}/{self.of}" if self.of > 1 else "")


@stage_task(Stage.SOLVE, "{piece}")
def solve_piece(
    viewed: ViewedParts,
    piece: Piece,
    margin_ns: int,
    kept: LineSampling,
    settings: Settings,
    solved: SolvedParts,
) -> int:
    """Write the positions and states of some objects, `SOLVED`, unless the part exists.

    Parameters
    ----------
    viewed
        The parts of the views of the sensors.
    kept
        Lines of sight that are kept for the check of the sensors.
    solved
        `objects` and `errors` are read; the part goes to `piece`.

    Returns
    -------
    int
        Number of positions.
    """
    part = solved.piece(piece.span, piece.number)
    if not is_written(part):
        write_part(part, SOLVED, _solve(viewed, piece, margin_ns, kept, settings, solved))
    return read_part(part, "positions").num_rows


def _solve(
    viewed: ViewedParts,
    piece: Piece,
    margin_ns: int,
    kept: LineSampling,
    settings: Settings,
    solved: SolvedParts,
) -> dict[str, pa.Table]:
    span = piece.span
    members = solved.objects.read(span, "members").filter(pa.compute.field("piece") == piece.number)
    views, number = gather_views(viewed, members, span.widened(margin_ns))
    errors = solved.errors.read(span, "errors")
    found = solve_positions(with_larger_errors(views, errors), number, settings, span)
    states, misfits = refuse_misfits(
        fit_states(found.views, found.associations, found.positions, settings)
    )
    objects = moving_objects(found.positions, kept.every_ns)
    return {
        "associations": found.associations,
        "positions": found.positions,
        "pairs": found.pairs,
        "states": states,
        "rejects": concat(REJECTS, [found.rejects, misfits]),
        "outcomes": judge_views(found.associations),
        # The check of the sensors holds the lines against the errors that the sensors state.
        "lines": sample_sight_lines(
            with_stated_errors(found.views, errors), found.associations, objects, kept
        ),
        "claims": claimed_views(found.views, objects),
        "objects": objects,
    }
