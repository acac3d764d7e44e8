"""Identified frames as tables: solutions, stars, detections, rejects.

Detections are the centroids that are no star. If a sensor reports more than can be followed, the
fullest frames keep their brightest (`within_limit`).
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.schemas.arrays import Array, Flags, Integers
from epipole.schemas.bridge import (
    array,
    concat,
    nullable,
    stack,
    table,
    unstack,
    unstack_covariance,
)
from epipole.schemas.rejects import Reason, reject_rows
from epipole.schemas.tables import DETECTIONS, REJECTS, STARS
from epipole.schemas.work_tables import SOLUTIONS
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.camera import project
from epipole.tasks.algorithms.geometry.directions import (
    aberrate,
    boresight_angles,
    quaternion_from_matrix,
    radec_from_unit,
)
from epipole.tasks.algorithms.geometry.turning import turned
from epipole.tasks.algorithms.photometry import flux_scale
from epipole.tasks.algorithms.star_identification.sensor import IdentifiedSensor
from epipole.tasks.algorithms.times import earth_velocity
from epipole.tasks.identify.frame_inputs import FlatCentroids

# The limit of detections.


def within_limit(frame: Integers, flux: Array, max_detections: int) -> Flags:
    """Return which detections are kept, so that there are at most `max_detections`.

    The fullest frames are cut to one number, and keep their brightest. Frames with fewer keep all.
    What the limit leaves then goes to the brightest of those that are next in their frames.

    Parameters
    ----------
    frame : (n,) int
        Frame of each detection, ascending.
    flux : (n,) float
        NaN where unknown: these are cut first, the later ones of a frame before the earlier.
    """
    counts = np.bincount(frame)
    if len(frame) <= max_detections:
        return np.ones(len(frame), bool)
    order = np.lexsort((-np.nan_to_num(flux, nan=-np.inf), frame))
    rank = np.empty(len(frame), np.int64)
    rank[order] = np.arange(len(frame)) - np.repeat(np.cumsum(counts) - counts, counts)
    most = _max_per_frame(counts, max_detections)
    kept = rank < most
    following = order[rank[order] == most]
    brightest = np.argsort(-np.nan_to_num(flux[following], nan=-np.inf), kind="stable")
    kept[following[brightest[: max_detections - int(kept.sum())]]] = True
    return np.asarray(kept)


def _max_per_frame(counts: Integers, max_detections: int) -> int:
    """Return the largest number per frame that keeps all frames together within the limit."""
    low, high = 0, int(counts.max())
    while low < high:
        middle = (low + high + 1) // 2
        if np.minimum(counts, middle).sum() <= max_detections:
            low = middle
        else:
            high = middle - 1
    return low


# The tables.


class StarAttitudes(NamedTuple):
    """The attitude of each frame; NaN where it is unknown."""

    source: npt.NDArray[np.object_]
    status: list[str | None]
    R: Array  # sensor from ICRS
    cov_arcsec2: Array  # independent in each frame, if from stars
    shared_arcsec2: Array  # by errors that frames share: optics, an unknown velocity


class MatchedStars(NamedTuple):
    """Identified stars: the index of each one's centroid, and the star.

    `scale` is the factor on each frame's centroid errors that the stars' residuals show, `floor_px`
    the error that is added in quadrature to the stated ones.
    """

    at: Integers
    star_id: Integers
    magnitude: Array
    u_icrs: Array
    scale: Array
    floor_px: float = 0.0


def barycentric_velocity(time_ns: Integers, frame_states: pa.Table) -> Array:
    """Return the sensor's barycentric velocity [km/s].

    Where the sensor's geocentric velocity is unknown, it is the Earth's.
    """
    return earth_velocity(time_ns) + np.nan_to_num(stack(frame_states, "v{}_km_s"))


def _frame_key(exposures: pa.Table, frame: Integers) -> dict[str, Any]:
    """Return the key columns of rows of one sensor, by the frame of each."""
    return {
        "sensor_id": pa.repeat(exposures["sensor_id"][0], len(frame)),
        **{name: array(exposures, name)[frame] for name in ("frame_number", "time")},
    }


# Residuals are rounded to 2^-20 pixel: a millionth, where errors of centroids are hundredths. Their
# last bits are noise that no compression shortens: 3.5 bytes each instead of 6.5.
RESIDUAL_STEPS = 2.0**20


def stars_table(
    exposures: pa.Table,
    frame_states: pa.Table,
    c: FlatCentroids,
    attitudes: StarAttitudes,
    m: MatchedStars,
) -> pa.Table:
    """Return STARS: a row per identified star."""
    frame = c.frame[m.at]
    v_km_s = barycentric_velocity(array(exposures, "time"), frame_states)
    u = predicted_stars(attitudes.R, m, frame, v_km_s)
    if c.row_s.any():
        u = turned(u, c.turn[m.at])
    dx, dy = np.full((2, len(frame)), np.nan)
    for row, camera in c.cameras.items():
        at = c.camera_of_frame[frame] == row
        x, y = project(camera, u[at])
        dx[at], dy[at] = c.x_px[m.at[at]] - x, c.y_px[m.at[at]] - y
    return table(
        STARS,
        _frame_key(exposures, frame)
        | {
            "centroid": m.at - c.first[frame],
            "star_id": m.star_id,
            "magnitude": m.magnitude,
            "x_px": c.x_px[m.at],
            "y_px": c.y_px[m.at],
            "dx_px": np.round(dx * RESIDUAL_STEPS) / RESIDUAL_STEPS,
            "dy_px": np.round(dy * RESIDUAL_STEPS) / RESIDUAL_STEPS,
        },
    )


def matched_stars(found: IdentifiedSensor | None, rows: Integers, c: FlatCentroids) -> MatchedStars:
    """Return the stars of the centroids; `rows` took part, in this order."""
    if found is None:
        none, frames = np.empty(0, np.int64), len(c.first) - 1
        return MatchedStars(none, none, np.empty(0), np.empty((0, 3)), np.ones(frames))
    star = np.full(len(c.x_px), -1)
    star[rows] = found.solutions.star
    at = np.flatnonzero(star >= 0)
    star = star[at]
    stars = found.sky.catalogue
    return MatchedStars(
        at, stars.star_id[star], stars.magnitude[star], stars.u_icrs[star], found.sigma_scale,
        found.sigma_floor_px,
    )  # fmt: skip


def predicted_stars(R: Array, m: MatchedStars, frame: Integers, v_km_s: Array) -> Array:
    """Return the directions (n, 3) of stars in sensor axes, at the times of their frames.

    Parameters
    ----------
    R : (F, 3, 3) float
        Attitudes, sensor from ICRS.
    frame : (n,) int
        Frame of each star.
    v_km_s : (F, 3) float
        Velocities of the sensor, by which stars are aberrated.
    """
    return np.einsum("nij,nj->ni", R[frame], aberrate(m.u_icrs, v_km_s[frame]))


def used_sigma_px(c: FlatCentroids, at: Integers, floor_px: float) -> Array:
    """Return the 1-sigma errors of centroids that stars were identified with, before the scale of
    each frame: as stated, with the floor; 1 px where the sensor states none."""
    return np.where(np.isnan(c.sigma_px[at]), 1.0, np.hypot(c.sigma_px[at], floor_px))


def solutions_table(
    exposures: pa.Table,
    frame_states: pa.Table,
    c: FlatCentroids,
    a: StarAttitudes,
    m: MatchedStars,
    stars: pa.Table,
) -> pa.Table:
    """Return SOLUTIONS: a row per frame."""
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
    sigma = np.sqrt(np.diagonal(a.cov_arcsec2 + a.shared_arcsec2, axis1=1, axis2=2))
    values = {
        **unstack("q{}", q, "xyzw"),
        **unstack("sigma_{}_arcsec", sigma),
        **unstack_covariance("cov_att_{}_arcsec2", a.cov_arcsec2),
        "ra_deg": np.degrees(ra),
        "dec_deg": np.degrees(dec),
        "roll_deg": np.degrees(roll),
        "residual_px": residual,
    }
    scale = flux_scale(frame, m.star_id, m.magnitude, c.flux[m.at], n)
    values["zero_mag"], values["zero_variance_mag2"] = scale.zero_mag, scale.zero_variance_mag2
    kept = [
        *("x_km", "y_km", "z_km", "vx_km_s", "vy_km_s", "vz_km_s"),
        *("position_sigma_km", "used_position_sigma_km"),
    ]
    return table(
        SOLUTIONS,
        _frame_key(exposures, np.arange(n))
        | {name: nullable(v) for name, v in values.items()}
        | {name: frame_states[name] for name in kept}
        | {
            "n_centroids": np.diff(c.first),
            "n_stars": n_stars,
            "attitude_source": a.source,
            "status": a.status,
            "camera": c.camera_of_frame,
            "flux_floor_mag2": scale.floor_mag2,
            "flux_photon_mag2": scale.photon_mag2,
        },
    )


def detections_table(
    exposures: pa.Table, c: FlatCentroids, a: StarAttitudes, m: MatchedStars, max_detections: int
) -> tuple[pa.Table, Integers]:
    """Return DETECTIONS, a row per centroid in the image that is not a star, and the number
    of detections left out of each frame, (F,). There are at most `max_detections` rows.

    A detection's direction is missing where the frame's attitude is unknown.
    """
    left = c.in_image.copy()
    left[m.at] = False
    at = np.flatnonzero(left)
    kept = within_limit(c.frame[at], c.flux[at], max_detections)
    left_out = np.bincount(c.frame[at[~kept]], minlength=exposures.num_rows)
    at = at[kept]
    frame = c.frame[at]
    u_icrs = np.einsum("nji,nj->ni", a.R[frame], c.u[at])
    ra, dec = radec_from_unit(u_icrs)
    sigma_px = used_sigma_px(c, at, m.floor_px) * m.scale[frame]
    rows = table(
        DETECTIONS,
        _frame_key(exposures, frame)
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
    return rows, left_out


def rejects_table(exposures: pa.Table, c: FlatCentroids, left_out: Integers) -> pa.Table:
    """Return rows of `rejects`, per log and reason.

    They count centroids in frames without a camera, repeated ones, centroids outside the image, and
    detections beyond the limit; `left_out` are the latter by frame.
    """
    n, calibrated = exposures.num_rows, c.camera_of_frame >= 0
    uncalibrated = np.where(calibrated, 0, np.diff(c.first))
    repeated = np.where(calibrated, np.bincount(c.frame[c.repeated], minlength=n), 0)
    outside = np.bincount(c.frame[~c.in_image], minlength=n) - uncalibrated - repeated
    return concat(
        REJECTS,
        [
            _counted(Reason.NO_CALIBRATION, exposures, uncalibrated),
            _counted(Reason.REPEATED_CENTROID, exposures, repeated),
            _counted(Reason.OUTSIDE_IMAGE, exposures, outside),
            _counted(Reason.TOO_MANY_DETECTIONS, exposures, left_out),
        ],
    )


def _counted(reason: Reason, exposures: pa.Table, counts: Integers) -> pa.Table:
    """Return a row of `rejects` per log in which something of a frame was left out."""
    sources, times = array(exposures, "source"), array(exposures, "time")
    rows = []
    for source in sorted(set(sources[counts > 0])):
        at = np.flatnonzero((sources == source) & (counts > 0))
        rows.append((source, int(times[at[0]]), int(counts[at].sum())))
    source, time, count = zip(*rows, strict=True) if rows else ((), (), ())
    return reject_rows(
        reason,
        source=list(source),
        sensor_id=exposures["sensor_id"][0].as_py(),
        time=list(time),
        count=list(count),
    )
