"""Time scales: integer UTC nanoseconds to the Julian dates that pyerfa takes, and Earth's velocity."""

import erfa
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Nanoseconds = npt.NDArray[np.int64]

DAY_NS = 86_400_000_000_000
UNIX_EPOCH_JD = 2440587.5
AU_KM = 149597870.7


def utc_julian_date(time_ns: Nanoseconds) -> tuple[Array, Array]:
    """Return the two-part UTC Julian date (whole days + 0.5, fraction) of Unix nanoseconds."""
    day, rest = np.divmod(np.asarray(time_ns, np.int64), DAY_NS)
    return UNIX_EPOCH_JD + day, rest / DAY_NS


def tt_julian_date(time_ns: Nanoseconds) -> tuple[Array, Array]:
    """Return the two-part Julian date in terrestrial time."""
    return erfa.taitt(*erfa.utctai(*utc_julian_date(time_ns)))


def julian_year(time_ns: Nanoseconds) -> Array:
    """Return the Julian epoch, such as 2019.25, in terrestrial time."""
    jd1, jd2 = tt_julian_date(time_ns)
    return 2000.0 + ((jd1 - 2451545.0) + jd2) / 365.25


def earth_barycentric(time_ns: Nanoseconds) -> tuple[Array, Array]:
    """Return Earth's barycentric position [km] and velocity [km/s], (..., 3), ICRS axes.

    TT stands for TDB: they differ by less than 2 ms, which moves Earth's velocity by 1e-8 km/s.
    """
    _, barycentric = erfa.epv00(*tt_julian_date(time_ns))
    return barycentric["p"] * AU_KM, barycentric["v"] * (AU_KM / 86400.0)
