"""What the pictures are drawn from: the example's dataset and its truth."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import polars as pl

from epipole.io.simulation.truth import elements_of, read_truth
from epipole.tasks.algorithms.geometry.camera import Camera
from epipole.tasks.algorithms.geometry.directions import (
    aberrate,
    matrix_from_quaternion,
    unit_from_radec,
)
from epipole.tasks.algorithms.simulation.paths import state_at

Array = npt.NDArray[np.float64]

LOCAL_S = 6.0  # half-width of the fit to a tracklet around an instant, as a run has it


class Night(NamedTuple):
    """The tables of a dataset, the sensors' cameras and the simulated objects."""

    tables: dict[str, pl.DataFrame]
    cameras: dict[str, Camera]
    elements: Array  # (n, 6), one row per simulated object
    start_ns: int
    dataset: Path
    log: Path


class Sight(NamedTuple):
    """A sensor's line of sight to an object at an epoch, GCRF."""

    sensor_id: str
    r_km: Array
    u: Array


def read_night(dataset: Path, truth_folder: Path) -> Night:
    """Return what `epipole run` made of the example, with the example's truth."""
    names = ("frames", "stars", "detections", "tracklets", "associations", "positions", "epochs")
    truth = read_truth(truth_folder)
    return Night(
        {name: pl.read_parquet(f"{dataset}/night=*/{name}/*.parquet") for name in names},
        {s["id"]: Camera(**s["camera"]) for s in truth.scenario["sensors"]},
        elements_of(truth),
        int(truth.scenario["t0_ns"]),
        dataset,
        truth_folder.with_suffix(""),
    )


def rows(night: Night, table: str, **equal: Any) -> pl.DataFrame:
    """Return the rows of a table in which each named column has the given value."""
    return night.tables[table].filter(*[pl.col(name) == value for name, value in equal.items()])


def column(table: pl.DataFrame, *names: str) -> Array:
    """Return a column as (n,), or several as (n, k) floats."""
    values = table.select(names).cast(pl.Float64).to_numpy()
    return values[:, 0] if len(names) == 1 else values


def times_ns(table: pl.DataFrame, name: str = "time") -> npt.NDArray[np.int64]:
    """Return a time column as integer nanoseconds."""
    return table[name].dt.epoch("ns").to_numpy()


def attitude(night: Night, sensor_id: str, frame_number: int) -> Array:
    """Return R_sensor_from_icrs of a frame."""
    frame = rows(night, "frames", sensor_id=sensor_id, frame_number=frame_number)
    return matrix_from_quaternion(column(frame, "qx", "qy", "qz", "qw"))[0]


def sights(night: Night, object_id: str, epoch: Any) -> list[Sight]:
    """Return the lines of sight of all sensors that saw an object at an epoch.

    Directions and places are fitted to the tracklet around the epoch; the aberration by the
    sensor's geocentric velocity is taken off.
    """
    found = []
    for view in rows(night, "associations", object_id=object_id, epoch=epoch).to_dicts():
        seen = rows(night, "detections", tracklet_id=view["tracklet_id"]).join(
            night.tables["frames"].drop("time", "ra_deg", "dec_deg"),
            on=["sensor_id", "frame_number"],
        )
        epoch_ns = int(pl.Series([epoch]).dt.epoch("ns")[0])
        t_s = (times_ns(seen) - epoch_ns) / 1e9
        near = np.abs(t_s) <= LOCAL_S
        ra, dec = np.radians(column(seen, "ra_deg", "dec_deg")[near]).T
        v_km_s = column(seen, "vx_km_s", "vy_km_s", "vz_km_s")[near]
        u = aberrate(unit_from_radec(ra, dec), -v_km_s)
        at_epoch = np.polyfit(t_s[near], u, 1)[-1]
        r_km = np.polyfit(t_s[near], column(seen, "x_km", "y_km", "z_km")[near], 2)[-1]
        found.append(Sight(view["sensor_id"], r_km, at_epoch / np.linalg.norm(at_epoch)))
    return found


def true_place(night: Night, position: dict[str, Any]) -> Array:
    """Return the place [km, GCRF] of the simulated object nearest to a row of `positions`."""
    t_s = (int(pl.Series([position["time"]]).dt.epoch("ns")[0]) - night.start_ns) / 1e9
    places, _ = state_at(night.elements, np.full(len(night.elements), t_s))
    here = np.array([position["x_km"], position["y_km"], position["z_km"]])
    return places[np.argmin(np.linalg.norm(places - here, axis=1))]


def covariance(position: dict[str, Any]) -> Array:
    """Return the (3, 3) covariance [km^2] of a row of `positions`."""
    return np.array(
        [[position["cov_" + "".join(sorted(a + b))] for b in "xyz"] for a in "xyz"], float
    )
