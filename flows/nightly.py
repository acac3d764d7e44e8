"""The nightly flow: logs of star sensors go in, a dataset of space objects comes out."""

import logging
from collections.abc import Sequence

import numpy as np
import pyarrow as pa
from prefect import flow

from epipole.flows.clocks import read_clocks, set_right
from epipole.flows.log_choice import BEYOND_NS, find_logs
from epipole.flows.page import shown_on_page
from epipole.flows.parameters import Night, night_asked, run_name
from epipole.flows.progress import step
from epipole.flows.sensors import calibrated, sensor_ids, unplaced
from epipole.flows.stages import (
    associate,
    calibrate,
    fit,
    identify,
    link,
    place,
    read,
    track,
    triangulate,
    view,
)
from epipole.flows.summary import Summary, summarise
from epipole.io.dataset import check_folder, check_sources, nights_of
from epipole.io.star_catalogue import check_star_catalogue
from epipole.schemas.bridge import array, concat, conform
from epipole.schemas.errors import LogError
from epipole.schemas.settings import Settings
from epipole.schemas.tables import FRAMES, REJECTS
from epipole.tasks.align_epochs import align_epochs
from epipole.tasks.estimate_clocks import Clock, added, of_sound_clocks
from epipole.tasks.link_objects import renamed
from epipole.tasks.lone_detections import with_objects_found
from epipole.tasks.publish_night import publish_night, source_table

LOGGER = logging.getLogger(__name__)


@flow(name="nightly", flow_run_name=run_name)  # on threads, unless told otherwise
@shown_on_page
def nightly(
    logs: str | list[str],
    out: str,
    settings: Settings = Settings(),  # noqa: B008  frozen
    night: Night = None,
    replace: bool = False,
) -> Summary:
    """Turn logs into a dataset.

    Prefect's form for a run shows what stands under Args.

    Args:
        logs: MCAP files, folders, globs or URLs of them; those of the night are chosen.
        out: The dataset, a folder; it is made where it is missing.
        settings: Groups of settings, as in a settings file; what is left out keeps its default.
        night: Publish this UTC date only: YYYY-MM-DD, or yesterday, seen from when the run was
            due. None: every night that the logs have frames of.
        replace: Publish a night even though it was made of a log that is not among these.

    Raises:
        EpipoleError: Where the work cannot be done; the dataset is then as it was.
    """
    night = night_asked(night)
    check_folder(out)
    check_star_catalogue(settings.identification.catalogue)
    found = find_logs(logs, night)

    log = read(found.paths, settings)
    nights = nights_of(array(log.exposures, "time"))
    chosen = choose_nights(nights, night)
    sources = source_table(log.sources, settings)
    check_sources(out, chosen, sources, replace)
    exposures, uncalibrated = calibrated(near(log.exposures, night), log.cameras)
    if not exposures.num_rows:
        raise LogError(
            f"{', '.join(found.paths)}: no sensor has a calibration "
            f"({', '.join(sensor_ids(uncalibrated))}); record foxglove.CameraCalibration "
            "with the sensor's id as frame_id"
        )

    places = place(exposures, log.states, settings)
    identified = identify(exposures, places, log.cameras, settings)
    identified, cameras, calibrations = calibrate(
        identified, exposures, places, log.cameras, settings
    )
    clocks: list[Clock] = []
    for passes_left in (2, 1, 0):  # the second time a sensor takes part that had not
        tracked = track(identified, cameras, settings)
        epochs = align_epochs(identified.solutions, settings)
        views = view(epochs, identified, tracked, cameras, settings)
        associated = associate(views, identified, tracked, cameras, settings)
        solved = triangulate(associated, settings)
        still = read_clocks(views, solved, identified, settings)
        clocks = added(clocks, still)
        off = settings.alignment.correct_clocks and any(clock.is_off for clock in still)
        if not off or not passes_left:
            break
        identified, exposures = set_right(identified, exposures, log.states, still, settings)

    # A clock that is off and stays so: its sensor would spoil what the others see.
    sound, of_clocks = of_sound_clocks(views, solved.associations, still)
    if sound.num_rows < views.num_rows:
        associated = associate(sound, identified, tracked, cameras, settings)
        solved = triangulate(associated, settings)
    states = fit(associated, solved, settings)
    new_id = link(solved, states, settings)

    rejects = [
        found.rejects, log.rejects, uncalibrated, unplaced(places),
        identified.rejects, of_clocks, associated.rejects, solved.rejects,
    ]  # fmt: skip
    tables = {
        "frames": conform(FRAMES, identified.solutions),
        "stars": identified.stars,
        "detections": with_objects_found(tracked.detections, solved.associations),
        "tracklets": tracked.tracklets,
        "epochs": epochs,
        "associations": renamed(solved.associations, new_id),
        "positions": renamed(solved.positions, new_id),
        "states": renamed(states, new_id),
        "calibrations": calibrations,
        "pairs": solved.pairs,
        "sources": sources,
        "rejects": concat(REJECTS, rejects),
    }
    step("publish", 0, 1)
    published = publish_night(out, tables, nights, chosen, replace)
    LOGGER.info("published %s", ", ".join(f"{out}/night={n}" for n in chosen))
    return summarise(out, chosen, published, clocks)


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
    return exposures.filter(pa.array((time_ns >= start - BEYOND_NS) & (time_ns < end + BEYOND_NS)))
