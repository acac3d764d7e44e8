"""Identify stars: which centroids are stars, and the attitude of each frame."""

import logging
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from epipole.schemas.arrays import Array, Flags, Integers
from epipole.schemas.bridge import array, empty, stack
from epipole.schemas.options import STAR_IDENTIFICATION, load_method
from epipole.schemas.settings import IdentificationSettings, SensorSettings
from epipole.schemas.star_lists import with_catalogue
from epipole.schemas.tables import DETECTIONS, REJECTS, STARS
from epipole.schemas.work_tables import SOLUTIONS
from epipole.tasks.algorithms.constants import ARCSEC, DAY_NS, SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.covariances import shared_attitude_covariance
from epipole.tasks.algorithms.geometry.directions import matrix_from_quaternion
from epipole.tasks.algorithms.star_identification.centroids import (
    RawCentroids,
    brightest_first,
    static_centroids,
)
from epipole.tasks.algorithms.star_identification.frame import MatchSettings, field_of_view
from epipole.tasks.algorithms.star_identification.sensor import IdentifiedSensor
from epipole.tasks.algorithms.star_identification.sequence import Priors
from epipole.tasks.common.sightings import optics_covariance_of
from epipole.tasks.identify.cache_skies import CachedSkies, Catalogue
from epipole.tasks.identify.frame_inputs import FlatCentroids, flatten_centroids
from epipole.tasks.identify.rolling_shutter import identify_at_frame_times
from epipole.tasks.identify.tabulate import (
    MatchedStars,
    StarAttitudes,
    barycentric_velocity,
    detections_table,
    matched_stars,
    rejects_table,
    solutions_table,
    stars_table,
    used_sigma_px,
)

LOGGER = logging.getLogger(__name__)


# With more static centroids per frame than this, stars are first searched without them. If at most
# this share of the frames is then identified, all centroids take part.
MANY_STATIC, MIN_IDENTIFIED = 40, 0.5
STATIC_SHARES = (0.7, 0.3)  # of the searches' budget: without static centroids, and with them
# Speed of a circular orbit 500 km high [km/s], sqrt(GM / r): few sensors move faster. A sensor of
# unknown velocity may have this speed, in any direction.
LOW_ORBIT_KM_S = 7.6


class IdentifiedTables(NamedTuple):
    """Tables SOLUTIONS, STARS, DETECTIONS and REJECTS of one sensor's frames."""

    solutions: pa.Table
    stars: pa.Table
    detections: pa.Table
    rejects: pa.Table


def identify_stars(
    exposures: pa.Table,
    frame_states: pa.Table,
    cameras: pa.Table,
    catalogue: pa.Table,
    sensors: SensorSettings,
    identification: IdentificationSettings,
    max_detections: int,
) -> IdentifiedTables:
    """Return the stars, attitudes and other centroids of one sensor's frames, in any order."""
    if exposures.num_rows == 0:
        return IdentifiedTables(empty(SOLUTIONS), empty(STARS), empty(DETECTIONS), empty(REJECTS))
    order = np.argsort(array(exposures, "time"), kind="stable")
    exposures, frame_states = exposures.take(order), frame_states.take(order)
    centroids = flatten_centroids(exposures, cameras, sensors)
    (found, rows), centroids = identify_at_frame_times(
        exposures, frame_states, centroids,
        lambda c: _identify(exposures, frame_states, c, catalogue, sensors, identification),
    )  # fmt: skip
    attitudes = _attitudes(frame_states, found, sensors)
    matches = matched_stars(found, rows, centroids)
    attitudes = _with_optics(attitudes, centroids, matches, cameras)
    attitudes = _with_unknown_velocity(attitudes, frame_states)
    stars = stars_table(exposures, frame_states, centroids, attitudes, matches)
    stars = with_catalogue(stars, catalogue.schema)
    detections, left_out = detections_table(
        exposures, centroids, attitudes, matches, max_detections
    )
    result = IdentifiedTables(
        solutions_table(exposures, frame_states, centroids, attitudes, matches, stars),
        stars,
        detections,
        rejects_table(exposures, centroids, left_out),
    )
    LOGGER.debug(
        "%s: identified %d of %d frames, %d stars, %d other centroids",
        exposures["sensor_id"][0], np.sum(attitudes.source == "stars"), exposures.num_rows,
        result.stars.num_rows, result.detections.num_rows,
    )  # fmt: skip
    return result


def _identify(
    exposures: pa.Table,
    frame_states: pa.Table,
    c: FlatCentroids,
    catalogue: pa.Table,
    sensors: SensorSettings,
    rule: IdentificationSettings,
) -> tuple[IdentifiedSensor | None, Integers]:
    """Return the identified stars, and the centroids that took part: brightest first in each
    frame."""
    rows = brightest_first(c.first, c.flux)
    if not c.cameras:
        return None, rows
    time_ns = array(exposures, "time")
    day = int(time_ns[len(time_ns) // 2] // DAY_NS)
    pixel_rad = next(iter(c.cameras.values())).pixel_rad
    skies = CachedSkies(Catalogue(catalogue), day, pixel_rad, rule.merge_px)
    identify = load_method(STAR_IDENTIFICATION, rule.method)
    t_s, priors = (time_ns - time_ns[0]) / 1e9, _priors(frame_states, sensors)
    beta = barycentric_velocity(time_ns, frame_states) / SPEED_OF_LIGHT_KM_S
    best, taken = None, rows
    selections = list(_selections(c))
    for kept, share in zip(
        selections, STATIC_SHARES if len(selections) > 1 else (1.0,), strict=True
    ):
        part = rows[kept[rows]]
        raw = _raw_centroids(c, part, kept, beta)
        matching = match_settings(rule)._replace(budget_share=share)
        found = identify(t_s, raw, priors, skies, rule.magnitude_limit, matching)
        if best is None or found.solutions.solved.sum() > best.solutions.solved.sum():
            best, taken = found, part
        if best.solutions.solved.mean() > MIN_IDENTIFIED:
            break
    return best, taken


def match_settings(rule: IdentificationSettings) -> MatchSettings:
    """Return how frames are judged, before anything is known of their sensor."""
    return MatchSettings(rule.gate_sigma, -np.log(rule.false_alarm), rule.time_limit_s, np.nan)


def _selections(c: FlatCentroids) -> Iterator[Flags]:
    """Yield which centroids may be stars: without the static ones, if there are many; then all.

    A centroid outside the image is never a star.
    """
    if np.median(np.diff(c.first)) > MANY_STATIC:
        static = c.in_image & static_centroids(c.first, c.x_px, c.y_px)
        if np.median(np.bincount(c.frame[static], minlength=len(c.first) - 1)) > MANY_STATIC:
            yield c.in_image & ~static
    yield c.in_image


def _raw_centroids(c: FlatCentroids, rows: Integers, kept: Flags, beta: Array) -> RawCentroids:
    """Return these centroids, which are those kept in another order."""
    counts = np.bincount(c.frame[kept], minlength=len(c.first) - 1)
    return RawCentroids(
        np.concatenate([[0], np.cumsum(counts)]),
        c.u[rows],
        c.pixel_rad[rows],
        c.sigma_px[rows],
        -2.5 * np.log10(c.flux[rows]),
        beta,
        [field_of_view(camera) for camera in c.cameras.values()],
        np.searchsorted(np.array(list(c.cameras)), c.camera_of_frame),
    )


def _priors(frame_states: pa.Table, sensors: SensorSettings) -> Priors:
    q, sigma = stack(frame_states, "q{}", "xyzw"), _prior_sigma(frame_states, sensors) * ARCSEC
    return Priors(matrix_from_quaternion(q), np.where(np.isfinite(q[:, 3]), sigma, np.nan))


def _prior_sigma(frame_states: pa.Table, sensors: SensorSettings) -> Array:
    sigma = array(frame_states, "attitude_sigma_arcsec").astype(float)
    return np.where(sigma > 0, sigma, sensors.attitude_sigma_arcsec)


def _attitudes(
    frame_states: pa.Table, found: IdentifiedSensor | None, sensors: SensorSettings
) -> StarAttitudes:
    """Return the attitude from stars where there is one, else the prior, unchanged."""
    n = frame_states.num_rows
    q, sigma = stack(frame_states, "q{}", "xyzw"), _prior_sigma(frame_states, sensors)
    R = matrix_from_quaternion(q)
    cov = np.eye(3) * (sigma**2)[:, None, None]
    source = np.where(np.isfinite(q[:, 3]), "prior", "none").astype(object)
    cov[source == "none"] = np.nan
    if found is None:
        return StarAttitudes(source, ["no_calibration"] * n, R, cov, np.zeros_like(cov))
    solved = found.solutions.solved
    source[solved] = "stars"
    R[solved] = found.solutions.R_sensor_from_icrs[solved]
    cov[solved] = found.solutions.cov_rad2[solved] / ARCSEC**2
    return StarAttitudes(source, found.status, R, cov, np.zeros_like(cov))


def _with_optics(
    a: StarAttitudes, c: FlatCentroids, m: MatchedStars, cameras: pa.Table
) -> StarAttitudes:
    """Return the attitudes; those from stars get the error that wrong optics cause."""
    shared, of = a.shared_arcsec2.copy(), c.frame[m.at]
    for row, camera in c.cameras.items():
        cov_optics = optics_covariance_of(cameras, row)
        solved = np.flatnonzero((a.source == "stars") & (c.camera_of_frame == row))
        if not cov_optics.any() or not len(solved):
            continue
        stars = np.flatnonzero(np.isin(of, solved))
        at = m.at[stars]
        sigma_rad = used_sigma_px(c, at, m.floor_px) * c.pixel_rad[at]
        offsets = np.append(np.searchsorted(of[stars], solved), len(stars))
        cov = shared_attitude_covariance(camera, cov_optics, c.u[at], sigma_rad, offsets)
        shared[solved] = cov / ARCSEC**2
    return a._replace(shared_arcsec2=shared)


def _with_unknown_velocity(a: StarAttitudes, frame_states: pa.Table) -> StarAttitudes:
    """Return the attitudes; those from stars get the error of an unknown velocity of the sensor.

    Its aberration moves all stars of a small field alike: a turn across the boresight. About the
    boresight the field does not turn.
    """
    unknown = (a.source == "stars") & np.isnan(stack(frame_states, "v{}_km_s")).any(axis=1)
    sigma_arcsec = LOW_ORBIT_KM_S / np.sqrt(3) / SPEED_OF_LIGHT_KM_S / ARCSEC  # per axis
    across = np.diag([1.0, 1.0, 0.0]) * sigma_arcsec**2
    return a._replace(shared_arcsec2=a.shared_arcsec2 + unknown[:, None, None] * across)
