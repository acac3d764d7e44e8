"""Arrays of tracklets: attributables and their covariances, from rows of TRACKLETS."""

import numpy as np
import polars as pl

from epipole.schemas.arrays import Array
from epipole.schemas.bridge import stack_covariance
from epipole.schemas.columns import ATTRIBUTABLE_AXES, POSITION, VELOCITY
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.directions import east_north, unit_from_radec
from epipole.tasks.algorithms.orbit_linking.arc_fit import Tracklets

# Tracklets with an attributable, and a sensor whose position and velocity are known.
HAS_ATTRIBUTABLE = pl.all_horizontal(
    pl.col("epoch", *POSITION, *VELOCITY).is_not_null(), pl.col("cov_rara").is_finite()
)


def known_numbers(rows: pl.DataFrame) -> pl.Series:
    """Return a number for each tracklet, from 0: one for those of an object, or of a track.

    -1 for a tracklet of neither.
    """
    # An object's id has no slash.
    name = pl.coalesce("object_id", pl.format("{}/{}", "sensor_id", "track_id"))
    number = name.rank("dense").cast(pl.Int64) - 1
    return rows.select(known=number.fill_null(-1)).to_series()


def attributables_of(rows: pl.DataFrame) -> Tracklets:
    """Return the attributables of rows of TRACKLETS, which are in order of time."""
    ra_rate, dec_rate = (
        rows[name].to_numpy() * ARCSEC for name in ("ra_rate_arcsec_s", "dec_rate_arcsec_s")
    )
    u = unit_from_radec(
        np.radians(rows["ra_deg"].to_numpy()), np.radians(rows["dec_deg"].to_numpy())
    )
    east, north = (np.ascontiguousarray(axis) for axis in np.moveaxis(east_north(u), 1, 0))
    origin = rows["epoch"].min()
    time_s, first_s, last_s = (
        (rows[name] - origin).dt.total_nanoseconds().to_numpy() / 1e9
        for name in ("epoch", "start_time", "end_time")
    )
    return Tracklets(
        time_s,
        first_s,
        last_s,
        rows["sensor_id"].rank("dense").cast(pl.Int64).to_numpy() - 1,
        np.ascontiguousarray(rows.select(POSITION).to_numpy()),
        np.ascontiguousarray(rows.select(VELOCITY).to_numpy()),
        u,
        east,
        north,
        ra_rate[:, None] * east + dec_rate[:, None] * north,
        covariance_of(rows),
        rows["position_sigma_km"].to_numpy().copy(),
    )


def covariance_of(rows: pl.DataFrame) -> Array:
    """Return the covariances of attributables, with what the sensor's tracklets share, (n, 4, 4).

    Of right ascension (times cos dec), declination [rad] and their rates [rad/s].
    """
    cov = stack_covariance(rows, "cov_{}", ATTRIBUTABLE_AXES) * ARCSEC**2
    shared = (rows["bias_sigma_arcsec"].fill_null(0.0).to_numpy() * ARCSEC) ** 2
    cov[:, [0, 1], [0, 1]] += shared[:, None]
    return cov
