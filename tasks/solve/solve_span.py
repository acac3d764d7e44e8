"""Solve a span: from all sensors' tracklets to objects, positions and states, file to file.

Epochs, views, association, positions and states of a span of time. A margin at both ends is
worked on too, so that the span's first and last epochs are solved like all others; the
margin's rows are the neighbours'.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import polars as pl
import pyarrow as pa
import pyarrow.compute as pc
from prefect import task
from prefect.cache_policies import NO_CACHE

from epipole.io.work.files import is_written, read_part, write_part
from epipole.schemas.bridge import array, concat, table
from epipole.schemas.settings import Settings
from epipole.schemas.tables import REJECTS, TRACKLETS
from epipole.schemas.work_tables import OBJECT_TRACKS, SOLUTIONS, VIEWS
from epipole.tasks.check.estimate_clocks import objects_views, without_sensors
from epipole.tasks.common.lone_detections import with_lone_tracklets
from epipole.tasks.common.named_detections import detections_within
from epipole.tasks.common.spans import Span, rows_within
from epipole.tasks.solve.align_epochs import EpochGrid, align_epochs
from epipole.tasks.solve.associate_objects import Associated, associate_objects
from epipole.tasks.solve.fit_states import fit_states
from epipole.tasks.solve.solve_positions import Solved, object_names, solve_positions
from epipole.tasks.solve.view_objects import view_objects

FEWEST_EPOCHS = 6  # of margin, at any rate


class SensorParts(NamedTuple):
    """Where one sensor's parts of a night lie."""

    identified: Path
    tracked: Path
    named: Path


@task(name="solve", task_run_name="solve {span}", cache_policy=NO_CACHE)
def solve_span(
    sensors: Sequence[SensorParts],
    span: Span,
    grid: EpochGrid,
    cameras: pa.Table,
    left_out: Sequence[str],
    settings: Settings,
    stage: Path,
) -> int:
    """Find the objects of a span and solve them, unless that has been done.

    Parameters
    ----------
    sensors
        In the order of their ids.
    left_out
        Ids of sensors whose clocks are off: what they see is not where they say.
    stage
        Where the part goes: the tables that are published, with objects as they are called in
        the span, `object_tracks`, `clock_views` and `rejects`.

    Returns
    -------
    int
        How many positions there are.
    """
    part = stage / span.folder
    if not is_written(part):
        write_part(part, _solve(sensors, span, grid, cameras, left_out, settings))
    return read_part(part, "positions").num_rows


def _solve(
    sensors: Sequence[SensorParts],
    span: Span,
    grid: EpochGrid,
    cameras: pa.Table,
    left_out: Sequence[str],
    settings: Settings,
) -> dict[str, pa.Table]:
    margin_ns = _margin_ns(grid, settings)
    about = span.widened(margin_ns)
    # Motion at an epoch is fitted to what was seen around it.
    wide = about.widened(round(2e9 * settings.alignment.window_s) + margin_ns)
    solutions = [rows_within(s.identified, wide, SOLUTIONS, "solutions") for s in sensors]
    epochs = about.of(align_epochs(concat(SOLUTIONS, solutions), settings, grid), "epoch")
    views = concat(
        VIEWS,
        [
            view_objects(
                epochs.filter(pc.field("sensor_id") == frames["sensor_id"][0]),
                frames,
                detections_within(sensor.tracked, sensor.named, wide),
                cameras,
                settings,
            )
            for sensor, frames in zip(sensors, solutions, strict=True)
            if frames.num_rows
        ],
    )
    views, of_clocks = without_sensors(views, left_out)
    of_clocks = span.of(of_clocks, "time")
    tracklets = concat(TRACKLETS, [read_part(s.named / "night", "tracklets") for s in sensors])
    tracklets = tracklets.filter(pc.is_in(tracklets["tracklet_id"], views["tracklet_id"]))
    tracklets = with_lone_tracklets(tracklets, views)
    frames = concat(SOLUTIONS, solutions)
    associated = associate_objects(views, tracklets, frames, cameras, settings)
    solved = solve_positions(associated.views, associated.object_number, settings, span)
    return {
        "epochs": span.of(epochs, "epoch"),
        "associations": solved.associations,
        "positions": solved.positions,
        "pairs": solved.pairs,
        "states": fit_states(associated.views, solved.associations, solved.positions, settings),
        "rejects": concat(
            REJECTS, [of_clocks, span.of(associated.rejects, "time"), solved.rejects]
        ),
        "object_tracks": _object_tracks(associated, tracklets, solved),
        "clock_views": objects_views(
            span.of(views, "epoch"), solved.associations, solved.positions, frames, settings
        ).to_arrow(),
    }


def _margin_ns(grid: EpochGrid, settings: Settings) -> int:
    """Return a margin that holds whole spans of evidence and what velocities are taken from."""
    evidence_ns = round(2e9 * settings.association.span_s)
    return max(evidence_ns, FEWEST_EPOCHS * grid.interval_ns)


def _object_tracks(associated: Associated, tracklets: pa.Table, solved: Solved) -> pa.Table:
    """Return the tracks of each object of the span, in the order they were last seen."""
    tracks = dict(
        zip(tracklets["tracklet_id"].to_pylist(), tracklets["track_id"].to_pylist(), strict=True)
    )
    rows = (
        pl.DataFrame(
            {
                "span_name": object_names(
                    array(associated.views, "epoch"), associated.object_number
                ),
                "epoch": array(associated.views, "epoch"),
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
    return table(OBJECT_TRACKS, {n: rows[n].to_arrow() for n in OBJECT_TRACKS.names})
