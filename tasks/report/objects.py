"""Objects of a night, their tracklets on the sky, and the numbers of the last nights."""

import logging
from collections.abc import Iterable
from typing import NamedTuple

import erfa
import numpy as np
import numpy.typing as npt
import polars as pl

from epipole.io.datasets.night_tables import NightReader
from epipole.schemas.columns import POSITION, VELOCITY
from epipole.schemas.errors import DatasetError
from epipole.schemas.rejects import NameStatus, Outcome
from epipole.tasks.algorithms.constants import GM_KM3_S2
from epipole.tasks.algorithms.times import utc_julian_date

# Objects: where they are, how they move, and what is known of their names.

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
        """Whether it is near the geostationary ring, by its position."""
        _, latitude, radius = self.last
        return abs(radius - GEOSTATIONARY_KM) < NEAR_KM and abs(latitude) < LARGEST_LATITUDE_DEG

    @property
    def has_orbit(self) -> bool:
        """Whether it has a state, of an ellipse around the Earth."""
        return self.elements is not None and 0 < self.elements[0] < 1e6 and self.elements[1] < 1


def read_objects(night: NightReader) -> list[NightObject]:
    """Return the objects of a night, in the order of their ids."""
    columns = ["object_id", "time", *POSITION, "cov_xx", "cov_yy", "cov_zz", "n_sensors"]
    variance = (pl.col("cov_xx") + pl.col("cov_yy") + pl.col("cov_zz")) / 3
    sums = [
        rows.group_by("object_id", maintain_order=True).agg(
            positions=pl.len(), sensors=pl.col("n_sensors").max(), variance=variance.sum(),
            first=pl.struct("time", *POSITION).first(), last=pl.struct("time", *POSITION).last(),
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
    rows = night.read("identifications", ["object_id", "status", "name"]).drop_nulls("object_id")
    return {
        name: (status, known if known is not None and status == NameStatus.KNOWN else "")
        for name, status, known in rows.iter_rows()
    }


def _ends(rows: pl.DataFrame) -> tuple[list[tuple[float, float, float]], list[int]]:
    """Return longitudes, latitudes and radii of positions, and their times.

    UT1 is taken to be UTC: less than 0.004 degrees.
    """
    time_ns = rows["time"].dt.epoch("ns").to_numpy()
    r = rows.select(POSITION).to_numpy()
    radius = np.linalg.norm(r, axis=1)
    latitude = np.degrees(np.arcsin(r[:, 2] / radius))
    ra = np.arctan2(r[:, 1], r[:, 0])
    longitude = np.degrees(ra - erfa.era00(*utc_julian_date(time_ns)))
    longitude = (longitude + 180.0) % 360.0 - 180.0
    geodetic = zip(longitude.tolist(), latitude.tolist(), radius.tolist(), strict=True)
    return list(geodetic), time_ns.tolist()


def _elements(night: NightReader) -> dict[str, tuple[float, float, float]]:
    """Return a, e, i of the state of each object that has the most views."""
    rows = night.read("states", ["object_id", "n_views", *POSITION, *VELOCITY])
    rows = rows.sort("n_views", descending=True, maintain_order=True)
    rows = rows.unique("object_id", keep="first", maintain_order=True)
    shape = elements_of(rows.select(POSITION).to_numpy(), rows.select(VELOCITY).to_numpy())
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


# Tracklets on the sky: some of each outcome, as lines.

MAX_DRAWN = 240
POINTS = 6  # of a line, about


class SkyTrack(NamedTuple):
    """A tracklet: its outcome, and (n, 2) right ascension and declination [deg] along it."""

    outcome: str
    radec_deg: Array


class SkyTracks(NamedTuple):
    """Tracklets of a night; `counts` are of all of them, by outcome, and `lines` of some."""

    counts: dict[str, int]
    lines: list[SkyTrack]


def read_sky_tracks(night: NightReader) -> SkyTracks | None:
    """Return the tracklets of a night; None without tracklets. Of many, every n-th is drawn."""
    columns = ["tracklet_id", "outcome", "n_detections"]
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
        SkyTrack(outcome, directions[name])
        for name, outcome, _ in chosen.iter_rows()
        if name in directions
    ]
    order = [outcome.value for outcome in Outcome]
    known = {outcome: counts[outcome] for outcome in order if outcome in counts}
    return SkyTracks(known, lines)


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
    """Return the numbers of nights, in their order. A night that cannot be read has a line."""
    numbers = []
    for night in nights:
        try:
            numbers.append(_numbers(night))
        except DatasetError as error:
            LOGGER.warning("left out of the trend: %s", error)
    return numbers


def _numbers(night: NightReader) -> NightNumbers:
    frames = identified = positions = 0
    for rows in night.pieces("frames", ["attitude_source"]):
        frames += len(rows)
        identified += int((rows["attitude_source"] == "stars").sum())
    objects: set[str] = set()
    for rows in night.pieces("positions", ["object_id"]):
        positions += len(rows)
        objects.update(rows["object_id"].unique())
    rejects = sum(int(rows["count"].sum()) for rows in night.pieces("rejects", ["count"]))
    optics = night.read("calibrations", ["sensor_id", "fx_px", "fy_px"])
    mean = (pl.col("fx_px") * pl.col("fy_px")).abs().sqrt()
    focal_px = dict(optics.select("sensor_id", mean).iter_rows())
    return NightNumbers(night.night, frames, identified, len(objects), positions, rejects, focal_px)
