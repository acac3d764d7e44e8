"""Solve a span: from all sensors' tracklets to objects, positions and states, part to part.

Margins before and after the span are solved too, so that its first and last epochs have the same
evidence as all others. Rows of the margins are not kept: they belong to the neighbouring spans.
"""

from collections.abc import Mapping, Sequence

import polars as pl
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.work.part_tables import SOLVED
from epipole.io.work.parts import Parts, read_part, write_part
from epipole.io.work.places import SensorParts
from epipole.schemas.bridge import array, concat, from_polars
from epipole.schemas.rejects import Reason
from epipole.schemas.settings import Settings
from epipole.schemas.spans import Span
from epipole.schemas.stages import Stage
from epipole.schemas.tables import REJECTS
from epipole.schemas.work_tables import OBJECT_TRACKS, SOLUTIONS, TRACKLET_RUNS, VIEWS
from epipole.tasks.common.lone_detections import with_lone_tracklets
from epipole.tasks.common.named_detections import detections_within
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.solve.align_epochs import EpochGrid, align_epochs
from epipole.tasks.solve.associate_objects import Associated, associate_objects
from epipole.tasks.solve.collect_clock_views import collect_clock_views
from epipole.tasks.solve.fit_states import fit_states, refuse_misfits, with_honest_biases
from epipole.tasks.solve.judge_tracklets import judge_tracklets
from epipole.tasks.solve.leave_out_sensors import leave_out_sensors
from epipole.tasks.solve.solve_positions import Solved, object_names, solve_positions
from epipole.tasks.solve.view_objects import view_objects

FEWEST_EPOCHS = 6  # of a margin


@stage_task(Stage.SOLVE, "{span}")
def solve_span(
    sensors: Sequence[SensorParts],
    span: Span,
    grid: EpochGrid,
    cameras: pa.Table,
    left_out: Mapping[str, Reason],
    settings: Settings,
    parts: Parts,
) -> int:
    """Find the objects of a span and solve them, unless the part exists.

    Parameters
    ----------
    sensors
        In the order of their ids.
    left_out
        Sensors at fault, each with its reason; their views are not used.
    parts
        Where the part goes: `SOLVED`, with the objects' names in the span.

    Returns
    -------
    int
        Number of positions.
    """
    if not parts.holds(span):
        tables = _solve(sensors, span, grid, cameras, left_out, settings)
        write_part(parts.of(span), SOLVED, tables)
    return parts.read(span, "positions").num_rows


def _solve(
    sensors: Sequence[SensorParts],
    span: Span,
    grid: EpochGrid,
    cameras: pa.Table,
    left_out: Mapping[str, Reason],
    settings: Settings,
) -> dict[str, pa.Table]:
    margin_ns = _margin_ns(grid, settings)
    about = span.widened(margin_ns)
    # The motion at an epoch is fitted to the detections before and after it.
    wide = about.widened(round(2e9 * settings.alignment.window_s) + margin_ns)
    solutions = [sensor.identified.rows_within(wide, SOLUTIONS, "solutions") for sensor in sensors]
    frames = concat(SOLUTIONS, solutions)
    epochs = about.of(align_epochs(frames, settings, grid), "epoch")
    views, left_out_views, of_sensors = leave_out_sensors(
        _views(sensors, solutions, epochs, wide, cameras, settings), left_out
    )
    tracklets = with_lone_tracklets(_tracklets(sensors), views)
    associated = associate_objects(views, tracklets, frames, cameras, settings)
    solved = solve_positions(associated.views, associated.object_number, settings, span)
    stated_views = solved.views  # the check of the sensors holds them against what they tell
    honest = with_honest_biases(associated.views, solved.associations, solved.positions, settings)
    if honest is not associated.views:
        solved = solve_positions(honest, associated.object_number, settings, span)
    states, misfits = refuse_misfits(
        fit_states(solved.views, solved.associations, solved.positions, settings)
    )
    of_associations = span.of(associated.rejects, "time")
    rejects = [span.of(of_sensors, "time"), of_associations, solved.rejects, misfits]
    views_within = span.of(views, "epoch")
    return {
        "epochs": span.of(epochs, "epoch"),
        "associations": solved.associations,
        "positions": solved.positions,
        "pairs": solved.pairs,
        "states": states,
        "rejects": concat(REJECTS, rejects),
        "object_tracks": _object_tracks(associated, tracklets, solved),
        "tracklet_outcomes": judge_tracklets(
            views_within,
            span.of(left_out_views, "epoch"),
            span.of(associated.undecided, "epoch"),
            solved.associations,
        ),
        "clock_views": collect_clock_views(
            views_within, stated_views, solved.associations, solved.positions, settings
        ),
    }


def _margin_ns(grid: EpochGrid, settings: Settings) -> int:
    """Return a margin long enough for windows of evidence and for velocities."""
    evidence_ns = round(2e9 * settings.association.span_s)
    return max(evidence_ns, FEWEST_EPOCHS * grid.interval_ns)


def _views(
    sensors: Sequence[SensorParts],
    solutions: Sequence[pa.Table],
    epochs: pa.Table,
    wide: Span,
    cameras: pa.Table,
    settings: Settings,
) -> pa.Table:
    """Return the views of all sensors; `solutions` has one table per sensor."""
    views = [
        view_objects(
            epochs.filter(pc.field("sensor_id") == frames["sensor_id"][0]),
            frames,
            detections_within(sensor, wide),
            cameras,
            settings,
        )
        for sensor, frames in zip(sensors, solutions, strict=True)
        if frames.num_rows
    ]
    return concat(VIEWS, views)


def _tracklets(sensors: Sequence[SensorParts]) -> pa.Table:
    tables = [read_part(sensor.names.of_night(), "tracklets") for sensor in sensors]
    return concat(TRACKLET_RUNS, tables)


def _object_tracks(associated: Associated, tracklets: pa.Table, solved: Solved) -> pa.Table:
    """Return OBJECT_TRACKS: the tracks of each object, in the order of their last views."""
    tracks = dict(
        zip(tracklets["tracklet_id"].to_pylist(), tracklets["track_id"].to_pylist(), strict=True)
    )
    epoch_ns = array(associated.views, "epoch")
    rows = (
        pl.DataFrame(
            {
                "span_name": object_names(epoch_ns, associated.object_number),
                "epoch": epoch_ns,
                "tracklet_id": associated.views["tracklet_id"].to_numpy(),
            },
            schema={"span_name": pl.String, "epoch": pl.Int64, "tracklet_id": pl.String},
        )
        .with_columns(track_id=pl.col("tracklet_id").replace_strict(tracks, return_dtype=pl.String))
        .filter(pl.col("span_name").is_in(solved.associations["object_id"].unique().to_pylist()))
        .group_by("span_name", "track_id")
        .agg(pl.col("epoch").max())
        .sort("epoch", "span_name", "track_id")
    )
    return from_polars(OBJECT_TRACKS, rows)
