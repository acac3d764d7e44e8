"""One sensor of a simulated log: what is identified, and its objects' directions and errors."""

import json
from pathlib import Path

import numpy as np
import polars as pl
import pyarrow as pa

from epipole.io.catalogues.star_catalogue import read_star_catalogue
from epipole.schemas.bridge import array, stack
from epipole.schemas.settings import Settings
from epipole.tasks.algorithms.constants import ARCSEC, SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.directions import unit_from_radec
from epipole.tasks.algorithms.simulation.paths import state_at
from epipole.tasks.identify.frame_inputs import interpolate_sensor_states
from epipole.tasks.solve.sightings import sight_objects, tabulate_sightings
from scenes.identified import identified, tracked
from scenes.whole_logs import read_whole


def made_of(log, sensor_id, **assumed):
    """Return what is identified of a sensor, its states and cameras."""
    settings = Settings()
    whole = read_whole([log], settings)
    exposures, states = (
        rows.filter(pa.compute.equal(rows["sensor_id"], sensor_id))
        for rows in (whole.exposures, whole.states)
    )
    cameras = whole.cameras
    if "line_time_s" in assumed:
        at = cameras.schema.get_field_index("line_time_s")
        stated = pa.array([assumed["line_time_s"]] * cameras.num_rows)
        cameras = cameras.set_column(at, cameras.schema.field(at), stated)
    frame_states = interpolate_sensor_states(exposures, states, settings.sensors)
    catalogue = read_star_catalogue("hipparcos")
    return identified(exposures, frame_states, cameras, catalogue, settings), cameras


def sights_of(log, sensor_id, **assumed):
    """Return the table of the directions of objects, and which object each shows."""
    found, cameras = made_of(log, sensor_id, **assumed)
    settings = Settings()
    made = tracked(found.solutions, found.detections, cameras, settings, found.stars)
    seen = tabulate_sightings(
        sight_objects(
            found.solutions, made.detections, cameras, settings.tracklets,
            settings.alignment.window_s,
        )
    )  # fmt: skip
    points = pl.read_parquet(f"{log}.truth/points.parquet").filter(pl.col("kind") == 1)
    keys = ["sensor_id", "frame_number", "centroid"]
    points = points.with_columns(pl.col("frame_number", "centroid").cast(pl.Int64))
    rows = pl.DataFrame(seen).with_row_index("row").with_columns(
        pl.col("frame_number", "centroid").cast(pl.Int64)
    ).join(points.select(*keys, "source"), on=keys)  # fmt: skip
    return seen.take(rows["row"].to_numpy()), rows["source"].to_numpy()


def errors(log, seen, source):
    """Return the errors of directions by the true paths, and their sigmas [arcsec]."""
    scenario = json.loads(Path(f"{log}.truth/scenario.json").read_text())
    orbits = np.array([target["elements"] for target in scenario["targets"]])[source]
    t_s, from_km = (array(seen, "time") - scenario["t0_ns"]) / 1e9, stack(seen, "{}_km")
    u = unit_from_radec(*(np.radians(array(seen, f"{n}_deg")) for n in ("ra", "dec")))
    light_s = np.zeros(len(t_s))
    for _ in range(3):
        r_km, _ = state_at(orbits, t_s - light_s)
        light_s = np.linalg.norm(r_km - from_km, axis=1) / SPEED_OF_LIGHT_KM_S
    d = r_km - from_km
    off = (u - d / np.linalg.norm(d, axis=1, keepdims=True)) / ARCSEC
    sigma = np.hypot(array(seen, "sigma_ra_arcsec"), array(seen, "sigma_dec_arcsec"))
    return np.linalg.norm(off, axis=1), sigma
