"""Cache skies: in memory and on disk, shared where catalogue, day and pixel size are equal."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scenes.random_stars import optics, random_catalogue

from epipole.schemas.bridge import table
from epipole.schemas.star_lists import STAR_CATALOGUE, CatalogueLabel, labelled
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.directions import radec_from_unit
from epipole.tasks.identify import cache_skies
from epipole.tasks.identify.cache_skies import CachedSkies, Catalogue

PIXEL_RAD = 5e-5


def _table(seed=0, **changes):
    stars = random_catalogue(6000, seed)
    ra, dec = radec_from_unit(stars.u_icrs)
    none = np.zeros(6000)
    columns = {
        "star_id": stars.star_id,
        "ra_deg": np.degrees(ra),
        "dec_deg": np.degrees(dec),
        "parallax_mas": none,
        "pm_ra_mas_yr": none,
        "pm_dec_mas_yr": none,
        "sigma_mas": none,
        "pm_sigma_mas_yr": none,
        "magnitude": stars.magnitude,
        "variable": none > 0,
    }
    made = table(STAR_CATALOGUE, columns | changes)
    return labelled(made, CatalogueLabel("random", 2000.0, "nowhere"))


def _skies(seed=0, day=18_000, **changes):
    return CachedSkies(Catalogue(_table(seed, **changes)), day, PIXEL_RAD, 2.0)


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


def _forget():
    for kept in (cache_skies._navigation, cache_skies._sky, cache_skies._pairs):
        kept.cache_clear()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return the folder of an empty disk cache, with nothing kept in memory."""
    monkeypatch.setenv("EPIPOLE_CACHE", str(tmp_path))
    _forget()
    yield tmp_path
    _forget()


def _arrays(pairs):
    """Return all that a table of pairs consists of."""
    return (*pairs.chord, *pairs.near, *(v for v in pairs[1:] if not isinstance(v, tuple)))


def test_what_another_process_left_on_disk_gives_the_same_numbers(folder, monkeypatch):
    made = _skies().sky(5.0), _skies().pairs(5.0, optics())
    _forget()
    monkeypatch.setattr(cache_skies, "pattern_pairs", None)  # not called again
    monkeypatch.setattr(cache_skies, "navigation_catalogue", None)
    read = _skies().sky(5.0), _skies().pairs(5.0, optics())
    for a, b in zip(made[0].catalogue, read[0].catalogue, strict=True):
        np.testing.assert_array_equal(a, b)
    for a, b in zip(_arrays(made[1]), _arrays(read[1]), strict=True):
        np.testing.assert_array_equal(a, b)
        assert type(a) is type(b)


def test_a_damaged_file_is_made_again(folder):
    pairs = _skies().pairs(5.0, optics())
    for path in folder.iterdir():
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 255
        path.write_bytes(content)
    _forget()
    np.testing.assert_array_equal(_skies().pairs(5.0, optics()).first, pairs.first)


@pytest.mark.parametrize(
    "changes",
    [
        {"pm_ra_mas_yr": np.ones(6000)},
        {"parallax_mas": np.ones(6000)},
        {"sigma_mas": np.ones(6000)},
    ],
)
def test_every_column_of_the_catalogue_counts_in_the_key(changes):
    assert Catalogue(_table()) != Catalogue(_table(**changes))


def test_the_catalogues_epoch_and_the_code_count_in_the_key(monkeypatch):
    stars = _table()
    later = Catalogue(labelled(stars, CatalogueLabel("random", 2010.0, "nowhere")))
    assert later != Catalogue(stars)
    key = cache_skies._disk_key("stars", later, 1)
    monkeypatch.setattr(cache_skies, "_code", lambda: "other code")
    assert cache_skies._disk_key("stars", later, 1) != key


def test_places_are_of_the_day(folder):
    fast = {"pm_dec_mas_yr": np.full(6000, 1000.0), "pm_ra_mas_yr": np.full(6000, 1000.0)}
    first, later = (_skies(day=day, **fast).sky(9.0).catalogue for day in (18_000, 18_365))
    a = first.u_icrs[np.argsort(first.star_id)]
    b = later.u_icrs[np.argsort(later.star_id)]
    moved = np.linalg.norm(a - b, axis=1) / ARCSEC
    assert np.median(moved) == pytest.approx(np.sqrt(2), rel=0.02)


def test_a_star_with_an_uncertain_place_is_not_used(folder):
    # 18 years after the epoch: 5" for those of the unsure motion, with pixels of 10".
    unsure = np.where(np.arange(6000) < 100, 300.0, 200.0)
    left_out = _skies(day=17_600, pm_sigma_mas_yr=unsure).sky(9.0).catalogue.star_id
    assert len(left_out) > 5000
    assert not np.isin(_table()["star_id"].to_numpy()[:100], left_out).any()


def test_where_no_star_is_certain_the_sky_is_empty_and_a_warning_says_so(folder, caplog):
    skies = _skies(pm_sigma_mas_yr=np.full(6000, 1000.0))
    assert not len(skies.sky(skies.limit_for(100.0)).catalogue.star_id)
    assert "no star of the catalogue is known to half a pixel (5.2 arcsec)" in caplog.text
