"""Positions of satellites by SGP4, the theory that published element sets are made for."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from sgp4.api import SGP4_ERRORS, WGS72, Satrec, SatrecArray

from epipole.tasks.algorithms.simulation.element_sets.teme import teme_from_gcrf, utc_julian_date

Array = npt.NDArray[np.float64]
Nanoseconds = npt.NDArray[np.int64]

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


def _failures(bad: npt.NDArray[np.bool_], code: Any, time_ns: Nanoseconds) -> list[Failure]:
    found = []
    for row in np.flatnonzero(bad.any(axis=1)).tolist():
        at = int(np.argmax(bad[row]))
        reason = SGP4_ERRORS.get(int(code[row, at]), "its position is not a number")
        found.append(Failure(row, int(time_ns[at]), reason))
    return found
