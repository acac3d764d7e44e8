"""Objects of a night, their tracklets on the sky, and the numbers of the last nights."""

import logging
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from epipole.io.catalogues.earth_orientation import read_earth_orientation
from epipole.io.datasets.night_tables import NightReader
from epipole.schemas.arrays import Array
from epipole.schemas.columns import POSITION
from epipole.schemas.errors import DatasetError
from epipole.schemas.rejects import NameStatus, Outcome
from epipole.tasks.algorithms.orbits.reference_frames import from_gcrf, orientation_at
from epipole.tasks.report.frame_series import clock

# Objects: where they are, how they move, and what is known of their names.

Geography = tuple[float, float, float]

GEOSTATIONARY_KM = 42_164.0
NEAR_KM = 1_500.0
LARGEST_LATITUDE_DEG = 20.0


class NightObject(NamedTuple):
    """An object.

    ends : (longitude, latitude [deg], radius [km]) at its first and at its last position; without
        positions, both at the epoch of its orbit; None where unknown
    sigma_km : median over its positions, or that of its orbit: the root of the sum of the
        variances of x, y and z; NaN where unknown
    elements : semi-major axis [km], eccentricity, inclination [deg] of its orbit; None: no orbit
    element_sigmas : their sigmas; NaN without an orbit
    """

    object_id: str
    status: str
    name: str
    verdict: str
    positions: int
    first_ns: int
    last_ns: int
    sensors: int
    sigma_km: float
    ends: tuple[Geography, Geography] | None
    elements: tuple[float, float, float] | None
    element_sigmas: tuple[float, float, float]

    @property
    def about(self) -> str:
        """A line of text about it."""
        name = f" {self.name}" if self.name else ""
        sigma = f", sigma {self.sigma_km:.3g} km" if self.sigma_km == self.sigma_km else ""
        return (
            f"{self.object_id}{name}: {self.status}, {self.verdict}, {self.sensors} sensors, "
            f"{clock(self.first_ns)} to {clock(self.last_ns)}{sigma}"
        )

    @property
    def near_geostationary(self) -> bool:
        """Whether it is near the geostationary ring, by its position."""
        if self.ends is None:
            return False
        _, latitude, radius = self.ends[1]
        return abs(radius - GEOSTATIONARY_KM) < NEAR_KM and abs(latitude) < LARGEST_LATITUDE_DEG

    @property
    def has_orbit(self) -> bool:
        """Whether it has an orbit, an ellipse around the Earth."""
        return self.elements is not None and 0 < self.elements[0] < 1e6 and self.elements[1] < 1


_OBJECTS = ["object_id", "verdict", "n_positions", "first_time", "last_time", "n_sensors", "name"]


def read_objects(night: NightReader) -> list[NightObject]:
    """Return the objects of a night, in the order of their ids."""
    found = night.read("objects", _OBJECTS).sort("object_id")
    statuses = night.read("identifications", ["object_id", "status"]).drop_nulls("object_id")
    status = dict(statuses.iter_rows())
    located = {**_of_orbits(night), **_of_positions(night)}
    names = ["a_km", "e", "i_deg"]
    columns = ["object_id", *names, *(f"sigma_{name}" for name in names)]
    elements = night.read("orbits", columns).rows_by_key("object_id", unique=True)
    objects = []
    for row in found.with_columns(
        first_ns=pl.col("first_time").dt.epoch("ns"), last_ns=pl.col("last_time").dt.epoch("ns")
    ).to_dicts():
        name = row["object_id"]
        ends, sigma_km = located.get(name, (None, float("nan")))
        orbit = elements.get(name)
        objects.append(NightObject(
            name, status.get(name, NameStatus.UNKNOWN.value), row["name"] or "", row["verdict"],
            row["n_positions"], row["first_ns"], row["last_ns"], row["n_sensors"], sigma_km, ends,
            orbit[:3] if orbit else None, orbit[3:] if orbit else _NO_SIGMAS,
        ))  # fmt: skip
    return objects


Located = dict[str, tuple[tuple[Geography, Geography], float]]  # ends, sigma [km]
_VARIANCE = ["cov_xx", "cov_yy", "cov_zz"]
_SIGMA = pl.sum_horizontal(*_VARIANCE).sqrt().alias("sigma_km")
_NO_SIGMAS = (float("nan"),) * 3
MAX_SIGMAS = 2_000_000  # positions for the medians; of more, every n-th is taken


def _of_positions(night: NightReader) -> Located:
    """Return where each object is at its first and its last position."""
    columns = ["object_id", "time", *POSITION, *_VARIANCE]
    step = max(-(-night.count("positions") // MAX_SIGMAS), 1)
    found, sigmas = [], []
    for rows in (night.empty("positions", columns), *night.pieces("positions", columns)):
        found.append(rows.group_by("object_id", maintain_order=True).agg(
            first=pl.struct("time", *POSITION).first(), last=pl.struct("time", *POSITION).last(),
        ))  # fmt: skip
        some = rows.gather_every(step)
        sigmas.append(some.select(pl.col("object_id").cast(pl.Categorical), _SIGMA))
    ends_of = pl.concat(found).group_by("object_id", maintain_order=True)
    rows = ends_of.agg(pl.col("first").first(), pl.col("last").last())
    medians = pl.concat(sigmas).group_by("object_id").median()
    rows = rows.join(medians.cast({"object_id": pl.String}), on="object_id", how="left")
    first, last = (_geography(rows[side].struct.unnest()) for side in ("first", "last"))
    sigma_km = rows["sigma_km"].fill_null(float("nan")).to_list()
    ends = zip(first, last, strict=True)
    return dict(zip(rows["object_id"].to_list(), zip(ends, sigma_km, strict=True), strict=True))


def _of_orbits(night: NightReader) -> Located:
    """Return where each object is at the epoch of its orbit."""
    rows = night.read("orbits", ["object_id", "epoch", *POSITION, *_VARIANCE])
    at = _geography(rows.rename({"epoch": "time"}))
    sigma_km = rows.select(_SIGMA).to_series().to_list()
    ends = zip(at, at, strict=True)
    return dict(zip(rows["object_id"].to_list(), zip(ends, sigma_km, strict=True), strict=True))


def _geography(rows: pl.DataFrame) -> list[Geography]:
    """Return longitudes, geocentric latitudes and radii of positions."""
    time_ns = rows["time"].dt.epoch("ns").to_numpy()
    orientation = orientation_at(time_ns, *read_earth_orientation())
    R = from_gcrf("ITRF", time_ns, orientation)[:, :3, :3]
    r = np.einsum("nij,nj->ni", R, rows.select(POSITION).to_numpy())
    radius = np.linalg.norm(r, axis=1)
    latitude = np.degrees(np.arcsin(r[:, 2] / radius))
    longitude = np.degrees(np.arctan2(r[:, 1], r[:, 0]))
    return list(zip(longitude.tolist(), latitude.tolist(), radius.tolist(), strict=True))


# Tracklets on the sky: some of each outcome, as lines.

MAX_DRAWN = 240
POINTS = 6  # of a line, about


class SkyTrack(NamedTuple):
    """A tracklet: its outcome, and (n, 2) right ascension and declination [deg] along it.

    `object_id` is '' without an object; `about` is a line of text about it.
    """

    outcome: str
    radec_deg: Array
    object_id: str
    about: str


class SkyTracks(NamedTuple):
    """Tracklets of a night; `counts` are of all of them, by outcome, and `lines` of some."""

    counts: dict[str, int]
    lines: list[SkyTrack]


def read_sky_tracks(night: NightReader) -> SkyTracks | None:
    """Return the tracklets of a night; None without tracklets. Of many, every n-th is drawn."""
    columns = ["tracklet_id", "outcome", "n_detections", "object_id", "sensor_id", "start_time",
               "cov_decdec"]  # fmt: skip
    drawn: list[pl.DataFrame] = [night.empty("tracklets", columns)]
    counts: dict[str, int] = {}
    step = max(-(-night.count("tracklets") // MAX_DRAWN), 1)
    passed = 0
    for rows in night.pieces("tracklets", columns):
        for outcome, count in rows["outcome"].value_counts().iter_rows():
            counts[outcome] = counts.get(outcome, 0) + count
        drawn.append(rows.gather_every(step, -passed % step))
        passed += len(rows)
    if not counts:
        return None
    chosen = pl.concat(drawn)
    directions = _directions(night, chosen)
    lines = [
        SkyTrack(row["outcome"], directions[row["tracklet_id"]], row["object_id"] or "",
                 _about(row))
        for row in chosen.with_columns(pl.col("start_time").dt.epoch("ns")).to_dicts()
        if row["tracklet_id"] in directions
    ]  # fmt: skip
    order = [outcome.value for outcome in Outcome]
    known = {outcome: counts[outcome] for outcome in order if outcome in counts}
    return SkyTracks(known, lines)


def _about(row: dict[str, Any]) -> str:
    variance = row["cov_decdec"]
    sigma = "" if variance is None else f", sigma {max(variance, 0.0) ** 0.5:.2g} arcsec"
    of = f", object {row['object_id']}" if row["object_id"] else ""
    return (
        f"{row['tracklet_id']}{of}: {row['sensor_id']} from {clock(row['start_time'])}, "
        f"{row['n_detections']:,} detections{sigma}, {row['outcome']}"
    )


def _directions(night: NightReader, chosen: pl.DataFrame) -> dict[str, Array]:
    names = chosen["tracklet_id"].implode()
    found: dict[str, list[Array]] = {}
    columns = ["tracklet_id", "ra_deg", "dec_deg"]
    for rows in night.pieces("detections", columns):
        chosen_rows = rows.filter(pl.col("tracklet_id").is_in(names)).drop_nulls()
        for (name,), of_track in chosen_rows.group_by("tracklet_id", maintain_order=True):
            found.setdefault(str(name), []).append(of_track.select(columns[1:]).to_numpy())
    return {name: _thinned(np.concatenate(pieces)) for name, pieces in found.items()}


def _thinned(directions: Array) -> Array:
    at = np.unique(np.linspace(0, len(directions) - 1, POINTS).astype(int))
    return directions[at]


# The last nights of the dataset: a few numbers of each.

LOGGER = logging.getLogger(__name__)

MAX_NIGHTS = 30


class NightNumbers(NamedTuple):
    """What is compared between nights; `focal_px` is the focal length of each sensor."""

    night: str
    frames: int
    identified: int
    objects: int
    positions: int
    rejects: int
    focal_px: dict[str, float]

    @property
    def identified_share(self) -> float:
        """The share of frames that are identified."""
        return self.identified / self.frames if self.frames else 0.0


def read_trend(nights: Iterable[NightReader]) -> list[NightNumbers]:
    """Return the numbers of nights, in their order. A night that cannot be read is left out."""
    numbers = []
    for night in nights:
        try:
            numbers.append(_numbers(night))
        except DatasetError as error:
            LOGGER.warning("left out of the trend: %s", error)
    return numbers


def _numbers(night: NightReader) -> NightNumbers:
    frames = identified = 0
    for rows in night.pieces("frames", ["attitude_source"]):
        frames += len(rows)
        identified += int((rows["attitude_source"] == "stars").sum())
    rejects = sum(int(rows["count"].sum()) for rows in night.pieces("rejects", ["count"]))
    optics = night.read("calibrations", ["sensor_id", "fx_px", "fy_px"])
    mean = (pl.col("fx_px") * pl.col("fy_px")).abs().sqrt()
    focal_px = dict(optics.select("sensor_id", mean).iter_rows())
    objects, positions = night.count("objects"), night.count("positions")
    return NightNumbers(night.night, frames, identified, objects, positions, rejects, focal_px)
