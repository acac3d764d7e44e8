"""Time scales: Julian dates of UTC nanoseconds, for pyerfa, and Earth's barycentric motion."""

from functools import cache

import erfa
import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.constants import AU_KM, DAY_NS, DAY_S

Array = npt.NDArray[np.float64]
Nanoseconds = npt.NDArray[np.int64]

UNIX_EPOCH_JD = 2440587.5
NODE_NS = 600_000_000_000
TT_MINUS_TAI_S = 32.184


def utc_julian_date(time_ns: Nanoseconds) -> tuple[Array, Array]:
    """Return the two-part UTC Julian date (whole days + 0.5, fraction) of Unix nanoseconds."""
    day, rest = np.divmod(np.asarray(time_ns, np.int64), DAY_NS)
    return UNIX_EPOCH_JD + day, rest / DAY_NS


def tai_minus_utc_s(jd_utc: Array) -> Array:
    """Return TAI-UTC [s] on UTC days, given by Julian dates.

    From erfa's table. `erfa.utctai` itself would warn of every date a few years ahead, and it
    counts a day with a leap second as 86,401 s where Unix time has 86,400 s. Before 1972 the
    value is 10 s, the first of the table: UTC drifted then, and no log is that old.
    """
    days, seconds = _leap_seconds()
    return seconds[np.maximum(np.searchsorted(days, jd_utc, side="right") - 1, 0)]


@cache
def _leap_seconds() -> tuple[Array, Array]:
    """Return the Julian dates of the steps of TAI-UTC, and its values [s] from there on."""
    steps = erfa.leap_seconds.get()
    steps = steps[steps["year"] >= 1972]
    jd1, jd2 = erfa.cal2jd(steps["year"], steps["month"], 1)
    return jd1 + jd2, np.asarray(steps["tai_utc"], float)


def tt_julian_date(time_ns: Nanoseconds) -> tuple[Array, Array]:
    """Return the two-part Julian date in terrestrial time."""
    day, fraction = utc_julian_date(time_ns)
    return day, fraction + (tai_minus_utc_s(day) + TT_MINUS_TAI_S) / DAY_S


def julian_year(time_ns: Nanoseconds) -> Array:
    """Return the Julian epoch, such as 2019.25, in terrestrial time."""
    jd1, jd2 = tt_julian_date(time_ns)
    return 2000.0 + ((jd1 - 2451545.0) + jd2) / 365.25


def earth_barycentric(time_ns: Nanoseconds) -> tuple[Array, Array]:
    """Return Earth's barycentric position [km] and velocity [km/s], (..., 3), ICRS axes.

    TT is used for TDB: they differ by less than 2 ms, which moves Earth's velocity by 1e-8 km/s.
    """
    _, barycentric = erfa.epv00(*tt_julian_date(time_ns))
    return barycentric["p"] * AU_KM, barycentric["v"] * (AU_KM / DAY_S)


def earth_velocity(time_ns: Nanoseconds) -> Array:
    """Return Earth's barycentric velocity [km/s], (n, 3), ICRS axes, at any number of times.

    Interpolated between full ten minutes, with errors of 1e-7 km/s, 50 times faster than
    `earth_barycentric`. The result at a time does not depend on the other times.
    """
    time_ns = np.asarray(time_ns, np.int64)
    node, rest = np.divmod(time_ns, NODE_NS)
    nodes, at = np.unique(node, return_inverse=True)
    _, before = earth_barycentric(nodes * NODE_NS)
    _, after = earth_barycentric((nodes + 1) * NODE_NS)
    share = (rest / NODE_NS)[:, None]
    return (1.0 - share) * before[at] + share * after[at]
