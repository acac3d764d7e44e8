"""View sensors: the directions of sensors' tracklets at the epochs of a span, part to part."""

from collections.abc import Sequence

import numpy as np
import pyarrow as pa

from epipole.io.work.part_tables import VIEWED
from epipole.io.work.parts import read_part, write_part
from epipole.io.work.places import SensorParts
from epipole.schemas.bridge import array, stack, table, unstack
from epipole.schemas.settings import Settings
from epipole.schemas.spans import Span
from epipole.schemas.stages import Stage
from epipole.schemas.work_tables import SENSOR_EPOCHS, SOLUTIONS, VIEWED_TRACKLETS
from epipole.tasks.common.equal_runs import group_offsets
from epipole.tasks.common.lone_detections import with_lone_tracklets
from epipole.tasks.common.named_detections import detections_within
from epipole.tasks.common.sightings import solved_frames
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.solve.views.align_epochs import EpochGrid, align_epochs
from epipole.tasks.solve.views.tabulate_sightings import tabulate_sightings
from epipole.tasks.solve.views.tracklet_sightings import sight_objects
from epipole.tasks.solve.views.view_objects import frames_of, view_objects

FEWEST_FRAMES = 6  # beyond the ends of a span: the motion at an epoch is fitted to these too


@stage_task(Stage.SOLVE, "views {span}")
def view_sensors(
    sensors: Sequence[SensorParts],
    span: Span,
    grid: EpochGrid,
    cameras: pa.Table,
    settings: Settings,
) -> int:
    """Write the views of some sensors in a span, `VIEWED`, unless the parts exist.

    Returns
    -------
    int
        Number of views.
    """
    count = 0
    for sensor in sensors:
        if not sensor.viewed.holds(span):
            tables = _view(sensor, span, grid, cameras, settings)
            write_part(sensor.viewed.of(span), VIEWED, tables)
        count += sensor.viewed.read(span, "views").num_rows
    return count


def _view(
    sensor: SensorParts, span: Span, grid: EpochGrid, cameras: pa.Table, settings: Settings
) -> dict[str, pa.Table]:
    margin_ns = round(2e9 * settings.alignment.window_s) + FEWEST_FRAMES * grid.interval_ns
    wide = span.widened(margin_ns)
    solutions = sensor.identified.rows_within(wide, SOLUTIONS, "solutions")
    epochs = span.of(align_epochs(solutions, settings, grid), "epoch")
    sighted = sight_objects(solutions, detections_within(sensor, wide), cameras, settings)
    views = view_objects(epochs, sighted, settings)
    tracklets = read_part(sensor.names.of_night(), "tracklets")
    return {
        "epochs": sensor_epochs(epochs, solutions),
        "views": views,
        "sightings": span.of(tabulate_sightings(sighted), "time"),
        "tracklets": viewed_tracklets(tracklets, views),
    }


def sensor_epochs(epochs: pa.Table, solutions: pa.Table) -> pa.Table:
    """Return SENSOR_EPOCHS: EPOCHS of one sensor with the states of their frames."""
    frames = solved_frames(solutions)
    row = frames_of(epochs, frames) if epochs.num_rows else np.zeros(0, np.int64)
    state = {name: frames.table[name].take(row) for name in ("vx_km_s", "vy_km_s", "vz_km_s")}
    return table(
        SENSOR_EPOCHS,
        {name: epochs[name] for name in epochs.column_names}
        | unstack("q{}", frames.q_sensor_from_icrs[row], "xyzw")
        | unstack("{}_km", stack(frames.table, "{}_km")[row])
        | state
        | {"camera": frames.camera[row]},
    )


def viewed_tracklets(tracklets: pa.Table, views: pa.Table) -> pa.Table:
    """Return VIEWED_TRACKLETS of one sensor, in the order of the ids, as the views are."""
    bounds = group_offsets(array(views, "tracklet_id"))
    rows = with_lone_tracklets(tracklets, views.take(bounds[:-1])).sort_by("tracklet_id")
    columns = {name: rows[name] for name in rows.column_names}
    where = {"first_view": bounds[:-1], "n_views": np.diff(bounds)}
    return table(VIEWED_TRACKLETS, columns | where)
