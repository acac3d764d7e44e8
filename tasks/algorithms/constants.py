"""Physical constants and units, each with its source.

The simulator has separate constants (`simulation/`): the code under test must not test itself.
"""

import math

# Units.
ARCSEC = math.pi / 648_000.0  # [rad]
SECOND_NS = 1_000_000_000
DAY_S = 86_400.0
DAY_NS = 86_400 * SECOND_NS

LN_2PI = math.log(2.0 * math.pi)  # of the norm of a normal distribution

# IAU resolutions: SI brochure (exact), and IAU 2012 Resolution B2 (exact).
SPEED_OF_LIGHT_KM_S = 299_792.458
AU_KM = 149_597_870.7

# The Earth: GM with the atmosphere, IERS Conventions (2010), table 1.1; the equatorial radius,
# WGS 84 (NGA.STND.0036); J2 of EGM96 (Lemoine et al. 1998, NASA/TP-1998-206861), whose
# radius is 0.7 m smaller: 2e-7 of J2's effect.
GM_KM3_S2 = 398_600.4418
EARTH_RADIUS_KM = 6378.137
J2 = 1.08262668e-3
ESCAPE_SPEED_KM_S = math.sqrt(2.0 * GM_KM3_S2 / EARTH_RADIUS_KM)  # 11.18: no bound object is faster

# IERS Conventions (2010), equation 5.15: the rate of the Earth rotation angle [rad/s of UT1].
EARTH_RATE_RAD_S = 7.292115146706979e-5

# EGM96, not normalised: zonal J3, J4, and the ellipticity of the equator.
J3 = -2.53265649e-6
J4 = -1.61962159e-6
C22 = 1.57446037e-6
S22 = -9.03803807e-7

# JPL DE440 (Park et al. 2021, AJ 161:105): GM of the Sun and of the Moon [km^3/s^2].
GM_SUN_KM3_S2 = 1.32712440041279e11
GM_MOON_KM3_S2 = 4902.800118

# Pressure of sunlight on a surface that absorbs it, at 1 AU [N/m^2]: the total solar irradiance,
# 1361 W/m^2 (IAU 2015 Resolution B3), over the speed of light.
SUNLIGHT_PRESSURE_N_M2 = 1361.0 / 299_792_458.0
