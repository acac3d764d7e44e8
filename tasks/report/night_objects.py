"""Objects of a night: where they are, how they move, and what is known of their names."""

from typing import NamedTuple

import erfa
import numpy as np
import numpy.typing as npt
import polars as pl

from epipole.io.datasets.night_reader import NightReader
from epipole.schemas.columns import PLACE, VELOCITY
from epipole.schemas.rejects import NameStatus
from epipole.tasks.algorithms.constants import GM_KM3_S2
from epipole.tasks.algorithms.time.time_scales import utc_julian_date

Array = npt.NDArray[np.float64]

GEOSTATIONARY_KM = 42_164.0
NEAR_KM = 1_500.0
LARGEST_LATITUDE_DEG = 20.0


class NightObject(NamedTuple):
    """An object.

    first, last : (longitude, latitude [deg], radius [km]) at its first and last position
    elements : semi-major axis [km], eccentricity, inclination [deg] of its best state; None: no
        state
    """

    object_id: str
    status: str
    name: str
    positions: int
    first_ns: int
    last_ns: int
    sensors: int
    sigma_km: float
    first: tuple[float, float, float]
    last: tuple[float, float, float]
    elements: tuple[float, float, float] | None

    @property
    def near_geostationary(self) -> bool:
        """Whether it is near the geostationary ring, by its place."""
        _, latitude, radius = self.last
        return abs(radius - GEOSTATIONARY_KM) < NEAR_KM and abs(latitude) < LARGEST_LATITUDE_DEG

    @property
    def has_orbit(self) -> bool:
        """Whether it has a state, of an ellipse around the Earth."""
        return self.elements is not None and 0 < self.elements[0] < 1e6 and self.elements[1] < 1


def read_objects(night: NightReader) -> list[NightObject]:
    """Return the objects of a night, in the order of their ids."""
    columns = ["object_id", "time", *PLACE, "cov_xx", "cov_yy", "cov_zz", "n_sensors"]
    variance = (pl.col("cov_xx") + pl.col("cov_yy") + pl.col("cov_zz")) / 3
    sums = [
        rows.group_by("object_id", maintain_order=True).agg(
            positions=pl.len(), sensors=pl.col("n_sensors").max(), variance=variance.sum(),
            first=pl.struct("time", *PLACE).first(), last=pl.struct("time", *PLACE).last(),
        )
        for rows in night.pieces("positions", columns)
    ]  # fmt: skip
    if not sums:
        return []
    rows = pl.concat(sums).group_by("object_id", maintain_order=True).agg(
        pl.col("positions", "variance").sum(), pl.col("sensors").max(),
        pl.col("first").first(), pl.col("last").last(),
    ).sort("object_id")  # fmt: skip
    names = _names(night)
    elements = _elements(night)
    ends = [_ends(rows[side].struct.unnest()) for side in ("first", "last")]
    nothing = (NameStatus.UNKNOWN.value, "")
    return [
        NightObject(
            name, *names.get(name, nothing), row["positions"],
            ends[0][1][k], ends[1][1][k], row["sensors"],
            float(np.sqrt(row["variance"] / row["positions"])),
            ends[0][0][k], ends[1][0][k], elements.get(name),
        )
        for k, row in enumerate(rows.select("positions", "variance", "sensors").to_dicts())
        for name in (rows["object_id"][k],)
    ]  # fmt: skip


def _names(night: NightReader) -> dict[str, tuple[str, str]]:
    """Return the status and the name of each object."""
    rows = night.read("identifications", ["object_id", "status", "name"])
    return {
        name: (status, known if known is not None and status == NameStatus.KNOWN else "")
        for name, status, known in rows.iter_rows()
    }


def _ends(rows: pl.DataFrame) -> tuple[list[tuple[float, float, float]], list[int]]:
    """Return longitudes, latitudes and radii of positions, and their times.

    UT1 is taken to be UTC: less than 0.004 degrees.
    """
    time_ns = rows["time"].dt.epoch("ns").to_numpy()
    r = rows.select(PLACE).to_numpy()
    radius = np.linalg.norm(r, axis=1)
    latitude = np.degrees(np.arcsin(r[:, 2] / radius))
    ra = np.arctan2(r[:, 1], r[:, 0])
    longitude = np.degrees(ra - erfa.era00(*utc_julian_date(time_ns)))
    longitude = (longitude + 180.0) % 360.0 - 180.0
    places = zip(longitude.tolist(), latitude.tolist(), radius.tolist(), strict=True)
    return list(places), time_ns.tolist()


def _elements(night: NightReader) -> dict[str, tuple[float, float, float]]:
    """Return a, e, i of the state of each object that has the most views."""
    rows = night.read("states", ["object_id", "n_views", *PLACE, *VELOCITY])
    rows = rows.sort("n_views", descending=True, maintain_order=True)
    rows = rows.unique("object_id", keep="first", maintain_order=True)
    shape = elements_of(rows.select(PLACE).to_numpy(), rows.select(VELOCITY).to_numpy())
    return dict(zip(rows["object_id"].to_list(), map(tuple, shape.tolist()), strict=True))


def elements_of(r_km: Array, v_km_s: Array) -> Array:
    """Return (n, 3) semi-major axes [km], eccentricities and inclinations [deg] of states.

    A state that is not bound has a negative semi-major axis.
    """
    r = np.linalg.norm(r_km, axis=-1)
    a = 1.0 / (2.0 / r - np.sum(v_km_s**2, axis=-1) / GM_KM3_S2)
    h = np.cross(r_km, v_km_s)
    e = np.cross(v_km_s, h) / GM_KM3_S2 - r_km / r[..., None]
    i = np.degrees(np.arctan2(np.hypot(h[..., 0], h[..., 1]), h[..., 2]))
    return np.stack([a, np.linalg.norm(e, axis=-1), i], axis=-1)
