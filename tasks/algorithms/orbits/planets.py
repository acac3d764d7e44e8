"""Planets: their apparent directions for a sensor, with error bounds."""

from functools import lru_cache
from typing import NamedTuple

import erfa
import numpy as np
from scipy.interpolate import CubicSpline

from epipole.schemas.arrays import Array, Nanoseconds
from epipole.tasks.algorithms.constants import ARCSEC, AU_KM, SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.directions import aberrate
from epipole.tasks.algorithms.times import tt_julian_date

NUMBERS = (1, 2, 4, 5, 6, 7, 8)  # of plan94: Mercury, Venus, Mars ... Neptune

# Largest heliocentric errors of plan94 from 1800 to 2050 (ERFA, plan94), longitude and latitude
# together [arcsec]; radii of the discs [km]: the centroid of a crescent is off the centre.
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
    first, last = int(time_ns.min()) // _NODE_NS, -(-int(time_ns.max()) // _NODE_NS)
    t = (time_ns - first * _NODE_NS) / 1e9
    paths = _paths(first, last)
    seen, earth_km_s = paths.seen(t), paths.earth_km(t, 1)
    line = seen[..., :3] - r_gcrf_km[:, None]
    reach = np.sqrt(np.einsum("npa,npa->np", line, line))
    u = aberrate(line / reach[..., None], (earth_km_s + v_gcrf_km_s)[:, None])
    return u, seen[..., 3] / reach


class _Paths(NamedTuple):
    """Splines over time [s].

    seen : (7, 4), vectors from the Earth to the planets, corrected for light time, and bounds of
        their errors [km]. The light time to a sensor differs: 0.05 arcsec.
    earth_km : (3,), barycentric position of the Earth
    """

    seen: CubicSpline
    earth_km: CubicSpline


@lru_cache(maxsize=16)
def _paths(first: int, last: int) -> _Paths:
    """Return the splines from the first node to the last, counted from 1970; times from the first.

    Sensors share them: 6 ms.
    """
    # Light from Neptune takes more than four hours.
    nodes = np.arange(first - 33, last + 3) * _NODE_NS
    at = (nodes - first * _NODE_NS) / 1e9
    jd = tt_julian_date(nodes)
    from_sun, barycentric = erfa.epv00(*jd)
    earth_km = CubicSpline(at, barycentric["p"] * AU_KM)
    earth_from_sun_km = from_sun["p"] * AU_KM
    needed = at >= -3 * _NODE_NS / 1e9
    seen = np.empty((np.count_nonzero(needed), len(NUMBERS), 4))
    for k, number in enumerate(NUMBERS):
        planet = CubicSpline(at, erfa.plan94(*jd, number)["p"] * AU_KM)
        delay_s = np.zeros(len(seen))
        for _ in range(3):
            # The motion of the Sun is neglected: 0.01 arcsec in the hours of light from Neptune.
            from_sun_km = planet(at[needed] - delay_s)
            line = from_sun_km - earth_from_sun_km[needed]
            delay_s = np.linalg.norm(line, axis=1) / SPEED_OF_LIGHT_KM_S
        seen[:, k, :3] = line
        seen[:, k, 3] = (
            _ERROR_ARCSEC[k] * ARCSEC * np.linalg.norm(from_sun_km, axis=1) + _RADIUS_KM[k]
        )
    return _Paths(CubicSpline(at[needed], seen), earth_km)
