"""Star field: a catalogue sorted into zones of declination, and directions of its stars."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.simulation.constants import (
    AU_KM,
    DAY_S,
    JULIAN_YEAR_DAYS,
    LIGHT_KM_S,
    MILLIARCSEC,
)

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

JULIAN_YEAR_S = JULIAN_YEAR_DAYS * DAY_S


@dataclass(frozen=True)
class StarField:
    """A catalogue, sorted by zone of declination and then by right ascension."""

    star_id: Indices
    magnitude: Array
    place: Array  # (n, 3) unit vectors at the epoch
    motion: Array  # (n, 3) rad per Julian year
    parallax: Array  # rad
    epoch: float  # Julian year
    key: Array  # zone times 2 pi plus right ascension, increasing
    zone_rad: float


def star_field(
    star_id: Indices,
    ra: Array,
    dec: Array,
    pm_ra_mas_yr: Array,
    pm_dec_mas_yr: Array,
    parallax_mas: Array,
    magnitude: Array,
    *,
    epoch: float,
    radius_rad: float,
) -> StarField:
    """Return the stars prepared for searches in cones of a given radius; angles in rad.

    `pm_ra_mas_yr` includes cos(dec), as in the Hipparcos catalogue.
    """
    zone_rad = float(np.clip(radius_rad / 2, 0.005, 0.1))
    ra = np.remainder(ra, 2 * np.pi)
    key = np.floor((dec + np.pi / 2) / zone_rad) * (2 * np.pi) + ra
    order = np.lexsort((star_id, key))
    ra, dec, key = ra[order], dec[order], key[order]
    sin_a, cos_a, sin_d, cos_d = np.sin(ra), np.cos(ra), np.sin(dec), np.cos(dec)
    east = np.stack([-sin_a, cos_a, np.zeros_like(ra)], axis=1)
    north = np.stack([-sin_d * cos_a, -sin_d * sin_a, cos_d], axis=1)
    motion = east * pm_ra_mas_yr[order, None] + north * pm_dec_mas_yr[order, None]
    return StarField(
        star_id=star_id[order],
        magnitude=magnitude[order],
        place=np.stack([cos_d * cos_a, cos_d * sin_a, sin_d], axis=1),
        motion=motion * MILLIARCSEC,
        # A negative parallax is an error of measurement.
        parallax=np.maximum(parallax_mas[order], 0.0) * MILLIARCSEC,
        epoch=epoch,
        key=key,
        zone_rad=zone_rad,
    )


def stars_in_cones(field: StarField, u: Array, radius_rad: float) -> tuple[Indices, Indices]:
    """Return the pairs (cone, star) of all stars in cones about (n, 3) directions.

    Places are those of the catalogue. Proper motion, parallax and aberration move all but a few
    stars by less than 0.02 degrees: add a margin to the radius.
    """
    dec = np.arcsin(np.clip(u[:, 2], -1, 1))
    ra = np.remainder(np.arctan2(u[:, 1], u[:, 0]), 2 * np.pi)
    zones = np.arange(-int(np.ceil(radius_rad / field.zone_rad)), 0)
    zones = np.concatenate([zones, [0], -zones[::-1]])
    zone = np.floor((dec + np.pi / 2) / field.zone_rad)[:, None] + zones
    over_pole = np.abs(dec) + radius_rad >= np.pi / 2
    ratio = np.sin(radius_rad) / np.where(over_pole, 1.0, np.cos(dec))
    half = np.where(over_pole, np.pi, np.arcsin(np.minimum(ratio, 1.0)))
    low, high = (ra - half)[:, None], (ra + half)[:, None]
    turn = 2 * np.pi
    # The part of the interval within [0, 2 pi), and the part that wraps around.
    around_low = np.where(low < 0, low + turn, 0.0)
    around_high = np.where(low < 0, turn, high - turn)
    lows = np.stack([np.maximum(low, 0) + 0 * zone, around_low + 0 * zone], axis=2)
    highs = np.stack([np.minimum(high, turn) + 0 * zone, around_high + 0 * zone], axis=2)
    base = (zone * turn)[:, :, None]
    first = np.searchsorted(field.key, (base + lows).ravel(), side="left")
    last = np.searchsorted(field.key, (base + highs).ravel(), side="left")
    n = np.maximum(last - first, 0)
    star = np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n) + np.repeat(first, n)
    cone = np.repeat(np.arange(len(u)), n.reshape(len(u), -1).sum(axis=1))
    near = np.einsum("ij,ij->i", field.place[star], u[cone]) >= np.cos(radius_rad)
    return cone[near], star[near]


def star_directions(
    field: StarField, star: Indices, years: Array, r_barycentric_km: Array
) -> Array:
    """Return (n, 3) unit vectors to stars from barycentric positions, before aberration.

    Parameters
    ----------
    star : (n,) int
        Rows of the field.
    years : (n,) float
        TDB Julian years since the catalogue's epoch.
    r_barycentric_km : (n, 3) float
        Positions of the sensor.

    References
    ----------
    ESA SP-1200 (1997), The Hipparcos and Tycho Catalogues, volume 1, section 1.2.8. Radial
    velocities are neglected.
    """
    u0 = field.place[star]
    # Catalogue epochs are of light at the barycentre; the sensor gets it earlier or later.
    ahead_s = np.einsum("ij,ij->i", u0, r_barycentric_km) / LIGHT_KM_S
    u = u0 + field.motion[star] * (years + ahead_s / JULIAN_YEAR_S)[:, None]
    u -= (field.parallax[star] / AU_KM)[:, None] * r_barycentric_km
    return u / np.linalg.norm(u, axis=1, keepdims=True)
