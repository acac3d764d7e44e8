"""States: no mistake is named in sound ephemerides of any kind, and each mistake in each kind."""

import itertools

import numpy as np
import pytest
from scenes.ephemerides import ORBITS, earth_fixed, ephemeris

from epipole.tasks.algorithms.log_checks.findings import SOUND, UNKNOWN, WRONG
from epipole.tasks.algorithms.log_checks.states import LogStates, check_states

FLYING = ("low", "middle", "eccentric", "transfer")


def causes(states, verdict=WRONG):
    return {found.cause for found in check_states(states) if found.verdict == verdict}


def seconds(states):
    return (states.time_ns - states.time_ns[0]) / 1e9


@pytest.mark.parametrize("kind", ORBITS)
def test_no_mistake_is_named_in_a_sound_ephemeris(kind):
    """One state to two hours, 1 s to 200 s apart, exact to 5 km, with and without velocities."""
    rng = np.random.default_rng(5)
    for duration_s, step_s, noise_km, velocities, itrf in itertools.product(
        (0, 22, 7200), (1, 30, 200), (1e-6, 0.01, 5), (True, False), (True, False)
    ):
        if duration_s / step_s <= 300:
            sigma_km = noise_km * rng.choice([0.0, 1.0, 30.0])
            states = ephemeris(rng, kind, duration_s, step_s, noise_km, sigma_km, velocities, itrf)
            assert causes(states) == set(), (duration_s, step_s, noise_km, velocities, itrf)


@pytest.mark.parametrize("kind", ORBITS)
def test_errors_that_neighbours_share_are_no_mistake(kind):
    rng = np.random.default_rng(6)
    for size_km, lasting_s, itrf in itertools.product((0.002, 0.03, 0.3), (10, 60), (True, False)):
        states = ephemeris(rng, kind, 600, 10, 1e-6, size_km, True, itrf)
        error = np.zeros((len(states.r_km), 6))
        for k in range(1, len(error)):
            keeps = np.exp(-10 / lasting_s)
            error[k] = keeps * error[k - 1] + np.sqrt(1 - keeps**2) * rng.normal(0, size_km, 6)
        states = states._replace(
            r_km=states.r_km + error[:, :3], v_km_s=states.v_km_s + error[:, 3:] / lasting_s
        )
        assert causes(states) == set(), (size_km, lasting_s, itrf)


def test_the_ground_has_no_orbit_and_no_mistake():
    t = np.arange(0, 600.0, 10)
    r = np.tile([6378.0, 300.0, 20.0], (len(t), 1))
    states = LogStates(np.int64(1e18) + (t * 1e9).astype(np.int64), r, 0 * r, 0 * t + 0.01, True)
    assert causes(states) == set()
    assert "on_the_ground" in causes(states, UNKNOWN)


def in_m(states):
    return states._replace(r_km=1000 * states.r_km)


def zero(states):
    return states._replace(v_km_s=0 * states.v_km_s)


def negated(states):
    return states._replace(v_km_s=-states.v_km_s)


def velocities_in_m_s(states):
    return states._replace(v_km_s=1000 * states.v_km_s)


def as_other_frame(states):
    return states._replace(earth_fixed=not states.earth_fixed)


def with_inertial_velocities(states):
    turning = np.cross([0, 0, 7.292115e-5], states.r_km)
    return states._replace(v_km_s=states.v_km_s + turning)


def with_other_axes_of_velocities(states):
    return states._replace(v_km_s=states.v_km_s[:, [1, 2, 0]])


@pytest.mark.parametrize("duration_s", [22, 60, 600])
@pytest.mark.parametrize(
    ("mistake", "kinds", "itrf", "cause"),
    [
        (in_m, FLYING, False, "positions_in_m"),
        (in_m, FLYING, True, "positions_in_m"),
        (zero, FLYING, False, "velocities_zero"),
        (negated, FLYING, False, "velocities_negated"),
        (negated, FLYING, True, "velocities_negated"),
        (velocities_in_m_s, FLYING, False, "velocities_in_m_s"),
        (with_inertial_velocities, FLYING, True, "velocities_inertial"),
        (with_inertial_velocities, ("geostationary",), True, "velocities_inertial"),
        (with_other_axes_of_velocities, FLYING, False, "velocity_axes"),
    ],
)
def test_a_mistake_is_named_and_no_other_one(mistake, kinds, itrf, cause, duration_s):
    rng = np.random.default_rng(7)
    for kind in kinds:
        states = ephemeris(rng, kind, duration_s, 1, 0.01, 0.022, itrf=itrf)
        assert causes(mistake(states)) == {cause}, kind


@pytest.mark.parametrize(
    ("kind", "duration_s", "share"),
    [("low", 22, 0.6), ("low", 60, 0.7), ("middle", 300, 0.9),
     ("geostationary", 300, 0.9), ("eccentric", 300, 0.4)],
)  # fmt: skip
@pytest.mark.parametrize("itrf", [False, True])
def test_another_frame_is_named_in_most_orbits_and_misnamed_in_none(kind, duration_s, share, itrf):
    """A low orbit that passes the equator to the north has nearly the same curve in both."""
    rng, named = np.random.default_rng(8), 0
    for _ in range(12):
        states = as_other_frame(ephemeris(rng, kind, duration_s, 1, 0.01, 0.022, itrf=itrf))
        found = causes(states)
        assert found <= {"earth_fixed_states" if itrf else "inertial_states"}
        named += len(found)
    assert named >= share * 12


@pytest.mark.parametrize("duration_s", [22, 60])
def test_exchanged_axes_show_where_they_turn_with_the_earth(duration_s):
    """In the short arc the curve of the positions alone does not show it."""
    states = ephemeris(np.random.default_rng(9), "low", duration_s, 1, 0.01, 0.022, itrf=True)
    for axes in ([1, 0, 2], [2, 1, 0], [0, 2, 1]):
        changed = states._replace(r_km=states.r_km[:, axes], v_km_s=states.v_km_s[:, axes])
        assert causes(changed) == {"position_axes"}
    inertial = ephemeris(np.random.default_rng(9), "low", duration_s, 1, 0.01, 0.022)
    changed = inertial._replace(
        r_km=inertial.r_km[:, [1, 0, 2]], v_km_s=inertial.v_km_s[:, [1, 0, 2]]
    )
    assert causes(changed) == set()


@pytest.mark.parametrize("step_s", [1, 30, 240])
@pytest.mark.parametrize("kind", ["low", "middle", "geostationary"])
def test_velocities_at_random_are_not_those_of_the_path(kind, step_s):
    rng = np.random.default_rng(12)
    states = ephemeris(rng, kind, 60 * step_s, step_s, 0.01, 0.022)
    for velocities in (
        rng.normal(0, 4, states.v_km_s.shape),
        states.v_km_s + rng.normal(0, 3, states.v_km_s.shape),
    ):
        assert causes(states._replace(v_km_s=velocities)) == {"velocities_disagree"}


@pytest.mark.parametrize("step_s", [60, 120, 240])
@pytest.mark.parametrize(
    ("mistake", "cause"),
    [
        (zero, "velocities_zero"),
        (negated, "velocities_negated"),
        (velocities_in_m_s, "velocities_in_m_s"),
    ],
)
def test_mistakes_of_velocities_are_named_where_states_are_far_apart(mistake, cause, step_s):
    states = ephemeris(np.random.default_rng(13), "low", 7200, step_s, 0.01, 0.022)
    assert causes(mistake(states)) == {cause}


def test_arcs_of_few_states_do_not_show_the_scatter_of_others():
    """A state in ten seconds, later one in a minute, in a low orbit with errors of metres."""
    for seed in range(5):
        states = ephemeris(np.random.default_rng(seed), "low", 15_000, 10, 0.0005, 0.0015)
        kept = np.append(np.arange(400), np.arange(400, len(states.time_ns), 6))
        fields = ("time_ns", "r_km", "v_km_s", "sigma_km")
        states = states._replace(**{name: getattr(states, name)[kept] for name in fields})
        assert causes(states) == set()


def test_a_scatter_beyond_the_stated_sigma_is_named_with_its_size():
    found = [
        {each.check: each for each in check_states(states)}["position_sigma"]
        for seed in range(20)
        for states in [ephemeris(np.random.default_rng(seed), "low", 60, 1, 0.5, 0.001)]
    ]
    assert {each.cause for each in found} == {"sigma_too_small"}
    assert {each.expected for each in found} == {0.001}
    assert np.mean([each.value for each in found]) == pytest.approx(0.5, rel=0.05)


def test_states_that_jump_are_counted():
    states = ephemeris(np.random.default_rng(1), "low", 100, 1, 0.01, 0.02)
    states.r_km[[20, 70], 1] += 300.0
    found = {each.check: each for each in check_states(states)}
    assert (found["smoothness"].cause, found["smoothness"].value) == ("states_jump", 2)
    assert found["position_unit"].verdict == SOUND


@pytest.mark.parametrize("phase_s", [0.0, 0.4])
def test_states_of_two_satellites_with_one_id_are_named(phase_s):
    rng = np.random.default_rng(3)
    one, other = (ephemeris(rng, "low", 60, 1, 0.01, 0.02) for _ in range(2))
    both = [np.concatenate(pair) for pair in zip(one[:4], other[:4], strict=True)]
    both[0][len(one.time_ns) :] += int(phase_s * 1e9)
    order = np.argsort(both[0], kind="stable")
    assert causes(LogStates(*(each[order] for each in both), False)) == {"two_sensors"}


def test_gaps_are_no_second_satellite():
    states = ephemeris(np.random.default_rng(3), "low", 600, 1, 0.01, 0.02)
    kept = seconds(states) % 60 < 20
    states = LogStates(*(each[kept] for each in states[:4]), False)
    assert causes(states) == set()


def test_earth_fixed_and_inertial_ephemerides_are_the_same_path():
    states = ephemeris(np.random.default_rng(2), "low", 300, 1, 1e-6, 0.0)
    r, v = earth_fixed(seconds(states), states.r_km, states.v_km_s)
    np.testing.assert_allclose(np.linalg.norm(r, axis=1), np.linalg.norm(states.r_km, axis=1))
    found = {
        each.check: each
        for each in check_states(LogStates(states.time_ns, r, v, states.sigma_km, True))
    }
    assert found["reference_frame"].verdict == SOUND
    assert found["reference_frame"].value < 0.002  # the flattening, which this path has not
