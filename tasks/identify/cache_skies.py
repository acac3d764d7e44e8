"""Cache skies: those made from a catalogue are kept in memory and on disk, shared by sensors."""

import hashlib
import inspect
import logging
import sys
from functools import cache, lru_cache
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import scipy

from epipole.io.caches.arrays import cached
from epipole.schemas.bridge import array
from epipole.schemas.star_lists import STAR_CATALOGUE, label_of
from epipole.tasks.algorithms import star_catalogue
from epipole.tasks.algorithms import times as time_scales
from epipole.tasks.algorithms.constants import ARCSEC, DAY_NS
from epipole.tasks.algorithms.star_catalogue import (
    NavigationCatalogue,
    limit_for_density,
    navigation_catalogue,
    star_directions,
    star_sigmas,
)
from epipole.tasks.algorithms.star_identification import star_grid, star_pairs
from epipole.tasks.algorithms.star_identification.frame import FieldOfView
from epipole.tasks.algorithms.star_identification.star_grid import (
    Sky,
    SkyGrid,
    pattern_pairs,
    pattern_size,
    sky_grid,
    sky_to_limit,
)
from epipole.tasks.algorithms.star_identification.star_pairs import KVector, NearStars, PairTable
from epipole.tasks.algorithms.times import earth_barycentric, julian_year

LOGGER = logging.getLogger(__name__)

# Stars whose position at the date is less certain than this are not used [pixels, 1-sigma].
SURE_PX = 0.5

# The code that makes the arrays on disk: if it changes, they are made again.
_MADE_BY: tuple[ModuleType, ...] = (star_catalogue, time_scales, star_pairs, star_grid)


class Catalogue:
    """A labelled catalogue that can be a key of a cache; equal content makes it equal."""

    def __init__(self, stars: pa.Table) -> None:
        self.stars = stars
        self.epoch = label_of(stars.schema).epoch
        self.key = _digest(_Same(stars))

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Catalogue) and self.key == other.key


class _Same:
    """A table that equals only itself: to look at its content once."""

    def __init__(self, stars: pa.Table) -> None:
        self.stars = stars

    def __hash__(self) -> int:
        return id(self.stars)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.stars is other.stars


@lru_cache(maxsize=2)
def _digest(catalogue: _Same) -> str:
    stars = catalogue.stars
    digest = hashlib.blake2b(repr(label_of(stars.schema).epoch).encode(), digest_size=16)
    for name in STAR_CATALOGUE.names:
        digest.update(array(stars, name).tobytes())
    return digest.hexdigest()


class CachedSkies:
    """Skies of one day for one pixel size; stars closer than `merge_px` are merged."""

    def __init__(self, catalogue: Catalogue, day: int, pixel_rad: float, merge_px: float) -> None:
        self.key = (catalogue, day, round(pixel_rad, 9), merge_px)

    def limit_for(self, stars_per_sr: float) -> float:
        limit = limit_for_density(_navigation(*self.key).magnitude, stars_per_sr)
        return float(np.ceil(limit * 4) / 4)  # in steps, so that similar sensors share a sky

    def sky(self, limit: float) -> Sky:
        return _sky(*self.key, limit)

    def grid(self, limit: float, radius_rad: float) -> SkyGrid:
        return _grid(*self.key, limit, radius_rad)

    def pairs(self, limit: float, optics: FieldOfView) -> PairTable:
        n = pattern_size(_sky(*self.key, limit), optics.solid_angle_sr)
        return _pairs(*self.key, n, 2 * optics.half_diagonal_rad)


@lru_cache(maxsize=4)
def _navigation(
    catalogue: Catalogue, day: int, pixel_rad: float, merge_px: float
) -> NavigationCatalogue:
    def make() -> dict[str, npt.NDArray[Any]]:
        return dict(_make_navigation(catalogue, day, pixel_rad, merge_px)._asdict())

    kept = NavigationCatalogue(
        **cached(_disk_key("stars", catalogue, day, pixel_rad, merge_px), make)
    )
    if not len(kept.star_id):
        LOGGER.warning(
            "no star of the catalogue is known to half a pixel (%.2g arcsec) at this date: "
            "no frame can be identified",
            SURE_PX * pixel_rad / ARCSEC,
        )
    return kept


def _make_navigation(
    catalogue: Catalogue, day: int, pixel_rad: float, merge_px: float
) -> NavigationCatalogue:
    stars = catalogue.stars
    time_ns = np.array(day * DAY_NS + DAY_NS // 2, np.int64)
    r_earth_km, _ = earth_barycentric(time_ns)
    years = float(julian_year(time_ns)) - catalogue.epoch
    u = star_directions(
        np.radians(array(stars, "ra_deg")),
        np.radians(array(stars, "dec_deg")),
        array(stars, "parallax_mas"),
        array(stars, "pm_ra_mas_yr"),
        array(stars, "pm_dec_mas_yr"),
        years,
        r_earth_km,
    )
    error = star_sigmas(array(stars, "sigma_mas"), array(stars, "pm_sigma_mas_yr"), years)
    sure = error <= SURE_PX * pixel_rad
    star_id, magnitude = array(stars, "star_id"), array(stars, "magnitude")
    return navigation_catalogue(star_id[sure], u[sure], magnitude[sure], merge_px * pixel_rad)


@lru_cache(maxsize=16)
def _sky(catalogue: Catalogue, day: int, pixel_rad: float, merge_px: float, limit: float) -> Sky:
    return sky_to_limit(_navigation(catalogue, day, pixel_rad, merge_px), limit)


@lru_cache(maxsize=16)
def _grid(
    catalogue: Catalogue, day: int, pixel_rad: float, merge_px: float, limit: float, radius: float
) -> SkyGrid:
    return sky_grid(_sky(catalogue, day, pixel_rad, merge_px, limit), radius)


@lru_cache(maxsize=8)
def _pairs(
    catalogue: Catalogue, day: int, pixel_rad: float, merge_px: float, n: int, diagonal: float
) -> PairTable:
    def make() -> dict[str, npt.NDArray[Any]]:
        u_icrs = _navigation(catalogue, day, pixel_rad, merge_px).u_icrs[:n]
        table = pattern_pairs(u_icrs, diagonal)
        line = np.array([table.chord.slope, table.chord.intercept])
        near = table.near
        return {
            "s": table.chord.s, "below": table.chord.below, "line": line,
            "first": table.first, "second": table.second,
            "at_first": table.at_first, "at_second": table.at_second,
            "near_first": near.first, "near_other": near.other, "near_chord": near.chord,
            "near_turn": near.turn, "near_reach": np.array([near.reach]),
        }  # fmt: skip

    key = _disk_key("pairs", catalogue, day, pixel_rad, merge_px, n, diagonal)
    kept: dict[str, npt.NDArray[Any]] = dict(cached(key, make))
    slope, intercept = kept.pop("line").tolist()
    chord = KVector(kept.pop("s"), kept.pop("below"), slope, intercept)
    near = NearStars(
        kept.pop("near_first"), kept.pop("near_other"), kept.pop("near_chord"),
        kept.pop("near_turn"), float(kept.pop("near_reach")[0]),
    )  # fmt: skip
    return PairTable(chord, **kept, n_stars=n, near=near)


def _disk_key(what: str, catalogue: Catalogue, *inputs: float) -> str:
    words = repr((catalogue.key, inputs, _code())).encode()
    return f"{what}-{hashlib.blake2b(words, digest_size=16).hexdigest()}"


@cache
def _code() -> str:
    """Return a digest of the code that makes the arrays, and of its libraries."""
    text = "".join(inspect.getsource(module) for module in (*_MADE_BY, sys.modules[__name__]))
    return hashlib.blake2b(f"{np.__version__} {scipy.__version__} {text}".encode()).hexdigest()
