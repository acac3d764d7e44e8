"""Orbit forces: what acts on the satellites of a night, and their areas over mass."""

import re

import numpy as np

from epipole.io.catalogues.earth_orientation import read_earth_orientation
from epipole.schemas.arrays import Array
from epipole.schemas.spans import DAY_NS
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM
from epipole.tasks.algorithms.orbits.forces import Surroundings, surroundings
from epipole.tasks.algorithms.orbits.trajectories import perigee_km

# Names in `orbits.forces`; the last two are followed by the area over mass.
GRAVITY, RADIATION, DRAG = "GM J2-J4 C22 Sun Moon", "radiation", "drag"
_AREA = re.compile(rf"({RADIATION}|{DRAG}) (\S+) m2/kg")

# Radiation moves what stays above this altitude more than air does.
RADIATION_KM = 1000.0
# Area over mass in sunlight, coefficient included: of satellites 0.01 to 0.05 m^2/kg. In the air
# twice that is usual, and the static density may be off by a factor of three.
SUNLIT_AREA, AIR_AREA = (0.02, 0.02), (0.03, 0.06)  # mean and sigma [m^2/kg]


def is_sunlit(state: Array) -> bool:
    """Return whether radiation moves a satellite more than air does: it stays high.

    state : (6,) float
        Position and velocity [km, km/s], in any frame that does not turn.
    """
    return perigee_km(state) > EARTH_RADIUS_KM + RADIATION_KM


def surroundings_of(night: str, ahead_ns: int = 0) -> Surroundings:
    """Return what acts on satellites in a night and half a day around it; times from its noon.

    `ahead_ns` is how much later it ends.
    """
    noon = noon_ns(night)
    earth = read_earth_orientation()
    days = np.datetime64(night, "D") - np.datetime64("1858-11-17", "D")
    ut1_utc_s = float(np.interp(days.astype(float), earth.mjd, earth.ut1_utc_s))
    return surroundings(noon, noon - DAY_NS, noon + DAY_NS + ahead_ns, ut1_utc_s)


def noon_ns(night: str) -> int:
    """Return the noon of a night, from which its times count, since 1970 [ns]."""
    return int(np.datetime64(night, "ns").astype(np.int64)) + DAY_NS // 2


def areas_in(forces: str) -> list[float]:
    """Return the areas over mass in sunlight and in the air that `orbits.forces` names [m^2/kg]."""
    named = dict(_AREA.findall(forces))
    return [float(named.get(force, 0.0)) for force in (RADIATION, DRAG)]
