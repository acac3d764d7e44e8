"""SGP4 over time: as astropy and sgp4 have it, and failures that name the satellite."""

import numpy as np
import pytest
from astropy import units
from astropy.coordinates import GCRS, TEME, CartesianRepresentation
from astropy.time import Time
from astropy.utils import iers
from scenes.satellites import EPOCH_NS, ISS, LINES, element_set, two_lines
from sgp4.api import Satrec

from epipole.tasks.algorithms.simulation.element_sets import propagate, teme_from_gcrf

METRE = 1e-3
HOUR_NS = 3600 * 10**9


def in_gcrs(satellite, t_ns):
    """Return positions by sgp4 from the two lines, turned by astropy."""
    time = Time(t_ns.astype("datetime64[ns]").astype("datetime64[us]"), scale="utc")
    code, r_km, _ = satellite.sgp4_array(time.jd1, time.jd2)
    assert not code.any()
    place = TEME(CartesianRepresentation(r_km.T * units.km), obstime=time)
    with iers.conf.set_temp("auto_download", False), iers.conf.set_temp("auto_max_age", None):
        return place.transform_to(GCRS(obstime=time)).cartesian.xyz.to_value(units.km).T


@pytest.mark.filterwarnings("ignore")
def test_positions_are_those_of_sgp4_and_astropy():
    t_ns = EPOCH_NS // 1000 * 1000 + np.arange(-48, 49) * HOUR_NS
    satellites = [Satrec.twoline2rv(*LINES), Satrec.twoline2rv(*two_lines("7", 1.0027, e=0.0003)),
                  Satrec.twoline2rv(*two_lines("8", 2.006, e=0.7))]  # fmt: skip
    r_km, failures = propagate(np.array([element_set(s).elements for s in satellites]), t_ns)
    assert failures == []
    for found, satellite in zip(r_km, satellites, strict=True):
        assert np.linalg.norm(found - in_gcrs(satellite, t_ns), axis=1).max() < METRE


def test_a_satellite_that_decays_is_told_with_the_time():
    fast = element_set(Satrec.twoline2rv(*two_lines("9", 16.4, bstar=0.05)))
    t_ns = EPOCH_NS + np.arange(0, 24 * 20) * HOUR_NS
    r_km, failures = propagate(np.array([ISS.elements, fast.elements]), t_ns)
    ((satellite, time_ns, reason),) = failures
    assert satellite == 1
    at = int(np.searchsorted(t_ns, time_ns))
    assert 0 < at < len(t_ns)
    assert np.isfinite(r_km[0]).all()
    assert np.isfinite(r_km[1, :at]).all()
    assert np.isnan(r_km[1, at]).all()
    assert "eccentricity" in reason or "decayed" in reason


def test_no_satellites_and_no_times_give_empty_arrays():
    none, _ = propagate(np.empty((0, 10)), np.array([EPOCH_NS]))
    assert none.shape == (0, 1, 3)
    none, _ = propagate(np.array([ISS.elements]), np.empty(0, np.int64))
    assert none.shape == (1, 0, 3)


GEO_KM = 42164.0
WITHIN_KM = 2.05e-4  # IAU 2000B is within 1 mas of 2000A, which astropy has


@pytest.mark.filterwarnings("ignore")  # astropy's doubt of the future
@pytest.mark.parametrize("year", [1998, 2010, 2019, 2026, 2035])
def test_teme_is_astropys_to_a_milliarcsecond_at_geostationary_height(year):
    t_ns = np.datetime64(f"{year}-01-01T00:00:00", "ns").astype(np.int64)
    t_ns = t_ns + np.arange(0, 366, 11) * 86_461 * 10**9
    rng = np.random.default_rng(year)
    r_km = rng.standard_normal((len(t_ns), 3))
    r_km *= GEO_KM / np.linalg.norm(r_km, axis=1, keepdims=True)
    time = Time(t_ns.astype("datetime64[ns]").astype("datetime64[us]"), scale="utc")
    place = TEME(CartesianRepresentation(r_km.T * units.km), obstime=time)
    with iers.conf.set_temp("auto_download", False), iers.conf.set_temp("auto_max_age", None):
        expected = place.transform_to(GCRS(obstime=time)).cartesian.xyz.to_value(units.km).T
    found = np.einsum("nji,nj->ni", teme_from_gcrf(t_ns), r_km)
    assert np.linalg.norm(found - expected, axis=1).max() < WITHIN_KM
