"""Identify a span: one sensor's stars and attitudes over a span of time, from file to file."""

import logging
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa
import pyarrow.compute as pc
from prefect import task
from prefect.cache_policies import NO_CACHE

from epipole.io.catalogues.star_catalogue import read_star_catalogue
from epipole.io.work.files import is_written, read_part, write_part
from epipole.schemas.bridge import array, concat, table
from epipole.schemas.settings import Settings
from epipole.schemas.tables import REJECTS
from epipole.tasks.common.spans import Sensor, Span
from epipole.tasks.identify.identify_stars import identify_stars
from epipole.tasks.identify.place_sensors import place_sensors
from epipole.tasks.read.order_frames import frames_between, states_between

LOGGER = logging.getLogger(__name__)

BRIDGED_NS = 300_000_000_000  # states this far beyond a span help to place its frames


class Counts(NamedTuple):
    """What a part holds: frames, those with an attitude from stars, identified stars."""

    frames: int
    by_stars: int
    stars: int


@task(name="identify", task_run_name="identify {sensor} {span}", cache_policy=NO_CACHE)
def identify_span(
    frames: Path, sensor: Sensor, span: Span, cameras: pa.Table, settings: Settings, stage: Path
) -> Counts:
    """Place one sensor's frames of a span and identify them, unless that has been done.

    Parameters
    ----------
    frames
        Where `order_logs` left the frames.
    stage
        Where the part goes: `solutions`, `stars`, `detections` and `rejects`.
    """
    part = stage / span.folder
    if not is_written(part):
        exposures = frames_between(frames, sensor.number, *span)
        states = states_about(frames, sensor, span, settings)
        places = place_sensors(exposures, states, settings)
        catalogue = read_star_catalogue(settings.identification.catalogue)
        found = identify_stars(exposures, places, cameras, catalogue, settings)
        rejects = concat(REJECTS, [found.rejects, _unplaced(places)])
        write_part(part, {**found._asdict(), "rejects": rejects})
    source = read_part(part, "solutions", ["attitude_source"])["attitude_source"]
    by_stars = pc.sum(pc.equal(source, "stars")).as_py() or 0
    return Counts(len(source), by_stars, read_part(part, "stars").num_rows)


def states_about(frames: Path, sensor: Sensor, span: Span, settings: Settings) -> pa.Table:
    """Return the states of a sensor that place its frames of a span."""
    reach_ns = BRIDGED_NS + round(settings.sensors.state_gap_s * 1e9)
    return states_between(frames, sensor.number, *span.widened(reach_ns))


def _unplaced(places: pa.Table) -> pa.Table:
    """Return a reject for the frames that have no state near: they give no position."""
    lost = places.filter(pc.is_null(places["x_km"]))
    n = 1 if lost.num_rows else 0
    return table(
        REJECTS,
        {
            "source": [None] * n,
            "offset": [None] * n,
            "sensor_id": lost["sensor_id"].slice(0, n),
            "time": array(lost, "time")[:n],
            "stage": ["place_sensors"] * n,
            "reason": ["no_state"] * n,
            "count": [lost.num_rows] * n,
        },
    )
