"""The nightly flow: logs of star sensors go in, a dataset of space objects comes out."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from prefect import flow
from prefect.task_runners import ThreadPoolTaskRunner

from epipole.flows.progress import results, step
from epipole.flows.sensors import calibrated, of_sensor, sensor_ids, spans, unplaced
from epipole.flows.summary import Summary, summarise
from epipole.io.dataset import check_folder, check_sources, nights_of
from epipole.io.star_catalogue import read_hipparcos
from epipole.schemas.bridge import array, concat, conform
from epipole.schemas.errors import LogError
from epipole.schemas.log_tables import Log
from epipole.schemas.settings import Settings, validate_settings
from epipole.schemas.tables import DETECTIONS, FRAMES, REJECTS, STARS, TRACKLETS
from epipole.schemas.work_tables import SOLUTIONS, VIEWS
from epipole.tasks.align_epochs import align_epochs
from epipole.tasks.associate_objects import associate_objects
from epipole.tasks.build_tracklets import Tracked, build_tracklets
from epipole.tasks.identify_stars import Identified, identify_stars
from epipole.tasks.place_sensors import place_sensors
from epipole.tasks.publish_night import publish_night, source_table
from epipole.tasks.read_logs import read_logs
from epipole.tasks.solve_positions import solve_positions
from epipole.tasks.view_objects import view_objects

LOGGER = logging.getLogger(__name__)

SPAN_NS = 600_000_000_000  # long enough that tracking pays, short enough to share out
MARGIN_NS = 600_000_000_000  # read beyond both ends of a chosen night: no track is cut there


@flow(name="nightly", task_runner=ThreadPoolTaskRunner())
def nightly(
    logs: list[str],
    out: str,
    settings: dict[str, Any] | None = None,
    night: str | None = None,
    replace: bool = False,
) -> Summary:
    """Turn logs into a dataset.

    Parameters
    ----------
    logs
        MCAP files, in any order.
    out
        The dataset, a folder; it is made where it is missing.
    settings
        Groups of settings by name, as in a settings file; what is left out keeps its default.
    night
        Publish this UTC date only, ``YYYY-MM-DD``; none: every night the logs have frames of.
    replace
        Publish a night even though it was made of a log that is not among these.

    Raises
    ------
    EpipoleError
        Where the work cannot be done; the dataset is then as it was.
    """
    chosen_settings = validate_settings(settings or {}, "settings")
    check_folder(out)

    log = read(logs, chosen_settings)
    nights = nights_of(array(log.exposures, "time"))
    chosen = choose_nights(nights, night)
    sources = source_table(log.sources, chosen_settings)
    check_sources(Path(out), chosen, sources, replace)
    exposures, uncalibrated = calibrated(near(log.exposures, night), log.cameras)
    if not exposures.num_rows:
        raise LogError(
            f"{', '.join(logs)}: no sensor has a calibration "
            f"({', '.join(sensor_ids(uncalibrated))}); record foxglove.CameraCalibration "
            "with the sensor's id as frame_id"
        )

    places = place(exposures, log.states, chosen_settings)
    identified = identify(exposures, places, log.cameras, chosen_settings)
    tracked = track(identified, log.cameras, chosen_settings)
    epochs = align_epochs(identified.solutions, chosen_settings)
    views = view(epochs, identified, tracked, log.cameras, chosen_settings)
    step("associate", 0, 1)
    associated = associate_objects(
        views, tracked.tracklets, identified.solutions, log.cameras, chosen_settings
    )
    step("triangulate", 0, 1)
    solved = solve_positions(associated.views, associated.object_number, chosen_settings)

    rejects = [
        log.rejects, uncalibrated, unplaced(places), identified.rejects, associated.rejects,
        solved.rejects,
    ]  # fmt: skip
    tables = {
        "frames": conform(FRAMES, identified.solutions),
        "stars": identified.stars,
        "detections": tracked.detections,
        "tracklets": tracked.tracklets,
        "epochs": epochs,
        "associations": solved.associations,
        "positions": solved.positions,
        "pairs": solved.pairs,
        "sources": sources,
        "rejects": concat(REJECTS, rejects),
    }
    step("publish", 0, 1)
    published = publish_night(out, tables, nights, chosen, replace)
    LOGGER.info("published %s", ", ".join(f"{out}/night={n}" for n in chosen))
    return summarise(out, chosen, published)


def read(logs: Sequence[str], settings: Settings) -> Log:
    """Read the logs, sorted and each frame once."""
    step("read logs", 0, len(logs))
    log = read_logs(list(logs), settings)
    LOGGER.info("read %s frames of %d logs", f"{log.exposures.num_rows:,}", len(logs))
    return log


def choose_nights(nights: Sequence[str], night: str | None) -> list[str]:
    """Return the nights to publish: all that the logs have frames of, or the one asked for."""
    if night is None:
        return list(nights)
    if night not in nights:
        raise LogError(f"no frames on {night} in these logs; they have {', '.join(nights)}")
    return [night]


def near(exposures: pa.Table, night: str | None) -> pa.Table:
    """Return the frames of a night and of a margin beyond both its ends."""
    if night is None:
        return exposures
    start = int(np.datetime64(night, "ns").astype(np.int64))
    end = int((np.datetime64(night) + 1).astype("datetime64[ns]").astype(np.int64))
    time_ns = array(exposures, "time")
    return exposures.filter(pa.array((time_ns >= start - MARGIN_NS) & (time_ns < end + MARGIN_NS)))


def place(exposures: pa.Table, states: pa.Table, settings: Settings) -> pa.Table:
    """Interpolate each sensor's state to its frames."""
    step("place sensors", 0, 1)
    places = place_sensors(exposures, states, settings)
    placed = places.num_rows - places["x_km"].null_count
    LOGGER.info("placed %s of %s frames", f"{placed:,}", f"{places.num_rows:,}")
    return places


def identify(
    exposures: pa.Table, places: pa.Table, cameras: pa.Table, settings: Settings
) -> Identified:
    """Tell stars from the rest and solve attitudes, a task a sensor and span of time."""
    catalogue = read_hipparcos()
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
            of_sensor(tracked.tracklets, name),
            cameras,
            settings,
        )
        for name in sensor_ids(epochs)
    ]
    views = concat(VIEWS, results("view objects", futures))
    LOGGER.info("aligned %s epochs", f"{pc.count_distinct(epochs['epoch']).as_py():,}")
    return views
