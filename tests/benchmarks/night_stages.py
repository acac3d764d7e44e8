"""The stages of a night as plain functions, one after the other, without Prefect."""

import json
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from epipole.flows.command_line.log_info import of_sensor, sensor_ids
from epipole.io.catalogues.star_catalogue import read_star_catalogue
from epipole.schemas.bridge import concat, stack
from epipole.schemas.settings import Settings
from epipole.schemas.tables import DETECTIONS, TRACKLETS
from epipole.schemas.work_tables import SOLUTIONS, VIEWS
from epipole.tasks.algorithms.simulation.orbits import state_at
from epipole.tasks.common.lone_detections import with_lone_tracklets
from epipole.tasks.identify.identify_stars import identify_stars
from epipole.tasks.identify.place_sensors import place_sensors
from epipole.tasks.solve.association.associate_objects import associate_objects
from epipole.tasks.solve.positions.solve_positions import Solved, solve_positions
from epipole.tasks.solve.views.align_epochs import align_epochs
from epipole.tasks.solve.views.view_objects import view_objects
from epipole.tasks.track.build_tracklets import Tracked, build_tracklets

Array = npt.NDArray[np.float64]
sys.path.append(str(Path(__file__).parents[1]))  # helpers beside the tests

from scenes.whole_logs import read_whole  # noqa: E402


class IdentifiedLog(NamedTuple):
    """A log after star identification."""

    solutions: pa.Table
    detections: pa.Table
    cameras: pa.Table


def see(log: Path, settings: Settings) -> IdentifiedLog:
    """Read a log and identify its stars."""
    read = read_whole([log], settings)
    places = place_sensors(read.exposures, read.states, settings)
    catalogue = read_star_catalogue(settings.identification.catalogue)
    parts = [
        identify_stars(
            of_sensor(read.exposures, name),
            of_sensor(places, name),
            read.cameras,
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
        build_tracklets(
            of_sensor(seen.solutions, name),
            of_sensor(seen.detections, name),
            seen.cameras,
            settings,
        )
        for name in sensor_ids(seen.solutions)
    ]
    return Tracked(
        concat(DETECTIONS, [part.detections for part in parts]),
        concat(TRACKLETS, [part.tracklets for part in parts]),
    )


def solve(seen: IdentifiedLog, tracked: Tracked, settings: Settings) -> Solved:
    """Align, associate and triangulate."""
    epochs = align_epochs(seen.solutions, settings)
    views = concat(
        VIEWS,
        [
            view_objects(
                of_sensor(epochs, name),
                of_sensor(seen.solutions, name),
                of_sensor(tracked.detections, name),
                seen.cameras,
                settings,
            )
            for name in sensor_ids(epochs)
        ],
    )
    associated = associate_objects(
        views, with_lone_tracklets(tracked.tracklets, views), seen.solutions, seen.cameras, settings
    )
    return solve_positions(associated.views, associated.object_number, settings)


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
