"""Earth's orientation: the IERS table finals2000A, from the package astropy-iers-data."""

from functools import cache
from pathlib import Path
from typing import NamedTuple

import astropy_iers_data
import numpy as np

from epipole.schemas.arrays import Array

ARCSEC = np.pi / 648000.0

# Columns of finals2000A (its ReadMe, counted from 1): MJD 8-15, polar motion x 19-27 and
# y 38-46 [arcsec], UT1-UTC 59-68 [s]. After the last prediction they are blank.
_MJD, _X, _Y, _UT1 = slice(7, 15), slice(18, 27), slice(37, 46), slice(58, 68)


class EarthOrientation(NamedTuple):
    """One value per day: measured ones, then predicted ones."""

    mjd: Array  # (n,) UTC, increasing
    ut1_utc_s: Array  # (n,)
    xp_rad: Array  # (n,) polar motion
    yp_rad: Array  # (n,)


@cache
def read_earth_orientation() -> EarthOrientation:
    """Return the table that comes with astropy-iers-data."""
    return parse_earth_orientation(Path(astropy_iers_data.IERS_A_FILE).read_text())


def parse_earth_orientation(text: str) -> EarthOrientation:
    """Return the days of a finals2000A text for which all values are given."""
    lines = [line for line in text.splitlines() if line[_UT1].strip() and line[_X].strip()]
    columns = [[float(line[part]) for line in lines] for part in (_MJD, _UT1, _X, _Y)]
    mjd, ut1_utc_s, xp, yp = (np.array(column) for column in columns)
    return EarthOrientation(mjd, ut1_utc_s, xp * ARCSEC, yp * ARCSEC)
