"""TEME, the frame of SGP4, in GCRF: by the equinox, where the pipeline goes by the CIO."""

import erfa
import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.simulation.constants import DAY_S, SECOND_NS, UNIX_EPOCH_JD
from epipole.tasks.algorithms.simulation.ephemeris import terrestrial_julian_date

Array = npt.NDArray[np.float64]
Nanoseconds = npt.NDArray[np.int64]


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
