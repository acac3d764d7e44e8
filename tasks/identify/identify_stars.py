"""The stage that tells stars from the rest and gives every frame its attitude."""

import logging
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.schemas.bridge import (
    array,
    empty,
    flatten,
    nullable,
    stack,
    table,
    unstack,
    unstack_covariance,
)
from epipole.schemas.methods import STAR_IDENTIFICATION, load_method
from epipole.schemas.rejects import Reason, reject_rows
from epipole.schemas.settings import Settings
from epipole.schemas.star_catalogue import with_catalogue
from epipole.schemas.tables import DETECTIONS, REJECTS, STARS
from epipole.schemas.work_tables import SOLUTIONS
from epipole.tasks.algorithms.constants import ARCSEC, DAY_NS, SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.camera import (
    Camera,
    pixel_angle,
    project,
    undistort,
    unproject,
)
from epipole.tasks.algorithms.geometry.rotations import (
    matrix_from_quaternion,
    quaternion_from_matrix,
)
from epipole.tasks.algorithms.geometry.sky import aberrate, boresight_angles, radec_from_unit
from epipole.tasks.algorithms.star_identification.frames.frame import FieldOfView, Search
from epipole.tasks.algorithms.star_identification.frames.spots import (
    UnscaledCentroids,
    brightest_first,
)
from epipole.tasks.algorithms.star_identification.sensor import IdentifiedSensor
from epipole.tasks.algorithms.star_identification.sequence import Priors
from epipole.tasks.algorithms.time.time_scales import earth_velocity
from epipole.tasks.identify.cache_skies import CachedSkies, Catalogue

Array = npt.NDArray[np.float64]
log = logging.getLogger(__name__)


class Identified(NamedTuple):
    """Tables SOLUTIONS (a row a frame), STARS, DETECTIONS and REJECTS."""

    solutions: pa.Table
    stars: pa.Table
    detections: pa.Table
    rejects: pa.Table


def identify_stars(
    exposures: pa.Table,
    places: pa.Table,
    cameras: pa.Table,
    catalogue: pa.Table,
    settings: Settings,
) -> Identified:
    """Stars, attitudes and all other centroids of one sensor's frames over a span of time."""
    if exposures.num_rows == 0:
        return Identified(empty(SOLUTIONS), empty(STARS), empty(DETECTIONS), empty(REJECTS))
    order = np.argsort(array(exposures, "time"), kind="stable")
    exposures, places = exposures.take(order), places.take(order)
    centroids = _centroids(exposures, cameras, settings)
    found, rows = _identify(exposures, places, centroids, catalogue, settings)
    attitudes = _attitudes(places, found, settings)
    matches = _matches(found, rows)
    stars = _stars_table(exposures, places, centroids, attitudes, matches)
    stars = with_catalogue(stars, catalogue.schema)
    result = Identified(
        _solutions_table(exposures, places, centroids, attitudes, matches, stars),
        stars,
        _detections_table(exposures, centroids, attitudes, matches),
        _rejects_table(exposures, centroids),
    )
    log.info(
        "%s: identified %d of %d frames, %d stars, %d other centroids",
        exposures["sensor_id"][0], np.sum(attitudes.source == "stars"), exposures.num_rows,
        result.stars.num_rows, result.detections.num_rows,
    )  # fmt: skip
    return result


class _Centroids(NamedTuple):
    """All centroids, flat: frame k has first[k]:first[k + 1]; cameras by row."""

    first: npt.NDArray[np.int64]
    frame: npt.NDArray[np.int64]
    x_px: Array
    y_px: Array
    flux: Array
    sigma_px: Array  # NaN where unknown
    u: Array
    pixel_rad: Array
    camera_of_frame: npt.NDArray[np.int64]
    cameras: dict[int, Camera]


def _centroids(exposures: pa.Table, cameras: pa.Table, settings: Settings) -> _Centroids:
    x_px, first = flatten(exposures, "x_px")
    y_px, _ = flatten(exposures, "y_px")
    frame = np.repeat(np.arange(exposures.num_rows), np.diff(first))
    sigma_px = _optional(exposures, "sigma_px", len(x_px))
    if settings.sensors.centroid_sigma_px is not None:
        sigma_px = np.where(np.isnan(sigma_px), settings.sensors.centroid_sigma_px, sigma_px)
    holds, used = _cameras_of(exposures, cameras)
    u, pixel_rad = np.zeros((len(x_px), 3)), np.ones(len(x_px))
    for row, camera in used.items():
        at = holds[frame] == row
        u[at] = unproject(camera, x_px[at], y_px[at])
        pixel_rad[at] = pixel_angle(camera, u[at])
    flux = _optional(exposures, "flux", len(x_px))
    return _Centroids(first, frame, x_px, y_px, flux, sigma_px, u, pixel_rad, holds, used)


def _optional(exposures: pa.Table, name: str, n: int) -> Array:
    """Return a list column flat, NaN where the list is null or a value is not positive."""
    _, first = flatten(exposures, "x_px")
    values, at = flatten(exposures, name)
    out = np.full(n, np.nan)
    out[np.repeat(np.diff(at) > 0, np.diff(first))] = values
    out[~(out > 0)] = np.nan
    return out


def _cameras_of(
    exposures: pa.Table, cameras: pa.Table
) -> tuple[npt.NDArray[np.int64], dict[int, Camera]]:
    """Return the row of `cameras` that holds for each frame (-1: none), and those cameras."""
    rows = np.flatnonzero(array(cameras, "sensor_id") == exposures["sensor_id"][0].as_py())
    if len(rows) == 0:
        return np.full(exposures.num_rows, -1), {}
    times = array(cameras, "time")[rows]
    rows = rows[np.argsort(times, kind="stable")]
    newest = np.searchsorted(np.sort(times), array(exposures, "time"), side="right") - 1
    holds = rows[np.maximum(newest, 0)]
    used = np.unique(holds)
    values = [cameras.select(list(Camera._fields)).slice(int(r), 1).to_pylist()[0] for r in used]
    return holds, {int(r): Camera(**v) for r, v in zip(used, values, strict=True)}


def _optics(camera: Camera) -> FieldOfView:
    """Return the field of a camera, its distortion taken into account."""
    n = 9
    side = np.linspace(-0.5, camera.width - 0.5, n)
    down = np.linspace(-0.5, camera.height - 0.5, n)
    x_px = np.concatenate([side, side, np.full(n, side[0]), np.full(n, side[-1])])
    y_px = np.concatenate([np.full(n, down[0]), np.full(n, down[-1]), down, down])
    x, y = undistort(
        camera, (x_px - camera.cx_px) / camera.fx_px, (y_px - camera.cy_px) / camera.fy_px
    )
    half_diagonal = float(np.arctan(np.max(np.hypot(x, y))))
    return FieldOfView(
        half_diagonal, np.array([x.min(), x.max(), y.min(), y.max()]), camera.pixel_rad
    )


def _identify(
    exposures: pa.Table, places: pa.Table, c: _Centroids, catalogue: pa.Table, settings: Settings
) -> tuple[IdentifiedSensor | None, npt.NDArray[np.int64]]:
    """Return what the stars tell, and the rows of the centroids, brightest first in each frame."""
    time_ns = array(exposures, "time")
    rows = brightest_first(c.first, c.flux)
    if not c.cameras:
        return None, rows
    rule = settings.identification
    beta = _velocity(time_ns, places) / SPEED_OF_LIGHT_KM_S
    spots = UnscaledCentroids(
        c.first,
        c.u[rows],
        c.pixel_rad[rows],
        c.sigma_px[rows],
        -2.5 * np.log10(c.flux[rows]),
        beta,
        [_optics(camera) for camera in c.cameras.values()],
        np.searchsorted(np.array(list(c.cameras)), c.camera_of_frame),
    )
    day = int(time_ns[len(time_ns) // 2] // DAY_NS)
    pixel_rad = next(iter(c.cameras.values())).pixel_rad
    skies = CachedSkies(Catalogue(catalogue), day, pixel_rad, rule.merge_px)
    how = Search(rule.gate_sigma, -np.log(rule.false_alarm), rule.time_limit_s, np.nan)
    identify = load_method(STAR_IDENTIFICATION, rule.method)
    t_s = (time_ns - time_ns[0]) / 1e9
    found = identify(t_s, spots, _priors(places, settings), skies, rule.magnitude_limit, how)
    return found, rows


def _velocity(time_ns: npt.NDArray[np.int64], places: pa.Table) -> Array:
    """Return the sensor's barycentric velocity [km/s]; Earth's alone where its own is not known."""
    return earth_velocity(time_ns) + np.nan_to_num(stack(places, "v{}_km_s"))


def _priors(places: pa.Table, settings: Settings) -> Priors:
    q, sigma = stack(places, "q{}", "xyzw"), _prior_sigma(places, settings) * ARCSEC
    return Priors(matrix_from_quaternion(q), np.where(np.isfinite(q[:, 3]), sigma, np.nan))


def _prior_sigma(places: pa.Table, settings: Settings) -> Array:
    sigma = array(places, "attitude_sigma_arcsec").astype(float)
    return np.where(sigma > 0, sigma, settings.sensors.attitude_sigma_arcsec)


class _Attitudes(NamedTuple):
    """A row a frame; NaN without attitude."""

    source: npt.NDArray[np.object_]
    status: list[str | None]
    R: Array
    cov_arcsec2: Array


def _attitudes(places: pa.Table, found: IdentifiedSensor | None, settings: Settings) -> _Attitudes:
    """Return the stars' attitude where there is one, else the prior as it is."""
    n = places.num_rows
    q, sigma = stack(places, "q{}", "xyzw"), _prior_sigma(places, settings)
    R = matrix_from_quaternion(q)
    cov = np.eye(3) * (sigma**2)[:, None, None]
    source = np.where(np.isfinite(q[:, 3]), "prior", "none").astype(object)
    cov[source == "none"] = np.nan
    if found is None:
        return _Attitudes(source, ["no_calibration"] * n, R, cov)
    solved = found.solutions.solved
    source[solved] = "stars"
    R[solved] = found.solutions.R_sensor_from_icrs[solved]
    cov[solved] = found.solutions.cov_rad2[solved] / ARCSEC**2
    return _Attitudes(source, found.status, R, cov)


class _Matches(NamedTuple):
    """A row an identified star: its centroid (flat), and the star."""

    at: npt.NDArray[np.int64]
    star_id: npt.NDArray[np.int64]
    magnitude: Array
    u_icrs: Array
    scale: float


def _matches(found: IdentifiedSensor | None, rows: npt.NDArray[np.int64]) -> _Matches:
    if found is None:
        none = np.empty(0, np.int64)
        return _Matches(none, none, np.empty(0), np.empty((0, 3)), 1.0)
    star = np.empty_like(rows)
    star[rows] = found.solutions.star
    at = np.flatnonzero(star >= 0)
    star = star[at]
    stars = found.sky.catalogue
    return _Matches(
        at, stars.star_id[star], stars.magnitude[star], stars.u_icrs[star], found.sigma_scale
    )


def _key(exposures: pa.Table, frame: npt.NDArray[np.int64]) -> dict[str, pa.ChunkedArray]:
    return {name: exposures[name].take(frame) for name in ("sensor_id", "frame_number", "time")}


def _stars_table(
    exposures: pa.Table, places: pa.Table, c: _Centroids, attitudes: _Attitudes, m: _Matches
) -> pa.Table:
    frame = c.frame[m.at]
    v_km_s = _velocity(array(exposures, "time"), places)
    u = np.einsum("nij,nj->ni", attitudes.R[frame], aberrate(m.u_icrs, v_km_s[frame]))
    dx, dy = np.full((2, len(frame)), np.nan)
    for row, camera in c.cameras.items():
        at = c.camera_of_frame[frame] == row
        x, y = project(camera, u[at])
        dx[at], dy[at] = c.x_px[m.at[at]] - x, c.y_px[m.at[at]] - y
    return table(
        STARS,
        _key(exposures, frame)
        | {
            "centroid": m.at - c.first[frame],
            "star_id": m.star_id,
            "magnitude": m.magnitude,
            "x_px": c.x_px[m.at],
            "y_px": c.y_px[m.at],
            "dx_px": dx,
            "dy_px": dy,
        },
    )


def _solutions_table(
    exposures: pa.Table,
    places: pa.Table,
    c: _Centroids,
    a: _Attitudes,
    m: _Matches,
    stars: pa.Table,
) -> pa.Table:
    n = exposures.num_rows
    frame = c.frame[m.at]
    n_stars = np.bincount(frame, minlength=n)
    squares = np.bincount(frame, array(stars, "dx_px") ** 2 + array(stars, "dy_px") ** 2, n)
    with np.errstate(invalid="ignore", divide="ignore"):
        residual = np.where(n_stars > 0, np.sqrt(squares / (2 * n_stars)), np.nan)
    known = a.source != "none"
    q = np.full((n, 4), np.nan)
    q[known] = quaternion_from_matrix(a.R[known])
    ra, dec, roll = boresight_angles(a.R)
    sigma = np.sqrt(np.diagonal(a.cov_arcsec2, axis1=1, axis2=2))
    values = {
        **unstack("q{}", q, "xyzw"),
        **unstack("sigma_{}_arcsec", sigma),
        **unstack_covariance("cov_att_{}_arcsec2", a.cov_arcsec2),
        "ra_deg": np.degrees(ra),
        "dec_deg": np.degrees(dec),
        "roll_deg": np.degrees(roll),
        "residual_px": residual,
    }
    kept = ("x_km", "y_km", "z_km", "vx_km_s", "vy_km_s", "vz_km_s", "position_sigma_km")
    return table(
        SOLUTIONS,
        _key(exposures, np.arange(n))
        | {name: nullable(v) for name, v in values.items()}
        | {name: places[name] for name in kept}
        | {
            "n_centroids": np.diff(c.first),
            "n_stars": n_stars,
            "attitude_source": a.source,
            "status": a.status,
            "camera": c.camera_of_frame,
        },
    )


def _detections_table(exposures: pa.Table, c: _Centroids, a: _Attitudes, m: _Matches) -> pa.Table:
    """Every centroid that is no star, in a frame with a camera; no direction without attitude."""
    left = (c.camera_of_frame >= 0)[c.frame]
    left[m.at] = False
    at = np.flatnonzero(left)
    frame = c.frame[at]
    u_icrs = np.einsum("nji,nj->ni", a.R[frame], c.u[at])
    ra, dec = radec_from_unit(u_icrs)
    sigma_px = np.where(np.isnan(c.sigma_px[at]), 1.0, c.sigma_px[at]) * m.scale
    return table(
        DETECTIONS,
        _key(exposures, frame)
        | {
            "centroid": at - c.first[frame],
            "x_px": c.x_px[at],
            "y_px": c.y_px[at],
            "flux": nullable(c.flux[at]),
            "ra_deg": nullable(np.degrees(ra)),
            "dec_deg": nullable(np.degrees(dec)),
            "sigma_arcsec": sigma_px * c.pixel_rad[at] / ARCSEC,
            "kind": np.full(len(at), "unknown", object),
            "tracklet_id": pa.nulls(len(at), pa.string()),
            "track_id": pa.nulls(len(at), pa.string()),
        },
    )


def _rejects_table(exposures: pa.Table, c: _Centroids) -> pa.Table:
    """One row for each log: centroids of frames without camera."""
    counts, frames = np.diff(c.first), c.camera_of_frame < 0
    sources, times = array(exposures, "source"), array(exposures, "time")
    rows = []
    for source in sorted(set(sources[frames])):
        at = np.flatnonzero(frames & (sources == source) & (counts > 0))
        if len(at):
            rows.append((source, int(times[at[0]]), int(counts[at].sum())))
    source, time, count = zip(*rows, strict=True) if rows else ((), (), ())
    return reject_rows(
        Reason.NO_CALIBRATION,
        source=list(source),
        sensor_id=exposures["sensor_id"][0].as_py(),
        time=list(time),
        count=list(count),
    )
