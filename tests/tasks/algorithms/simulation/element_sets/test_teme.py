"""TEME against astropy."""

import numpy as np
import pytest
from astropy import units
from astropy.coordinates import GCRS, TEME, CartesianRepresentation
from astropy.time import Time
from astropy.utils import iers

from epipole.tasks.algorithms.simulation.element_sets.teme import teme_from_gcrf

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
