"""What shines in the simulated sky: stars, and objects with their magnitudes."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.special import ndtr

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.tasks.algorithms.simulation.constants import (
    AU_KM,
    DAY_S,
    EARTH_RADIUS_KM,
    JULIAN_YEAR_DAYS,
    LIGHT_KM_S,
    MILLIARCSEC,
)
from epipole.tasks.algorithms.simulation.paths import Paths

# Stars, in zones of declination.


JULIAN_YEAR_S = JULIAN_YEAR_DAYS * DAY_S


@dataclass(frozen=True)
class StarField:
    """A catalogue, sorted by zone of declination and then by right ascension."""

    star_id: Indices
    magnitude: Array
    u_icrs: Array  # (n, 3) unit vectors at the epoch
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
        u_icrs=np.stack([cos_d * cos_a, cos_d * sin_a, sin_d], axis=1),
        motion=motion * MILLIARCSEC,
        # A negative parallax is an error of measurement.
        parallax=np.maximum(parallax_mas[order], 0.0) * MILLIARCSEC,
        epoch=epoch,
        key=key,
        zone_rad=zone_rad,
    )


def stars_in_cones(field: StarField, u: Array, radius_rad: float) -> tuple[Indices, Indices]:
    """Return the pairs (cone, star) of all stars in cones about (n, 3) directions.

    Directions are those of the catalogue. Proper motion, parallax and aberration move all but a few
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
    near = np.einsum("ij,ij->i", field.u_icrs[star], u[cone]) >= np.cos(radius_rad)
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
    u0 = field.u_icrs[star]
    # Catalogue epochs are of light at the barycentre; the sensor gets it earlier or later.
    ahead_s = np.einsum("ij,ij->i", u0, r_barycentric_km) / LIGHT_KM_S
    u = u0 + field.motion[star] * (years + ahead_s / JULIAN_YEAR_S)[:, None]
    u -= (field.parallax[star] / AU_KM)[:, None] * r_barycentric_km
    return u / np.linalg.norm(u, axis=1, keepdims=True)


def may_be_detected(u: Array, magnitude: Array, limit: float, apart_rad: float) -> Flags:
    """Return which stars are bright enough, alone or together with others near them.

    Parameters
    ----------
    u : (n, 3) float
        Unit vectors.
    apart_rad : float
        Stars that are nearer to each other, or in a chain of such, may be one spot.
    """
    pairs = cKDTree(u).query_pairs(apart_rad, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(u),) * 2)
    n, group = connected_components(links, directed=False)
    light = np.bincount(group, 10 ** (-0.4 * magnitude), n)
    return -2.5 * np.log10(light)[group] <= limit


# Magnitudes of objects, and which of them a sensor detects.

STANDARD_RANGE_KM = 1000.0


def magnitude_at(standard: Array, distance_km: Array) -> Array:
    """Return the magnitudes of objects at a distance, of those at 1000 km."""
    return standard + 5 * np.log10(distance_km / STANDARD_RANGE_KM)


def lambert_dimming(u_to_sun: Array, u_to_object: Array) -> Array:
    """Return by how many magnitudes a diffuse sphere is fainter than when fully lit.

    It is infinite where the Sun is straight behind the object.

    Parameters
    ----------
    u_to_sun, u_to_object : (n, 3) float
        Unit vectors, from the Earth and from the sensor.

    References
    ----------
    Russell (1916), On the albedo of the planets and their satellites, ApJ 43, 173: the phase
    law of a sphere that scatters by Lambert's law.
    """
    phase = np.arccos(np.clip(-np.einsum("ij,ij->i", u_to_sun, u_to_object), -1, 1))
    lit = (np.sin(phase) + (np.pi - phase) * np.cos(phase)) / np.pi
    with np.errstate(divide="ignore"):
        return -2.5 * np.log10(np.maximum(lit, 0.0))


def in_earth_shadow(r_km: Array, u_to_sun: Array) -> Flags:
    """Return which positions (n, 3) are in the Earth's shadow, taken as a cylinder."""
    along = np.einsum("ij,ij->i", r_km, u_to_sun)
    off2 = np.einsum("ij,ij->i", r_km, r_km) - along * along
    return (along < 0) & (off2 < EARTH_RADIUS_KM**2)


def detection_probability(magnitude: Array, limit: float, fade: float) -> Array:
    """Return the probability that an object is detected: half at the limit.

    Parameters
    ----------
    fade : float
        Standard deviation of the limit [mag]; with 0 it is sharp.
    """
    if not fade:
        return (magnitude <= limit).astype(float)
    return ndtr((limit - magnitude) / fade)


# Objects.


@dataclass(frozen=True)
class SimulatedObjects:
    """The paths of n objects, their brightness, and what the Sun does to it."""

    paths: Paths
    magnitude: Array  # (n,)
    is_standard: Flags  # (n,) magnitude at 1000 km, else the same everywhere
    earth_shadow: bool = False
    phase_law: bool = False

    def __len__(self) -> int:
        return len(self.paths)

    @property
    def need_sun(self) -> bool:
        """Return whether magnitudes depend on where the Sun is."""
        return self.earth_shadow or self.phase_law

    def magnitudes(self, body: Indices, d_km: Array, r_km: Array, u_to_sun: Array) -> Array:
        """Return the apparent magnitudes of objects; infinite where no light comes from them.

        Parameters
        ----------
        body : (n,) int
            Index of the object.
        d_km, r_km : (n, 3) float
            The object from the sensor, and from the Earth's centre.
        u_to_sun : (n, 3) float
            Unit vectors from the Earth to the Sun; not read unless `need_sun`.
        """
        magnitude = self.magnitude[body]
        distance_km = np.linalg.norm(d_km, axis=1)
        standard = self.is_standard[body]
        magnitude[standard] = magnitude_at(magnitude[standard], distance_km[standard])
        if self.phase_law:
            magnitude = magnitude + lambert_dimming(u_to_sun, d_km / distance_km[:, None])
        if self.earth_shadow:
            magnitude = np.where(in_earth_shadow(r_km, u_to_sun), np.inf, magnitude)
        return magnitude
