"""Positions of satellites from published element sets by SGP4, turned from TEME to GCRF."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import erfa
import numpy as np
from sgp4.api import SGP4_ERRORS, WGS72, Satrec, SatrecArray

from epipole.schemas.arrays import Array, Flags, Nanoseconds
from epipole.tasks.algorithms.simulation.constants import (
    AU_KM,
    DAY_S,
    J2000_JD,
    JULIAN_YEAR_DAYS,
    SECOND_NS,
    TT_MINUS_TAI_S,
    UNIX_EPOCH_JD,
)

# Time scales, and the Earth's barycentric position and velocity, for many times at once.


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


# TEME to GCRF by the equinox; the pipeline goes by the CIO, so the two can be compared.


def utc_julian_date(time_ns: Nanoseconds) -> tuple[Array, Array]:
    """Return midnight and the part of the day of UTC nanoseconds since 1970, in days."""
    days, rest_ns = np.divmod(np.asarray(time_ns, np.int64), int(DAY_S) * SECOND_NS)
    return UNIX_EPOCH_JD + days, rest_ns / (DAY_S * SECOND_NS)


def teme_from_gcrf(time_ns: Nanoseconds) -> Array:
    """Return the rotations (n, 3, 3) that take GCRF coordinates to TEME.

    GCRF to the true equator and equinox of date is IAU 2000B: frame bias, the precession of IAU
    1976 with its corrected rates, and nutation. SGP4 counts sidereal time by GMST of 1982, so the
    x axis of TEME lies behind the true equinox by apparent minus that mean sidereal time. The
    difference of the two hardly depends on UT1, for which UTC is taken. Together right to 1 mas:
    3 cm for a low orbit, 0.2 m at geostationary height.

    References
    ----------
    Vallado et al. (2006), Revisiting Spacetrack Report 3, AIAA 2006-6753, appendix C. McCarthy
    and Luzum (2003), An abridged model of the precession-nutation of the celestial pole, Celest.
    Mech. Dyn. Astron. 85, 37-49 (IAU 2000B).
    """
    utc = utc_julian_date(time_ns)
    true_from_gcrf = erfa.ufunc.pnm00b(*terrestrial_julian_date(time_ns))
    ahead = erfa.ufunc.anpm(erfa.ufunc.gst00b(*utc) - erfa.ufunc.gmst82(*utc))
    teme_from_true = np.zeros((*np.shape(ahead), 3, 3))
    teme_from_true[..., 0, 0] = teme_from_true[..., 1, 1] = np.cos(ahead)
    teme_from_true[..., 0, 1] = np.sin(ahead)
    teme_from_true[..., 1, 0] = -teme_from_true[..., 0, 1]
    teme_from_true[..., 2, 2] = 1.0
    return teme_from_true @ true_from_gcrf


# SGP4.

SGP4_EPOCH_JD = 2433281.5  # 1949 December 31, 0h: SGP4 counts days from it
# The arguments of `sgp4init`, in its order and units [days, rad, rad/min and 1 / Earth radii].
MEAN_ELEMENTS = (
    "epoch_days", "bstar", "ndot", "nddot", "ecco", "argpo", "inclo", "mo", "no_kozai", "nodeo",
)  # fmt: skip


class Failure(NamedTuple):
    """The first time at which SGP4 has no position of a satellite."""

    satellite: int  # row of the elements
    time_ns: int
    reason: str


def propagate(mean_elements: Array, time_ns: Nanoseconds) -> tuple[Array, list[Failure]]:
    """Return where satellites are by SGP4, and for which of them it fails.

    SGP4's velocities are not returned: they lack the rates of several of its terms, and are up to
    0.1 m/s from the derivative of its positions at geostationary height, more in a low orbit.

    Parameters
    ----------
    mean_elements : (n, 10) float
        Columns as in `MEAN_ELEMENTS`, of WGS 72 as published element sets are.
    time_ns : (m,) int
        UTC since 1970.

    Returns
    -------
    r_km : (n, m, 3) float
        GCRF; NaN where SGP4 fails.
    failures : list
        One for each satellite that SGP4 fails for, such as one that has decayed.

    References
    ----------
    Vallado et al. (2006), Revisiting Spacetrack Report 3, AIAA 2006-6753.
    """
    shape = len(mean_elements), len(time_ns), 3
    if not shape[0] or not shape[1]:
        return np.empty(shape), []
    satellites = SatrecArray([_satellite(row) for row in mean_elements])
    code, r_teme_km, _ = satellites.sgp4(*utc_julian_date(time_ns))
    bad = (code != 0) | ~np.isfinite(r_teme_km).all(axis=2)
    r_km = np.einsum("mji,nmj->nmi", teme_from_gcrf(time_ns), r_teme_km)
    return np.where(bad[:, :, None], np.nan, r_km), _failures(bad, code, time_ns)


def _satellite(elements: Sequence[float] | Array) -> Any:
    satellite = Satrec()
    satellite.sgp4init(WGS72, "i", 0, *[float(value) for value in elements])
    return satellite


def _failures(bad: Flags, code: Any, time_ns: Nanoseconds) -> list[Failure]:
    found = []
    for row in np.flatnonzero(bad.any(axis=1)).tolist():
        at = int(np.argmax(bad[row]))
        reason = SGP4_ERRORS.get(int(code[row, at]), "its position is not a number")
        found.append(Failure(row, int(time_ns[at]), reason))
    return found
