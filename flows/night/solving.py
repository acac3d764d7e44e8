"""Solve the objects of a night, step by step, in tasks that fit into the memory of a worker.

The views of each sensor; the objects of each block of time; their numbers in the night; sensors
whose errors are larger than stated; the positions and states of the objects, piece by piece. What
a task works on depends on the data and the settings, never on the workers.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import polars as pl
import pyarrow as pa

from epipole.flows.night.progress import results
from epipole.flows.night.work import Work
from epipole.io.work.work_layout import (
    NOTHING_ADDED,
    AddedErrors,
    SolvedParts,
    ViewedParts,
)
from epipole.schemas.rejects import Reason
from epipole.schemas.settings import Settings
from epipole.schemas.spans import DAY_NS, Sensor, Span, spans_between
from epipole.schemas.stages import Stage
from epipole.tasks.name.linked_objects import (
    LinkedMembers,
    add_linked_members,
    names_with_linked,
    tracklets_at_once,
    without_refused,
)
from epipole.tasks.name.object_ids import Names
from epipole.tasks.solve.align_epochs import EpochGrid, frame_times, night_grid
from epipole.tasks.solve.associate_block import associate_blocks, blocks_of
from epipole.tasks.solve.number_objects import number_objects
from epipole.tasks.solve.positions import VELOCITY_WINDOW_S
from epipole.tasks.solve.sample_sight_lines import LineSampling
from epipole.tasks.solve.solve_piece import Piece, judge_span, solve_piece
from epipole.tasks.solve.views import view_sensors

STEPS = 5  # of the stage, for the progress line
MARGIN_NS = round(VELOCITY_WINDOW_S * 1e9)  # time beyond a span, see `_Night.margin_ns`
MIN_EPOCHS = 6  # minimum number in this margin, where epochs are far apart
VIEWS_AT_ONCE = 4  # a task of views has this part of what a task may have: they spread evenly
# Maximum number of views of a span from which the errors of its sensors are estimated. Not a
# setting: positions do not depend on the memory of a task.
MAX_JUDGED = 100_000
MAX_LINES = 30_000  # about this number of a span's lines of sight is kept for the check of sensors


class _Night(NamedTuple):
    """What all steps work on; the sensors are in the order of their ids."""

    sensors: list[Sensor]
    spans: list[Span]
    grid: EpochGrid
    work: Work
    settings: Settings
    solved: SolvedParts

    @property
    def viewed(self) -> ViewedParts:
        """Where the views of the sensors are."""
        return self.work.folder.viewed(self.work.round)

    @property
    def margin_ns(self) -> int:
        """Time beyond a span whose positions show the motion at its ends."""
        return max(MARGIN_NS, MIN_EPOCHS * self.grid.interval_ns)

    @property
    def epochs_apart(self) -> int:
        """Number of epochs after which no detection is used again."""
        if self.grid.epochs_ns is not None:
            return 1
        return math.floor(2e9 * self.settings.alignment.window_s / self.grid.interval_ns) + 1

    @property
    def apart_ns(self) -> int:
        """Epochs at multiples of this time [ns] share no detection; 1: no two epochs do."""
        return 1 if self.grid.epochs_ns is not None else self.epochs_apart * self.grid.interval_ns


def solve_objects(
    work: Work,
    settings: Settings,
    left_out: Mapping[str, Reason],
    added: AddedErrors = NOTHING_ADDED,
) -> tuple[SolvedParts, int]:
    """Find and solve the objects of all sensors but those left out.

    Sensors have the errors `added` beside the stated ones.

    Returns
    -------
    solved
        Where the results are.
    count
        Number of positions.
    """
    solved = work.folder.solved(work.round, not left_out, added)
    grid = epoch_grid(work, settings)
    night = _Night(list(work.spans), work.all_spans(), grid, work, settings, solved)
    n_views = _view(night)
    _associate(night, n_views, left_out)
    return solved, _solve(night, n_views)


def epoch_grid(work: Work, settings: Settings) -> EpochGrid:
    """Return the grid of epochs of the night."""
    columns = ["time", "attitude_source", "x_km"]
    sensors = [
        frame_times([work.identified[sensor].read(span, "solutions", columns) for span in spans])
        for sensor, spans in work.spans.items()
    ]
    return night_grid(sensors, settings.alignment)


def _view(night: _Night) -> dict[Span, int]:
    """View the tracklets of all sensors, a few sensors per task; return the views of each span."""
    work, settings = night.work, night.settings
    sensors, limit = work.sensor_parts(), settings.work.max_views // VIEWS_AT_ONCE
    groups = [(span, group) for span in night.spans for group in _sensor_groups(work, span, limit)]
    futures = [
        view_sensors.submit(
            [sensors[sensor] for sensor in group], span, night.grid, work.cameras,
            settings.tracklets, settings.alignment,
        )
        for span, group in groups
    ]  # fmt: skip
    counts = results(Stage.SOLVE, futures, (0, STEPS))
    total = dict.fromkeys(night.spans, 0)
    for (span, _), count in zip(groups, counts, strict=True):
        total[span] += count
    return total


def _sensor_groups(work: Work, span: Span, limit: int) -> list[list[Sensor]]:
    """Return the sensors with frames in or near a span, in groups of about `limit` detections."""
    near = set(spans_between(*span.widened(1)))
    groups: list[list[Sensor]] = []
    n_detections = limit
    for sensor, spans in work.spans.items():
        if near.isdisjoint(spans):
            continue
        if n_detections >= limit:
            groups.append([])
            n_detections = 0
        groups[-1].append(sensor)
        n_detections += work.n_detections.get((sensor, span), 0)
    return groups


def _associate(night: _Night, n_views: Mapping[Span, int], left_out: Mapping[str, Reason]) -> None:
    """Find the objects, a task per block, or per span where its views fit into one task."""
    futures = []
    for span in night.spans:
        blocks = blocks_of(span, night.settings.association)
        together = n_views[span] <= night.settings.work.max_views
        for of_task in [blocks] if together else [[block] for block in blocks]:
            futures.append(
                associate_blocks.submit(
                    night.sensors, night.viewed, of_task, night.work.cameras, left_out,
                    night.settings.association, night.settings.alignment.window_s,
                    night.settings.work.max_views, night.solved.blocks, night.solved.added,
                )
            )  # fmt: skip
    results(Stage.SOLVE, futures, (1, STEPS))


def _solve(night: _Night, n_views: Mapping[Span, int]) -> int:
    """Solve the objects, a task per piece; return the number of positions."""
    spans, settings, solved = night.spans, night.settings, night.solved
    numbered = number_objects.submit(
        spans, night.margin_ns, settings.association, settings.work.max_views, solved
    )
    (counts,) = results(Stage.SOLVE, [numbered], (2, STEPS))
    pieces = [
        Piece(span, number, count)
        for span, count in zip(spans, counts, strict=True)
        for number in range(count)
    ]
    kept = {span: _kept_lines(night, n_views[span]) for span in spans}
    return _solve_pieces(night, pieces, kept)


def _solve_pieces(night: _Night, pieces: Sequence[Piece], kept: Mapping[Span, LineSampling]) -> int:
    """Judge the sensors of the pieces' spans, and solve the pieces; return the positions."""
    viewed, settings, margin_ns = night.viewed, night.settings, night.margin_ns
    max_views = MAX_JUDGED * night.epochs_apart
    judged = [
        judge_span.submit(
            viewed, span, margin_ns, night.apart_ns, max_views, settings.positions,
            settings.states, night.solved,
        )
        for span in sorted({piece.span for piece in pieces})
    ]  # fmt: skip
    results(Stage.SOLVE, judged, (3, STEPS))
    futures = [
        solve_piece.submit(
            viewed, piece, margin_ns, kept[piece.span], settings.positions, settings.states,
            night.solved,
        )
        for piece in pieces
    ]  # fmt: skip
    n_positions: int = sum(results(Stage.SOLVE, futures, (4, STEPS)))
    return n_positions


def solve_linked(
    work: Work,
    solved: SolvedParts,
    tracklets: pl.DataFrame,
    linked: pa.Table,
    names: Names,
    settings: Settings,
) -> tuple[SolvedParts, Names, pa.Table]:
    """Solve once more the objects that linked tracklets show at the epochs of other sensors.

    Parameters
    ----------
    tracklets, linked
        As of `tracklets_at_once`.
    names
        Ids of the night, after linking.

    Returns
    -------
    solved
        Where all objects are.
    names
        With the objects that have their first positions.
    linked
        Without tracklets that the lines of sight of others contradict.
    """
    joined = tracklets_at_once(tracklets, linked)
    if not len(joined):
        return solved, names, linked
    spans = [span for span in work.all_spans() if solved.holds(span)]
    grid = epoch_grid(work, settings)
    night = _Night(list(work.spans), spans, grid, work, settings, solved.with_links())
    future = add_linked_members.submit(
        joined, {sensor.sensor_id: sensor.number for sensor in work.spans}, spans, names,
        night.margin_ns, settings.work.max_views, settings.positions.reject_sigma, night.viewed,
        solved,
    )  # fmt: skip
    members: LinkedMembers
    (members,) = results(Stage.NAME, [future])
    # The check of the sensors is over: it needs no lines of these objects.
    _solve_pieces(night, members.pieces, dict.fromkeys(spans, LineSampling(DAY_NS)))
    linked = without_refused(linked, members.refused, names)
    return night.solved, names_with_linked(names, night.solved, members), linked


def _kept_lines(night: _Night, n_views: int) -> LineSampling:
    """Return which lines of sight of a span are kept."""
    return LineSampling(night.apart_ns, max(math.ceil(n_views / night.epochs_apart / MAX_LINES), 1))
