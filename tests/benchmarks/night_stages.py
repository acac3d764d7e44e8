"""The stages of a night as plain functions, one after the other, without Prefect."""

import json
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from epipole.flows.command_line.log_info import of_sensor, sensor_ids
from epipole.io.catalogues.star_catalogue import read_star_catalogue
from epipole.io.work.parts import VIEWED, write_part
from epipole.io.work.work_layout import SolvedParts, ViewedParts
from epipole.schemas.arrays import Array
from epipole.schemas.bridge import array, concat, stack
from epipole.schemas.settings import Settings
from epipole.schemas.spans import Sensor, Span, spans_between
from epipole.schemas.tables import DETECTIONS
from epipole.schemas.work_tables import HOT_SUSPECTS, OBJECT_MEMBERS, SOLUTIONS, TRACKLET_RUNS
from epipole.tasks.algorithms.simulation.paths import state_at
from epipole.tasks.common.sightings import cameras_of
from epipole.tasks.identify.frame_inputs import interpolate_sensor_states
from epipole.tasks.solve.align_epochs import align_epochs
from epipole.tasks.solve.associate_block import associate_blocks, blocks_of
from epipole.tasks.solve.number_objects import number_objects
from epipole.tasks.solve.positions import solve_positions
from epipole.tasks.solve.sightings import (
    sight_objects,
    tabulate_attributables,
    tabulate_sightings,
    with_middle_in,
)
from epipole.tasks.solve.solve_piece import gather_views
from epipole.tasks.solve.view_groups import ViewGroups, unpack_views
from epipole.tasks.solve.views import sensor_epochs, view_objects, viewed_tracklets
from epipole.tasks.track.track_span import Tracked

sys.path.append(str(Path(__file__).parents[1]))  # helpers beside the tests

from scenes.identified import identified, tracked
from scenes.whole_logs import read_whole


class IdentifiedLog(NamedTuple):
    """A log after star identification."""

    solutions: pa.Table
    detections: pa.Table
    cameras: pa.Table


def see(log: Path, settings: Settings) -> IdentifiedLog:
    """Read a log and identify its stars."""
    read = read_whole([log], settings)
    places = interpolate_sensor_states(read.exposures, read.states, settings.sensors)
    catalogue = read_star_catalogue(settings.identification.catalogue)
    parts = [
        identified(
            of_sensor(read.exposures, name),
            of_sensor(places, name),
            cameras_of(read.cameras, name),
            catalogue,
            settings,
        )
        for name in sensor_ids(read.exposures)
    ]
    return IdentifiedLog(
        concat(SOLUTIONS, [part.solutions for part in parts]),
        concat(DETECTIONS, [part.detections for part in parts]),
        read.cameras,
    )


def track(seen: IdentifiedLog, settings: Settings) -> Tracked:
    """Build the tracklets of every sensor."""
    parts = [
        tracked(
            of_sensor(seen.solutions, name),
            of_sensor(seen.detections, name),
            cameras_of(seen.cameras, name),
            settings,
        )
        for name in sensor_ids(seen.solutions)
    ]
    return Tracked(
        concat(DETECTIONS, [part.detections for part in parts]),
        concat(TRACKLET_RUNS, [part.tracklets for part in parts]),
        concat(HOT_SUSPECTS, [part.suspects for part in parts]),
    )


def solve(seen: IdentifiedLog, tracked: Tracked, settings: Settings) -> ViewGroups:
    """Align, associate and triangulate: as the flow does, but all positions at once."""
    with tempfile.TemporaryDirectory() as folder:
        viewed = ViewedParts(Path(folder) / "views")
        sensors = _view(viewed, seen, tracked, settings)
        spans = spans_between(*_ends(align_epochs(seen.solutions, settings.alignment)))
        solved = SolvedParts(Path(folder))
        for span in spans:
            blocks = blocks_of(span, settings.association)
            associate_blocks.fn(
                sensors, viewed, blocks, seen.cameras, {}, settings.association,
                settings.alignment.window_s, settings.work.max_views, solved.blocks,
            )  # fmt: skip
        number_objects.fn(spans, 0, settings.association, settings.work.max_views, solved)
        members = [solved.objects.read(span, "members") for span in spans]
        time = Span(spans[0].start_ns, spans[-1].end_ns)
        views = unpack_views(*gather_views(viewed, concat(OBJECT_MEMBERS, members), time))
    return solve_positions(views, settings.positions.reject_sigma)


def _view(
    viewed: ViewedParts, seen: IdentifiedLog, tracked: Tracked, settings: Settings
) -> list[Sensor]:
    """Write the views of all sensors, a part per sensor and span."""
    epochs = align_epochs(seen.solutions, settings.alignment)
    sensors = [Sensor(k, name) for k, name in enumerate(sorted(sensor_ids(epochs)))]
    for sensor in sensors:
        solutions = of_sensor(seen.solutions, sensor.sensor_id)
        own = of_sensor(epochs, sensor.sensor_id)
        detections = of_sensor(tracked.detections, sensor.sensor_id)
        cameras = cameras_of(seen.cameras, sensor.sensor_id)
        sighted = sight_objects(
            solutions, detections, cameras, settings.tracklets, settings.alignment.window_s
        )
        views = view_objects(
            own, sighted, settings.tracklets.max_rate_deg_s, settings.alignment.window_s
        )
        sightings = tabulate_sightings(sighted)
        tracklets = of_sensor(tracked.tracklets, sensor.sensor_id)
        for span in spans_between(*_ends(own)):
            of_span = span.of(views, "epoch")
            tables = {
                "views": of_span,
                "sightings": span.of(sightings, "time"),
                "attributables": tabulate_attributables(sighted, with_middle_in(tracklets, span)),
                "epochs": sensor_epochs(span.of(own, "epoch"), solutions),
                "tracklets": viewed_tracklets(tracklets, of_span),
            }
            write_part(viewed[sensor.number].of(span), VIEWED, tables)
    return sensors


def _ends(epochs: pa.Table) -> tuple[int, int]:
    epoch_ns = array(epochs, "epoch")
    return int(epoch_ns.min()), int(epoch_ns.max()) + 1


def position_errors(log: Path, positions: pa.Table) -> Array:
    """Return the distance of each position from the nearest object of the simulation [km]."""
    truth = json.loads((Path(f"{log}.truth") / "scenario.json").read_text())
    at_s = (pc.cast(positions["time"], pa.int64()).to_numpy() - int(truth["t0_ns"])) / 1e9
    here = stack(positions, "{}_km")
    best = np.full(len(here), np.inf)
    for target in truth["targets"]:
        r, _ = state_at(np.array(target["elements"]), at_s)
        best = np.minimum(best, np.linalg.norm(here - r, axis=1))
    return best
