"""Skies kept in the process."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from random_stars import optics, random_catalogue

from epipole.schemas.bridge import table
from epipole.schemas.work_tables import STAR_CATALOGUE
from epipole.tasks.algorithms.sky import radec_from_unit
from epipole.tasks.cached_skies import CachedSkies, Catalogue


def _table(seed=0):
    stars = random_catalogue(6000, seed)
    ra, dec = radec_from_unit(stars.u_icrs)
    none = np.zeros(6000)
    return table(
        STAR_CATALOGUE,
        {
            "star_id": stars.star_id,
            "ra_rad": ra,
            "dec_rad": dec,
            "parallax_mas": none,
            "pm_ra_mas_yr": none,
            "pm_dec_mas_yr": none,
            "magnitude": stars.magnitude,
            "variable": none > 0,
        },
    )


def _skies(seed=0, day=18_000):
    return CachedSkies(Catalogue(_table(seed)), day, 1e-4)


def test_catalogues_with_the_same_stars_share_a_sky_and_others_do_not():
    assert Catalogue(_table()) == Catalogue(_table())
    assert Catalogue(_table()) != Catalogue(_table(1))
    assert _skies().sky(5.0) is _skies().sky(5.0)
    assert _skies().sky(5.0) is not _skies(seed=1).sky(5.0)
    assert _skies().sky(5.0) is not _skies(day=18_001).sky(5.0)


def test_a_sky_ends_at_its_limit():
    sky = _skies().sky(4.5)
    assert sky.catalogue.magnitude[-1] <= 4.5
    assert sky.rho == pytest.approx(len(sky.catalogue.star_id) / (4 * np.pi))


def test_the_limit_for_a_density_is_a_quarter_step_that_holds_enough():
    limit = _skies().limit_for(100.0)
    assert limit % 0.25 == 0
    assert _skies().sky(limit).rho >= 100.0


def test_pairs_do_not_depend_on_a_limit_beyond_the_pattern_stars():
    field = optics()
    assert _skies().pairs(6.1, field) is _skies().pairs(6.2, field)


def test_threads_that_ask_at_once_get_the_same_numbers():
    with ThreadPoolExecutor(4) as pool:
        skies = list(pool.map(lambda _: _skies(seed=2).sky(5.0), range(8)))
    for sky in skies:
        np.testing.assert_array_equal(sky.catalogue.u_icrs, skies[0].catalogue.u_icrs)
