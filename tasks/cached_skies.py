"""Skies made from a catalogue table, kept in the process: sensors of one kind share them."""

import zlib
from functools import lru_cache

import numpy as np
import pyarrow as pa

from epipole.io.star_catalogue import HIPPARCOS_EPOCH
from epipole.schemas.bridge import array
from epipole.tasks.algorithms.star_catalogue import (
    NavigationCatalogue,
    limit_for_density,
    navigation_catalogue,
    places_at,
)
from epipole.tasks.algorithms.star_identification.frame import Optics
from epipole.tasks.algorithms.star_identification.pair_table import PairTable
from epipole.tasks.algorithms.star_identification.sky import (
    Sky,
    pattern_pairs,
    pattern_size,
    sky_grid,
    sky_to_limit,
)
from epipole.tasks.algorithms.star_identification.sky_grid import SkyGrid
from epipole.tasks.algorithms.time_scales import DAY_NS, earth_barycentric, julian_year


class Catalogue:
    """A catalogue table as a key of caches: two with the same content are the same."""

    def __init__(self, stars: pa.Table) -> None:
        self.stars = stars
        key = 0
        for name in ("star_id", "ra_rad", "dec_rad", "magnitude"):
            key = zlib.crc32(array(stars, name).tobytes(), key)
        self.key = (stars.num_rows, key)

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Catalogue) and self.key == other.key


class CachedSkies:
    """Skies of one day for one size of pixel, kept in the process: sensors share them."""

    def __init__(self, catalogue: Catalogue, day: int, merge_rad: float) -> None:
        self.key = (catalogue, day, merge_rad)

    def limit_for(self, stars_per_sr: float) -> float:
        limit = limit_for_density(_navigation(*self.key).magnitude, stars_per_sr)
        return float(np.ceil(limit * 4) / 4)  # in steps, so that like sensors share a sky

    def sky(self, limit: float) -> Sky:
        return _sky(*self.key, limit)

    def grid(self, limit: float, radius_rad: float) -> SkyGrid:
        return _grid(*self.key, limit, radius_rad)

    def pairs(self, limit: float, optics: Optics) -> PairTable:
        n = pattern_size(_sky(*self.key, limit), optics.solid_angle_sr)
        return _pairs(*self.key, n, 2 * optics.half_diagonal_rad)


@lru_cache(maxsize=4)
def _navigation(catalogue: Catalogue, day: int, merge_rad: float) -> NavigationCatalogue:
    time_ns = np.array(day * DAY_NS + DAY_NS // 2, np.int64)
    r_earth_km, _ = earth_barycentric(time_ns)
    names = ("ra_rad", "dec_rad", "parallax_mas", "pm_ra_mas_yr", "pm_dec_mas_yr")
    ra, dec, parallax, pm_ra, pm_dec = (array(catalogue.stars, name) for name in names)
    epoch = float((catalogue.stars.schema.metadata or {}).get(b"epoch", HIPPARCOS_EPOCH))
    years = float(julian_year(time_ns)) - epoch
    u = places_at(ra, dec, parallax, pm_ra, pm_dec, years, r_earth_km)
    star_id, magnitude = array(catalogue.stars, "star_id"), array(catalogue.stars, "magnitude")
    return navigation_catalogue(star_id, u, magnitude, merge_rad)


@lru_cache(maxsize=16)
def _sky(catalogue: Catalogue, day: int, merge_rad: float, limit: float) -> Sky:
    return sky_to_limit(_navigation(catalogue, day, merge_rad), limit)


@lru_cache(maxsize=16)
def _grid(catalogue: Catalogue, day: int, merge_rad: float, limit: float, radius: float) -> SkyGrid:
    return sky_grid(_sky(catalogue, day, merge_rad, limit), radius)


@lru_cache(maxsize=8)
def _pairs(catalogue: Catalogue, day: int, merge_rad: float, n: int, diagonal: float) -> PairTable:
    return pattern_pairs(_navigation(catalogue, day, merge_rad).u_icrs[:n], diagonal)
