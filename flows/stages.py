"""The stages of a night, each shared out over tasks of a sensor and a span of time.

Every stage puts its tasks' tables together in the order the tasks were made, so the result
does not depend on the number of workers.
"""

import logging
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from epipole.flows.progress import results, step
from epipole.flows.sensors import of_sensor, sensor_ids, spans
from epipole.flows.summary import many
from epipole.io.star_catalogue import read_star_catalogue
from epipole.schemas.bridge import array, concat
from epipole.schemas.log_tables import Log
from epipole.schemas.settings import Settings
from epipole.schemas.tables import CALIBRATIONS, DETECTIONS, REJECTS, STARS, TRACKLETS
from epipole.schemas.work_tables import CAMERAS, SOLUTIONS, VIEWS
from epipole.tasks.associate_objects import Associated, associate_objects
from epipole.tasks.build_tracklets import Tracked, build_tracklets
from epipole.tasks.calibrate_sensors import Calibrated, calibrate_sensors
from epipole.tasks.fit_states import fit_states
from epipole.tasks.identify_stars import Identified, identify_stars
from epipole.tasks.link_objects import link_objects
from epipole.tasks.lone_detections import with_lone_tracklets
from epipole.tasks.place_sensors import place_sensors
from epipole.tasks.read_logs import read_logs
from epipole.tasks.solve_positions import Solved, solve_positions
from epipole.tasks.view_objects import view_objects

LOGGER = logging.getLogger(__name__)

SPAN_NS = 600_000_000_000  # long enough that tracking pays, short enough to share out


def read(logs: Sequence[str], settings: Settings) -> Log:
    """Read the logs, sorted and each frame once."""
    step("read logs", 0, len(logs))
    log = read_logs(list(logs), settings)
    LOGGER.info("read %s of %s", many(len(log.exposures), "frame"), many(len(logs), "log"))
    return log


def place(exposures: pa.Table, states: pa.Table, settings: Settings) -> pa.Table:
    """Interpolate each sensor's state to its frames."""
    step("place sensors", 0, 1)
    places: pa.Table = place_sensors(exposures, states, settings)
    placed = places.num_rows - places["x_km"].null_count
    LOGGER.info("placed %s of %s frames", f"{placed:,}", f"{places.num_rows:,}")
    return places


def identify(
    exposures: pa.Table, places: pa.Table, cameras: pa.Table, settings: Settings
) -> Identified:
    """Tell stars from the rest and solve attitudes, a task a sensor and span of time."""
    catalogue = read_star_catalogue(settings.identification.catalogue)
    futures = [
        identify_stars.submit(exposures.take(rows), places.take(rows), cameras, catalogue, settings)
        for rows in spans(exposures, SPAN_NS)
    ]
    parts: list[Identified] = results("identify stars", futures)
    solutions, stars, detections, rejects = zip(*parts, strict=True)
    identified = Identified(
        concat(SOLUTIONS, solutions),
        concat(STARS, stars),
        concat(DETECTIONS, detections),
        concat(REJECTS, rejects),
    )
    by_stars = pc.sum(pc.equal(identified.solutions["attitude_source"], "stars")).as_py() or 0
    LOGGER.info(
        "identified %s of %s frames by %s stars",
        f"{by_stars:,}", f"{identified.solutions.num_rows:,}", f"{identified.stars.num_rows:,}",
    )  # fmt: skip
    return identified


class Calibration(NamedTuple):
    """The stars' verdict on the optics, and what was identified and is to be used with it."""

    identified: Identified
    cameras: pa.Table
    calibrations: pa.Table


def calibrate(
    identified: Identified,
    exposures: pa.Table,
    places: pa.Table,
    cameras: pa.Table,
    settings: Settings,
) -> Calibration:
    """Fit each sensor's optics to its stars; identify again those whose calibration is off."""
    mode = settings.identification.calibrate
    calibrations = CALIBRATIONS.empty_table()
    for _ in range(2 if mode == "use" else 1):  # with better optics more stars take part
        if mode == "off":
            break
        names = sensor_ids(cameras)
        futures = [
            calibrate_sensors.submit(of_sensor(identified.stars, n), of_sensor(cameras, n))
            for n in names
        ]
        parts: list[Calibrated] = results("calibrate sensors", futures)
        calibrations = concat(CALIBRATIONS, [part.calibrations for part in parts])
        departed = [name for part in parts for name in part.departed]
        if mode == "report" or not departed:
            break
        LOGGER.info("optics of %s depart from the calibration", ", ".join(departed))
        cameras = concat(CAMERAS, [part.cameras for part in parts])
        again = pc.is_in(exposures["sensor_id"], pa.array(departed, pa.string()))
        new = identify(exposures.filter(again), places.filter(again), cameras, settings)
        identified = Identified(
            *[_replaced(old, part, departed) for old, part in zip(identified, new, strict=True)]
        )
    return Calibration(identified, cameras, calibrations)


def _replaced(old: pa.Table, new: pa.Table, sensors: list[str]) -> pa.Table:
    """Return a table with these sensors' rows from the new one, by sensor as before."""
    kept = old.filter(~pc.is_in(pc.field("sensor_id"), pa.array(sensors, pa.string())))
    both = pa.concat_tables([kept, new])
    return both.take(np.argsort(array(both, "sensor_id").astype(str), kind="stable"))


def track(identified: Identified, cameras: pa.Table, settings: Settings) -> Tracked:
    """Follow detections from frame to frame, a task a sensor."""
    futures = [
        build_tracklets.submit(
            of_sensor(identified.solutions, name),
            of_sensor(identified.detections, name),
            cameras,
            settings,
        )
        for name in sensor_ids(identified.solutions)
    ]
    detections, tracklets = zip(*results("build tracklets", futures), strict=True)
    tracked = Tracked(concat(DETECTIONS, detections), concat(TRACKLETS, tracklets))
    LOGGER.info(
        "tracked %s of %s detections in %s tracklets",
        f"{tracked.detections.num_rows - tracked.detections['tracklet_id'].null_count:,}",
        f"{tracked.detections.num_rows:,}", f"{tracked.tracklets.num_rows:,}",
    )  # fmt: skip
    return tracked


def view(
    epochs: pa.Table,
    identified: Identified,
    tracked: Tracked,
    cameras: pa.Table,
    settings: Settings,
) -> pa.Table:
    """Say where each sensor sees its tracklets at the epochs, a task a sensor."""
    futures = [
        view_objects.submit(
            of_sensor(epochs, name),
            of_sensor(identified.solutions, name),
            of_sensor(tracked.detections, name),
            cameras,
            settings,
        )
        for name in sensor_ids(epochs)
    ]
    views = concat(VIEWS, results("view objects", futures))
    LOGGER.info("aligned %s", many(pc.count_distinct(epochs["epoch"]).as_py(), "epoch"))
    return views


def associate(
    views: pa.Table,
    identified: Identified,
    tracked: Tracked,
    cameras: pa.Table,
    settings: Settings,
) -> Associated:
    """Say which sensors' tracklets are one object."""
    step("associate objects", 0, 1)
    associated: Associated = associate_objects(
        views,
        with_lone_tracklets(tracked.tracklets, views),
        identified.solutions,
        cameras,
        settings,
    )
    LOGGER.info("associated %s of %s views", f"{associated.views.num_rows:,}", f"{len(views):,}")
    return associated


def triangulate(associated: Associated, settings: Settings) -> Solved:
    """Solve each object's position at each epoch."""
    step("solve positions", 0, 1)
    solved: Solved = solve_positions(associated.views, associated.object_number, settings)
    LOGGER.info("solved %s", many(len(solved.positions), "position"))
    return solved


def fit(associated: Associated, solved: Solved, settings: Settings) -> pa.Table:
    """Fit a state to each arc of each object."""
    step("fit states", 0, 1)
    states: pa.Table = fit_states(associated.views, solved.associations, solved.positions, settings)
    LOGGER.info("fitted %s", many(len(states), "state"))
    return states


def link(solved: Solved, states: pa.Table, settings: Settings) -> dict[str, str]:
    """Return the ids of objects that are one with an earlier one, each with its first id."""
    step("link objects", 0, 1)
    new_id: dict[str, str] = link_objects(solved.positions, states, settings)
    LOGGER.info("knew %s again", many(len(new_id), "object"))
    return new_id
