"""The globe of a night: where sensors and objects were at one time, and the lines of sight."""

from typing import NamedTuple

import numpy as np
import polars as pl

from epipole.io.datasets.night_tables import NightReader
from epipole.schemas.arrays import Array
from epipole.schemas.columns import POSITION, VELOCITY
from epipole.tasks.algorithms.constants import SECOND_NS
from epipole.tasks.algorithms.geometry.directions import unit_from_radec
from epipole.tasks.algorithms.orbits.orbit_fit import propagate

NEAR_NS = 60 * SECOND_NS  # frames so near to the time say where a sensor is
SEEN_NS = 15 * SECOND_NS  # observations so near to it are drawn
MOVED_S = 1800.0  # longest time over which an orbit is moved: `propagate` knows point mass and J2
SIGHT_KM = 2000.0  # length of a line of sight to nothing known
# A page of more has no room for the other pictures.
MAX_DOTS, MAX_LINES = 300, 300


class Sight(NamedTuple):
    """A line of sight of a sensor; the object is '' where none is known."""

    sensor_id: str
    object_id: str
    from_km: Array
    to_km: Array


class Globe(NamedTuple):
    """Sensors and objects at one time, GCRF [km].

    sensors, objects : position (3,) by id
    sights : some of the lines of sight
    n_sensors, n_objects, n_sights : how many there are
    """

    time_ns: int
    sensors: dict[str, Array]
    objects: dict[str, Array]
    sights: list[Sight]
    n_sensors: int
    n_objects: int
    n_sights: int


def read_globe(night: NightReader, epoch_ns: int | None) -> Globe | None:
    """Return the globe at an epoch; None: no sensor has a position.

    Without an epoch at the middle of the night's orbits, or else of its frames.
    """
    time_ns = _middle(night) if epoch_ns is None else epoch_ns
    if time_ns is None:
        return None
    near = _near(night, "frames", [*POSITION], time_ns, NEAR_NS, ["sensor_id"])
    sensors = dict(zip(near["sensor_id"], near.select(POSITION).to_numpy(), strict=True))
    if not sensors:
        return None
    objects = _objects(night, time_ns)
    sights = _sights(night, time_ns, objects)
    kept = dict(list(sensors.items())[:MAX_DOTS])
    shown = [sight for sight in sights if sight.sensor_id in kept][:MAX_LINES]
    return Globe(time_ns, kept, dict(list(objects.items())[:MAX_DOTS]), shown,
                 len(sensors), len(objects), len(sights))  # fmt: skip


def _middle(night: NightReader) -> int | None:
    for table, column in (("orbits", "epoch"), ("frames", "time")):
        times = night.read(table, [column])[column].dt.epoch("ns").sort()
        if len(times):
            return int(times[len(times) // 2])
    return None


def _near(
    night: NightReader, table: str, columns: list[str], time_ns: int, within_ns: int, key: list[str]
) -> pl.DataFrame:
    """Return the row of each key that is nearest to the time, in the order of the keys."""
    wanted = ["time", *key, *columns]
    between = time_ns - within_ns, time_ns + within_ns + 1
    rows = night.read(table, wanted, between).drop_nulls(POSITION)
    apart = (pl.col("time").dt.epoch("ns") - time_ns).abs()
    nearest = rows.sort(apart, maintain_order=True).unique(key, keep="first", maintain_order=True)
    return nearest.sort(key)


def _objects(night: NightReader, time_ns: int) -> dict[str, Array]:
    """Return where objects are: by their positions, else by their orbits."""
    columns = ["epoch", "object_id", *POSITION]
    rows = night.read("positions", columns, (time_ns, time_ns + 1)).sort("object_id")
    found = dict(zip(rows["object_id"], rows.select(POSITION).to_numpy(), strict=True))
    orbits = night.read("orbits", ["epoch", "object_id", *POSITION, *VELOCITY]).sort("object_id")
    ahead_s = (time_ns - orbits["epoch"].dt.epoch("ns").to_numpy()) / SECOND_NS
    states = orbits.select(*POSITION, *VELOCITY).to_numpy()
    for name, state, dt_s in zip(orbits["object_id"], states, ahead_s.tolist(), strict=True):
        if name not in found and abs(dt_s) <= MOVED_S:
            found[name] = propagate(state, dt_s)[:3]
    return found


def _sights(night: NightReader, time_ns: int, objects: dict[str, Array]) -> list[Sight]:
    """Return the lines of sight, those to objects first."""
    columns = ["object_id", *POSITION, "ra_deg", "dec_deg"]
    key = ["sensor_id", "tracklet_id"]
    rows = _near(night, "observations", columns, time_ns, SEEN_NS, key)
    u = unit_from_radec(*(np.radians(rows[name].to_numpy()) for name in ("ra_deg", "dec_deg")))
    at = rows.select(POSITION).to_numpy()
    found = [
        Sight(sensor, name if name in objects else "", from_km,
              objects.get(name, from_km + SIGHT_KM * towards))
        for sensor, name, from_km, towards in zip(
            rows["sensor_id"], rows["object_id"], at, u, strict=True)
    ]  # fmt: skip
    return sorted(found, key=lambda sight: not sight.object_id)
