"""State interpolation, against an independent orbit model (SGP4)."""

import numpy as np
import pytest

from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry import directions as rotations
from epipole.tasks.algorithms.orbits.state_interpolation import (
    SensorStates,
    interpolate_states,
)

METRE = 1e-3  # km
METRE_S = 1e-3  # km/s
SECOND_NS = 1_000_000_000
START_NS = 1_554_091_200 * SECOND_NS
SIGMA_KM = 0.022
GAP_S = 120.0

# A low orbit, about 400 km up.
LOW = (
    "1 25544U 98067A   19091.16666667  .00002000  00000-0  38000-4 0  9990",
    "2 25544  51.6430 300.0000 0002000 100.0000 260.0000 15.53000000 10000",
)


def low_orbit(at_s):
    """Return SGP4's positions and velocities, seconds after the start."""
    sgp4 = pytest.importorskip("sgp4.api")
    satellite = sgp4.Satrec.twoline2rv(*LOW)
    days = 2458574.5 + np.zeros(len(at_s))
    failed, r, v = satellite.sgp4_array(days, 1 / 6 + np.asarray(at_s) / 86400.0)
    assert not failed.any()
    return r, v


def fixed_to_earth(at_s):
    """Return a telescope's path: no orbit, but Earth's rotation."""
    angle = 7.292115e-5 * np.asarray(at_s)
    r = 6378.0 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    return r, 7.292115e-5 * np.cross([0.0, 0.0, 1.0], r)


def nanoseconds(at_s):
    return START_NS + np.rint(np.asarray(at_s) * SECOND_NS).astype(np.int64)


def states_at(at_s, path=low_orbit, velocities=True, noise_km=0.0, q=None, seed=0):
    r, v = path(at_s)
    n = len(at_s)
    r = r + noise_km * np.random.default_rng(seed).standard_normal((n, 3))
    return SensorStates(
        nanoseconds(at_s),
        r,
        v if velocities else np.full((n, 3), np.nan),
        np.full(n, SIGMA_KM),
        np.full((n, 4), np.nan) if q is None else q,
        np.full(n, 60.0),
    )


def errors(states, at_s, path=low_orbit, gap_s=GAP_S):
    """Return the distances and the velocity errors at given seconds, and the sigmas."""
    places = interpolate_states(states, nanoseconds(at_s), gap_s)
    r, v = path(at_s)
    return (
        np.linalg.norm(places.r_gcrf_km - r, axis=1),
        np.linalg.norm(places.v_gcrf_km_s - v, axis=1),
        places.position_sigma_km,
    )


def between(at_s, n=400):
    return np.sort(np.random.default_rng(1).uniform(at_s[0], at_s[-1], n))


@pytest.mark.parametrize("velocities", [True, False])
@pytest.mark.parametrize(
    ("step_s", "limit_km"), [(1, 0.01 * METRE), (10, 0.1 * METRE), (60, METRE)]
)
def test_a_low_orbit_is_interpolated_between_states(velocities, step_s, limit_km):
    at_s = np.arange(0.0, 20 * step_s + 1, step_s)
    distance, speed, _ = errors(states_at(at_s, low_orbit, velocities), between(at_s))
    assert distance.max() < limit_km
    assert speed.max() < 0.05 * METRE_S


@pytest.mark.parametrize("velocities", [True, False])
def test_a_point_at_rest_on_earth_is_interpolated_too(velocities):
    at_s = np.arange(0.0, 61.0)
    states = states_at(at_s, fixed_to_earth, velocities)
    distance, _, _ = errors(states, between(at_s), fixed_to_earth)
    assert distance.max() < METRE


@pytest.mark.parametrize("step_s", [120, 240])
def test_long_gaps_are_interpolated_with_reported_velocities(step_s):
    at_s = np.arange(0.0, 5 * step_s + 1, step_s)
    distance, _, _ = errors(states_at(at_s), between(at_s))
    assert distance.max() < METRE


@pytest.mark.parametrize("velocities", [True, False])
@pytest.mark.parametrize("step_s", [0.01, 0.1, 1.0, 10.0])
def test_independent_errors_of_positions_are_not_amplified(velocities, step_s):
    at_s = np.arange(0, 301) * step_s
    states = states_at(at_s, velocities=velocities, noise_km=0.01)
    distance, speed, sigma = errors(states, between(at_s))
    of_states = 0.01 * np.sqrt(3)
    assert np.sqrt(np.mean(distance**2)) < 1.1 * of_states
    assert np.sqrt(np.mean(speed**2)) < (0.1 if velocities else 10) * METRE_S
    np.testing.assert_allclose(sigma, SIGMA_KM)


@pytest.mark.parametrize("velocities", [True, False])
@pytest.mark.parametrize("ahead_s", [-30.0, -1.0, 0.5, 5.0, 30.0])
def test_a_state_is_extrapolated_with_an_honest_sigma(velocities, ahead_s):
    at_s = np.arange(0.0, 61.0)
    wanted_s = np.array([ahead_s if ahead_s < 0 else 60.0 + ahead_s])
    normalised = []
    for seed in range(60):
        states = states_at(at_s, velocities=velocities, noise_km=SIGMA_KM, seed=seed)
        distance, _, sigma = errors(states, wanted_s)
        normalised.append(distance[0] ** 2 / (3 * sigma[0] ** 2))
    # The mean of 180 squared standard normals is 1 +- 0.105.
    assert np.mean(normalised) < 1.4
    if not velocities:
        assert np.mean(normalised) > 0.5


def test_a_frame_too_far_from_any_state_has_no_position():
    states = states_at(np.array([0.0, 1.0, 2.0, 100.0, 101.0]))
    at_ns = nanoseconds([-31.0, -29.0, 31.0, 33.0, 50.0, 71.0, 130.0, 132.0])
    found = np.isfinite(interpolate_states(states, at_ns, 30.0).r_gcrf_km[:, 0])
    assert found.tolist() == [False, True, True, False, False, True, True, False]


def test_in_a_wide_gap_the_nearest_state_is_extrapolated():
    at_s = np.array([0.0, 1.0, 501.0, 502.0])
    wanted_s = np.array([31.0, 471.0])
    distance, _, sigma = errors(states_at(at_s), wanted_s)
    assert distance.max() < 10 * METRE
    assert (sigma > SIGMA_KM).all()


def test_one_state_is_enough_if_it_has_a_velocity():
    distance, _, sigma = errors(states_at(np.array([0.0])), np.array([0.0, 20.0, -20.0]))
    assert distance.max() < 10 * METRE
    assert sigma[0] == SIGMA_KM
    assert (sigma[1:] > SIGMA_KM).all()
    places = interpolate_states(states_at([0.0], velocities=False), nanoseconds([0.0]), GAP_S)
    assert np.isnan(places.r_gcrf_km).all()


def test_two_states_without_velocity_are_interpolated():
    states = states_at(np.array([0.0, 10.0]), velocities=False)
    distance, _, _ = errors(states, np.array([0.0, 2.5, 10.0]))
    assert distance.max() < METRE


def test_a_missing_velocity_is_fitted_to_the_other_states():
    at_s = np.arange(0.0, 31.0)
    states = states_at(at_s)
    states.v_gcrf_km_s[10:15] = np.nan
    distance, speed, _ = errors(states, between(at_s))
    assert distance.max() < 0.01 * METRE
    assert speed.max() < 0.05 * METRE_S


@pytest.mark.parametrize(("n", "m"), [(0, 3), (3, 0), (0, 0)])
def test_no_states_or_no_frames_give_no_places(n, m):
    places = interpolate_states(states_at(np.arange(float(n))), nanoseconds(np.arange(m)), GAP_S)
    assert [len(column) for column in places] == [m] * 5
    assert np.isnan(places.r_gcrf_km).all()


def test_inputs_are_unchanged():
    states = states_at(np.arange(5.0), velocities=False)
    before = [column.copy() for column in states]
    interpolate_states(states, nanoseconds(np.array([0.5, 7.0])), GAP_S)
    for column, old in zip(states, before, strict=True):
        np.testing.assert_array_equal(column, old)


# Prior attitudes


def turning(at_s, rate_rad_s=0.01):
    at_s = np.asarray(at_s)
    return rotations.quaternion_from_rotation_vector(rate_rad_s * at_s[:, None] * [0.6, 0.0, 0.8])


def attitudes_at(states, at_s):
    places = interpolate_states(states, nanoseconds(np.asarray(at_s)), GAP_S)
    return places.q_sensor_from_icrs, places.attitude_sigma


def test_attitudes_turn_at_a_constant_rate_between_states():
    at_s, wanted_s = np.arange(0.0, 6.0), np.array([0.0, 0.25, 3.5, 5.0])
    q, sigma = attitudes_at(states_at(at_s, q=turning(at_s)), wanted_s)
    off = rotations.multiply(q, rotations.conjugate(turning(wanted_s)))
    angle = np.linalg.norm(rotations.rotation_vector_from_quaternion(off), axis=1)
    assert angle.max() < 1e-3 * ARCSEC
    np.testing.assert_array_equal(sigma, 60.0)


def test_attitudes_are_missing_beyond_states_and_in_long_gaps():
    at_s = np.array([0.0, 1.0, 31.0, 32.0])
    q, sigma = attitudes_at(states_at(at_s, q=turning(at_s)), [-0.1, 0.5, 2.0, 31.0, 31.5, 32.1])
    known = [False, True, False, True, True, False]
    assert np.isfinite(q[:, 3]).tolist() == np.isfinite(sigma).tolist() == known


def test_states_without_attitude_between_others_are_skipped():
    at_s = np.arange(0.0, 5.0)
    q = turning(at_s)
    q[[1, 3]] = np.nan
    found, sigma = attitudes_at(states_at(at_s, q=q), [0.5, 1.0, 3.2])
    assert np.isfinite(found).all()
    np.testing.assert_array_equal(sigma, 60.0)
