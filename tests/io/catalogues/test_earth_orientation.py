"""The Earth-orientation table against astropy's reading of it."""

import numpy as np
import pytest

from epipole.io.catalogues.earth_orientation import parse_earth_orientation, read_earth_orientation

ARCSEC = np.pi / 648000.0


def test_the_table_is_daily_and_complete():
    table = read_earth_orientation()
    np.testing.assert_array_equal(np.diff(table.mjd), 1.0)
    assert all(np.isfinite(column).all() for column in table)
    assert table.mjd[0] == 41684.0
    assert np.abs(table.ut1_utc_s).max() < 1.0


def test_its_values_are_those_that_astropy_reads():
    iers = pytest.importorskip("astropy.utils.iers")
    units = pytest.importorskip("astropy.units")
    table = read_earth_orientation()
    theirs = iers.IERS_A.open(iers.IERS_A_FILE)
    n = len(table.mjd)
    assert theirs["MJD"][n - 1].to_value(units.day) == table.mjd[-1]
    for name, ours in (
        ("UT1_UTC_A", table.ut1_utc_s),
        ("PM_x_A", table.xp_rad / ARCSEC),
        ("PM_y_A", table.yp_rad / ARCSEC),
    ):
        values = theirs[name][:n]
        unit = units.s if name == "UT1_UTC_A" else units.arcsec
        np.testing.assert_allclose(ours, values.to_value(unit), atol=1e-9)


def test_days_without_values_are_left_away():
    lines = "73 1 2 41684.00 I  0.120733 0.009786  0.136966 0.015902  I 0.8084178 0.0002710"
    table = parse_earth_orientation(lines + "\n" + "73 1 3 41685.00" + " " * 100 + "\n")
    assert table.mjd.tolist() == [41684.0]
    assert table.ut1_utc_s.tolist() == [0.8084178]
    assert table.yp_rad.tolist() == [0.136966 * ARCSEC]
