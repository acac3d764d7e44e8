"""The nightly flow: logs of star sensors go in, a dataset of space objects comes out."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from prefect import flow

from epipole.flows.clocks import read_clocks, set_right
from epipole.flows.progress import step
from epipole.flows.sensors import calibrated, sensor_ids, unplaced
from epipole.flows.stages import (
    associate,
    calibrate,
    fit,
    identify,
    place,
    read,
    track,
    triangulate,
    view,
)
from epipole.flows.summary import Summary, summarise
from epipole.io.dataset import check_folder, check_sources, nights_of
from epipole.schemas.bridge import array, concat, conform
from epipole.schemas.errors import LogError
from epipole.schemas.settings import validate_settings
from epipole.schemas.tables import FRAMES, REJECTS
from epipole.tasks.align_epochs import align_epochs
from epipole.tasks.publish_night import publish_night, source_table

LOGGER = logging.getLogger(__name__)

MARGIN_NS = 600_000_000_000  # read beyond both ends of a chosen night: no track is cut there


@flow(name="nightly")  # on threads, unless told otherwise
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
    identified, cameras, calibrations = calibrate(
        identified, exposures, places, log.cameras, chosen_settings
    )
    for correcting in (chosen_settings.alignment.correct_clocks, False):
        tracked = track(identified, cameras, chosen_settings)
        epochs = align_epochs(identified.solutions, chosen_settings)
        views = view(epochs, identified, tracked, cameras, chosen_settings)
        associated = associate(views, identified, tracked, cameras, chosen_settings)
        solved = triangulate(associated, chosen_settings)
        clocks = read_clocks(associated, solved, identified, chosen_settings)
        if not correcting or not any(clock.is_off for clock in clocks):
            break
        identified = set_right(identified, exposures, log.states, clocks, chosen_settings)

    rejects = [
        log.rejects, uncalibrated, unplaced(places),
        identified.rejects, associated.rejects, solved.rejects,
    ]  # fmt: skip
    tables = {
        "frames": conform(FRAMES, identified.solutions),
        "stars": identified.stars,
        "detections": tracked.detections,
        "tracklets": tracked.tracklets,
        "epochs": epochs,
        "associations": solved.associations,
        "positions": solved.positions,
        "states": fit(associated, solved, chosen_settings),
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
    return exposures.filter(pa.array((time_ns >= start - MARGIN_NS) & (time_ns < end + MARGIN_NS)))
