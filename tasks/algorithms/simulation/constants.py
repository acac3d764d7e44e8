"""The simulator's physical constants, each with its source.

The pipeline's are in `algorithms/constants`. The simulator imports none of them: an error
in one of the two would otherwise be in the truth too, and no test could see it.
"""

import math

ARCSEC = math.pi / 648_000  # [rad]
MILLIARCSEC = math.pi / 648_000_000  # [rad]

SECOND_NS = 1_000_000_000
DAY_S = 86400.0
JULIAN_YEAR_DAYS = 365.25
J2000_JD = 2451545.0  # 2000 January 1, 12h TT: IAU 1994 Resolution C7
UNIX_EPOCH_JD = 2440587.5  # 1970 January 1, 0h UTC
TT_MINUS_TAI_S = 32.184  # IAU 1991 Resolution A4, recommendation IV

# Exact: the metre's definition (CGPM 1983, resolution 1), and IAU 2012 Resolution B2.
LIGHT_KM_S = 299792.458
AU_KM = 149597870.7

# The Earth: GM of IERS Conventions (2010), table 1.1; equatorial radius of WGS 84.
GM_KM3_S2 = 398600.4418
EARTH_RADIUS_KM = 6378.137
