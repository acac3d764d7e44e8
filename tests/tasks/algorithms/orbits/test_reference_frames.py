"""Earth-centred frames against astropy and against themselves."""

import numpy as np
import pytest

from epipole.io.catalogues.earth_orientation import EarthOrientation, read_earth_orientation
from epipole.tasks.algorithms.constants import EARTH_RATE_RAD_S
from epipole.tasks.algorithms.orbits.reference_frames import (
    FRAMES,
    MESSAGE_FRAMES,
    from_gcrf,
    gcrf_from_eme2000,
    gcrf_from_itrf,
    orientation_at,
    to_gcrf,
)

METRE = 1e-3  # km
SECOND_NS = 1_000_000_000
DAY_NS = 86400 * SECOND_NS
START_NS = 1_554_091_200 * SECOND_NS  # 2019-04-01T04:00:00Z


@pytest.fixture(scope="module")
def states():
    """Return times over 14 years with low and geostationary orbit states."""
    rng = np.random.default_rng(3)
    time_ns = START_NS + rng.integers(-8 * 365 * DAY_NS, 6 * 365 * DAY_NS, 40)
    u = rng.standard_normal((40, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(u, rng.standard_normal((40, 3)))
    v *= 7.5 / np.linalg.norm(v, axis=1, keepdims=True)
    return time_ns, u * np.where(np.arange(40) % 2, 7000.0, 42164.0)[:, None], v


def astropy_gcrs(frame_class, time_ns, r_km, v_km_s):
    coordinates = pytest.importorskip("astropy.coordinates")
    units = pytest.importorskip("astropy.units")
    time = pytest.importorskip("astropy.time")
    iers = pytest.importorskip("astropy.utils.iers")
    days, rest = np.divmod(time_ns, DAY_NS)
    with iers.conf.set_temp("auto_download", False):
        at = time.Time(2440587.5 + days, rest / DAY_NS, format="jd", scale="utc")
        place = coordinates.CartesianRepresentation((r_km * units.km).T)
        motion = coordinates.CartesianDifferential((v_km_s * units.km / units.s).T)
        frame = getattr(coordinates, frame_class)(place.with_differentials(motion), obstime=at)
        found = frame.transform_to(coordinates.GCRS(obstime=at)).cartesian
        r = found.xyz.to_value(units.km).T
        v = found.differentials["s"].d_xyz.to_value(units.km / units.s).T
    return r, v


@pytest.mark.parametrize(("frame", "frame_class"), [("TEME", "TEME"), ("ITRF", "ITRS")])
def test_states_agree_with_astropy(states, frame, frame_class):
    time_ns, r_km, v_km_s = states
    r, v = to_gcrf(frame, *states, orientation_at(time_ns, *read_earth_orientation()))
    r_astropy, v_astropy = astropy_gcrs(frame_class, time_ns, r_km, v_km_s)
    # At GEO radius; astropy takes Bulletin B where it is out, which turns Earth by 0.0005 arcsec.
    assert np.abs(r - r_astropy).max() < 0.3 * METRE
    assert np.abs(v - v_astropy).max() < 1e-6


def test_eme2000_differs_from_gcrf_by_the_frame_bias_of_astropys_mean_equator():
    coordinates = pytest.importorskip("astropy.coordinates")
    units = pytest.importorskip("astropy.units")
    r_km = np.array([[7000.0, 100.0, -300.0], [0.0, 42164.0, 10.0], [5.0, 6.0, 7000.0]])
    r, _ = gcrf_from_eme2000(r_km, np.zeros((3, 3)))
    # PrecessedGeocentric at J2000 is the mean equator and equinox of J2000: bias only.
    frame = coordinates.PrecessedGeocentric(
        coordinates.CartesianRepresentation((r_km * units.km).T), equinox="J2000", obstime="J2000"
    )
    expected = frame.transform_to(coordinates.GCRS(obstime="J2000")).cartesian.xyz.to_value(
        units.km
    )
    assert np.abs(r - expected.T).max() < 1e-2 * METRE
    assert np.abs(r - r_km).max() > 0.4 * METRE


def test_itrf_velocity_is_the_derivative_of_the_gcrf_position():
    step_s = np.arange(-2, 3) * 10.0
    time_ns = START_NS + (step_s * SECOND_NS).astype(np.int64)
    r0, v = np.array([3000.0, -4000.0, 5000.0]), np.array([4.0, 5.0, 2.0])
    r_km = r0 + v * step_s[:, None]
    orientation = orientation_at(time_ns, *read_earth_orientation())
    r, velocity = gcrf_from_itrf(time_ns, r_km, np.tile(v, (5, 1)), orientation)
    derivative = (8 * (r[3] - r[1]) - (r[4] - r[0])) / (12 * 10.0)
    assert np.abs(velocity[2] - derivative).max() < 1e-7


def test_a_point_at_rest_on_earth_moves_with_it():
    time_ns = np.array([START_NS])
    orientation = orientation_at(time_ns, *read_earth_orientation())
    _, v = gcrf_from_itrf(time_ns, np.array([[6378.0, 0.0, 0.0]]), np.zeros((1, 3)), orientation)
    assert np.linalg.norm(v) == pytest.approx(6378.0 * EARTH_RATE_RAD_S, rel=1e-9)


@pytest.mark.parametrize("frame", FRAMES)
def test_a_missing_velocity_remains_missing_and_does_not_change_the_position(states, frame):
    time_ns, r_km, v_km_s = states
    orientation = orientation_at(time_ns, *read_earth_orientation())
    r, v = to_gcrf(frame, time_ns, r_km, np.full_like(v_km_s, np.nan), orientation)
    expected, _ = to_gcrf(frame, time_ns, r_km, v_km_s, orientation)
    assert np.isnan(v).all()
    np.testing.assert_array_equal(r, expected)


def test_the_sigma_is_zero_within_the_table_and_grows_after_it():
    table = read_earth_orientation()
    table = EarthOrientation(*(column[:15000] for column in table))  # ends in 2014
    end_ns = int((table.mjd[-1] - 40587) * DAY_NS)
    days = np.array([-1000, 0, 100, 1000])
    time_ns = np.append(end_ns + days * DAY_NS, DAY_NS)
    sigma = orientation_at(time_ns, *table).sigma_rad
    np.testing.assert_array_equal(sigma[:2], 0.0)
    assert sigma[2] == pytest.approx(0.00025 * 100**0.75 * EARTH_RATE_RAD_S, rel=0.05)
    assert sigma[3] > sigma[2]
    assert sigma[4] > sigma[3]  # before 1973


def test_ut1_has_no_step_at_a_leap_second():
    leap_ns = 1_483_228_800 * SECOND_NS  # 2017-01-01
    time_ns = leap_ns + np.array([-3600, -1800, 1800, 3600]) * SECOND_NS
    jd1, jd2 = orientation_at(time_ns, *read_earth_orientation()).ut1
    # An hour and the leap second pass from the second to the third.
    steps_s = np.diff((jd1 - jd1[0]) + jd2) * 86400
    np.testing.assert_allclose(steps_s, [1800, 3601, 1800], atol=1e-3)


def test_no_states_give_no_states_and_an_unknown_frame_is_refused():
    none = np.empty((0, 3))
    time_ns = np.empty(0, np.int64)
    orientation = orientation_at(time_ns, *read_earth_orientation())
    for frame in FRAMES:
        assert to_gcrf(frame, time_ns, none, none, orientation)[0].shape == (0, 3)
    with pytest.raises(ValueError, match="J2000"):
        to_gcrf("J2000", time_ns, none, none, orientation)


@pytest.mark.parametrize("frame", MESSAGE_FRAMES)
def test_states_of_messages_turn_back_to_gcrf(states, frame):
    time_ns, r_km, v_km_s = states
    orientation = orientation_at(time_ns, *read_earth_orientation())
    turn = from_gcrf(frame, time_ns, orientation)
    turned = np.einsum("nij,nj->ni", turn, np.concatenate([r_km, v_km_s], axis=1))
    r, v = to_gcrf(frame, time_ns, turned[:, :3], turned[:, 3:], orientation)
    assert np.abs(r - r_km).max() < 1e-8
    assert np.abs(v - v_km_s).max() < 1e-11
