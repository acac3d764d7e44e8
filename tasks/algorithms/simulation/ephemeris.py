"""Time scales, and the Earth's barycentric position and velocity, quickly for many times."""

import erfa
import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.simulation.constants import (
    AU_KM,
    DAY_S,
    J2000_JD,
    JULIAN_YEAR_DAYS,
    SECOND_NS,
    TT_MINUS_TAI_S,
    UNIX_EPOCH_JD,
)

Array = npt.NDArray[np.float64]
Nanoseconds = npt.NDArray[np.int64]

NODE_S = 1200  # [s] cubics between the series' values at this distance err by 1e-6 km
DAY_NS = int(DAY_S) * SECOND_NS


def terrestrial_julian_date(time_ns: Nanoseconds) -> tuple[Array, Array]:
    """Return the two-part TT Julian date of UTC nanoseconds since 1970.

    TAI-UTC is IAU SOFA's, one value for each UTC day. The bare ufuncs are called: their
    wrappers warn of every date some years ahead, for which SOFA keeps the last leap second.
    """
    days, rest_ns = np.divmod(np.asarray(time_ns, np.int64), DAY_NS)
    midnight = UNIX_EPOCH_JD + days
    year, month, day, _, _ = erfa.ufunc.jd2cal(midnight, 0.0)
    tai_minus_utc_s, _ = erfa.ufunc.dat(year, month, day, 0.0)
    return midnight, rest_ns / DAY_NS + (tai_minus_utc_s + TT_MINUS_TAI_S) / DAY_S


def barycentric_julian_date(time_ns: Nanoseconds) -> tuple[Array, Array]:
    """Return the two-part TDB Julian date of UTC nanoseconds since 1970, right to 30 us.

    References
    ----------
    Astronomical Almanac (2012), section B, TDB-TT: the term of the Earth's eccentricity.
    """
    jd1, jd2 = terrestrial_julian_date(time_ns)
    g = np.radians(357.53 + 0.98560028 * (jd1 - J2000_JD + jd2))
    return jd1, jd2 + 0.001657 * np.sin(g) / DAY_S


def julian_years_since(epoch: float, time_ns: Nanoseconds) -> Array:
    """Return TDB Julian years since an epoch, such as 1991.25 of the Hipparcos catalogue."""
    jd1, jd2 = barycentric_julian_date(time_ns)
    return ((jd1 - J2000_JD) + jd2) / JULIAN_YEAR_DAYS + (2000.0 - epoch)


def earth_at(time_ns: Nanoseconds) -> tuple[Array, Array]:
    """Return the Earth's barycentric positions [km] and velocities [km/s], (n, 3), ICRS axes.

    IAU SOFA's series costs 20 microseconds for each time, so it is taken every 20 minutes,
    with Hermite cubics between.
    """
    seconds, rest = np.divmod(np.asarray(time_ns, np.int64), SECOND_NS)
    if not len(seconds):
        return np.empty((0, 3)), np.empty((0, 3))
    first = int(seconds.min()) // NODE_S * NODE_S
    nodes = np.arange(first, int(seconds.max()) + NODE_S + 1, NODE_S)
    _, earth = erfa.epv00(*barycentric_julian_date(nodes * SECOND_NS))
    p, v = earth["p"] * AU_KM, earth["v"] * (AU_KM / DAY_S)
    i = np.clip((seconds - first) // NODE_S, 0, len(nodes) - 2)
    u = (((seconds - nodes[i]) + rest * 1e-9) / NODE_S)[:, None]
    p0, p1, m0, m1 = p[i], p[i + 1], v[i] * NODE_S, v[i + 1] * NODE_S
    a, b = 2 * (p0 - p1) + m0 + m1, 3 * (p1 - p0) - 2 * m0 - m1
    return p0 + u * (m0 + u * (b + u * a)), (m0 + u * (2 * b + u * 3 * a)) / NODE_S


def directions_to_sun(time_ns: Nanoseconds) -> Array:
    """Return the unit vectors from the Earth's centre to the Sun, (n, 3), ICRS axes.

    Linear between IAU SOFA's series every 20 minutes, in which the Sun moves by 50 arcsec.
    """
    seconds = np.asarray(time_ns, np.int64) / SECOND_NS
    if not len(seconds):
        return np.empty((0, 3))
    first = int(seconds.min()) // NODE_S * NODE_S
    nodes = np.arange(first, int(seconds.max()) + NODE_S + 1, NODE_S)
    sun_to_earth, _ = erfa.epv00(*barycentric_julian_date(nodes * SECOND_NS))
    to_sun = np.stack([np.interp(seconds, nodes, -axis) for axis in sun_to_earth["p"].T], axis=1)
    return to_sun / np.linalg.norm(to_sun, axis=1, keepdims=True)
