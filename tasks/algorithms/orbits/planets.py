"""Planets: their apparent directions for a sensor, with error bounds."""

from typing import NamedTuple

import erfa
import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline

from epipole.tasks.algorithms.constants import ARCSEC, AU_KM, SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.sky import aberrate
from epipole.tasks.algorithms.time.time_scales import tt_julian_date

Array = npt.NDArray[np.float64]
Nanoseconds = npt.NDArray[np.int64]

NUMBERS = (1, 2, 4, 5, 6, 7, 8)  # of plan94: Mercury, Venus, Mars ... Neptune

# Largest heliocentric errors of plan94 from 1800 to 2050 (ERFA, plan94), longitude and latitude
# together [arcsec]; radii of the discs [km], because the light of a crescent is off the centre.
_ERROR_ARCSEC = np.array([4.1, 5.1, 17.0, 71.2, 82.0, 86.3, 11.2])
_RADIUS_KM = np.array([2440.0, 6052.0, 3390.0, 69911.0, 58232.0, 25362.0, 24622.0])

_NODE_NS = 600_000_000_000  # a cubic over ten minutes errs by less than a milliarcsecond


def planet_directions(
    time_ns: Nanoseconds, r_gcrf_km: Array, v_gcrf_km_s: Array
) -> tuple[Array, Array]:
    """Return the planets' apparent directions, and bounds of their errors.

    Parameters
    ----------
    time_ns : (n,) int
        UTC since 1970 [ns].
    r_gcrf_km, v_gcrf_km_s : (n, 3) float
        Position and velocity of the observer.

    Returns
    -------
    u_icrs : (n, 7, 3) float
        Unit vectors to Mercury, Venus, Mars, Jupiter, Saturn, Uranus and Neptune, with light
        time and the aberration of the observer's barycentric velocity.
    error_rad : (n, 7) float
        Sum of the bound of the ephemeris error and the planet's angular radius [rad].

    References
    ----------
    Simon et al. (1994), Numerical expressions for precession formulae and mean elements for the
    Moon and the planets, A&A 282, 663; as in ERFA, plan94 and epv00.
    """
    time_ns = np.asarray(time_ns, np.int64)
    if not len(time_ns):
        return np.zeros((0, len(NUMBERS), 3)), np.zeros((0, len(NUMBERS)))
    origin = int(time_ns.min())
    paths = _paths(origin, int(time_ns.max()))
    t = (time_ns - origin) / 1e9
    here, sun = paths.earth_km(t) + r_gcrf_km, paths.sun_km(t)
    from_sun = np.stack([planet(t) for planet in paths.planets_km], axis=1)
    for _ in range(2):
        line = sun[:, None] + from_sun - here[:, None]
        delay_s = np.linalg.norm(line, axis=-1) / SPEED_OF_LIGHT_KM_S
        # The motion of the Sun is neglected: 0.01 arcsec in the four hours of light from Neptune.
        planets = enumerate(paths.planets_km)
        from_sun = np.stack([planet(t - delay_s[:, k]) for k, planet in planets], axis=1)
    line = sun[:, None] + from_sun - here[:, None]
    reach = np.linalg.norm(line, axis=-1)
    velocity = paths.earth_km.derivative()(t) + v_gcrf_km_s
    u = aberrate(line / reach[..., None], velocity[:, None])
    error_km = _ERROR_ARCSEC * ARCSEC * np.linalg.norm(from_sun, axis=-1) + _RADIUS_KM
    return u, error_km / reach


class _Paths(NamedTuple):
    """Splines over time [s]: barycentric Earth and Sun, heliocentric planets."""

    earth_km: CubicSpline
    sun_km: CubicSpline
    planets_km: list[CubicSpline]


def _paths(first_ns: int, last_ns: int) -> _Paths:
    """Return the paths from first to last time, and five hours earlier for the light time."""
    nodes = np.arange(first_ns - 30 * _NODE_NS, last_ns + 3 * _NODE_NS, _NODE_NS)
    at = (nodes - first_ns) / 1e9
    jd = tt_julian_date(nodes)
    from_sun, barycentric = erfa.epv00(*jd)
    return _Paths(
        CubicSpline(at, barycentric["p"] * AU_KM),
        CubicSpline(at, (barycentric["p"] - from_sun["p"]) * AU_KM),
        [CubicSpline(at, erfa.plan94(*jd, k)["p"] * AU_KM) for k in NUMBERS],
    )
