"""Clock offsets: estimated with honest sigmas, and not mistaken for other errors."""

import numpy as np
import pytest
from scenes.late_sensors import POSITION_KM, lines_of

from epipole.tasks.algorithms.constants import ARCSEC, GM_KM3_S2
from epipole.tasks.algorithms.orbits.orbit_fit import trajectory
from epipole.tasks.algorithms.sensor_faults.fault_judgement import (
    CLOCK,
    EPHEMERIS,
    PRIOR_S,
    SOUND,
    Lines,
    judge_sensors,
)


def solve(lines, turn_rad=0.0):
    return judge_sensors(lines, np.full(4, POSITION_KM), np.full(4, turn_rad))


def test_the_offset_of_one_sensor_is_found():
    offset, sigma, *_ = solve(lines_of(1, (0.0, 0.0, 0.2, 0.0)))
    assert (sigma < 0.03).all()
    assert abs(offset[2] - 0.2) < 4 * sigma[2]
    assert (abs(offset[[0, 1, 3]]) < 4 * sigma[[0, 1, 3]]).all()


@pytest.mark.long
@pytest.mark.parametrize("turn_rad", [0.0, 30 * ARCSEC])
def test_errors_over_sigmas_are_standard_normal(turn_rad):
    true = np.array([0.02, -0.05, 0.1, 0.0])
    scores = []
    for seed in range(40):
        offset, sigma, *_ = solve(lines_of(seed, true, turn_rad=turn_rad, n_epochs=20), turn_rad)
        scores.append((offset - true) / sigma)
    scores = np.array(scores)
    # Four offsets per seed share their position biases: some 80 independent draws.
    assert 0.8 < np.sqrt(np.mean(scores**2)) < 1.2


def test_wrong_clocks_are_distinguished_from_right_ones():
    scores = []
    for seed in range(20):
        true = np.array([0.0, -0.5, 2.0, 0.0])
        found = solve(lines_of(seed, true, n_epochs=20))
        assert found.wrong.tolist() == [False, True, True, False]
        scores.append((found.offset_s - true) / found.sigma_s)
    assert 0.75 < np.sqrt(np.mean(np.square(scores))) < 1.25


def test_right_clocks_are_not_called_wrong():
    for seed in range(20):
        found = solve(lines_of(seed, np.zeros(4), n_epochs=20))
        assert not found.wrong.any()
        assert (np.abs(found.offset_s) < 4.5 * found.sigma_s).all()


def test_lines_of_another_object_do_not_count():
    lines = lines_of(3, (0.0, 0.0, 0.1, 0.0))
    u = lines.u.copy()
    u[::40, 0] += 60 * ARCSEC
    found = solve(lines._replace(u=u / np.linalg.norm(u, axis=1)[:, None]))
    assert found.wrong.tolist() == [False, False, True, False]
    assert abs(found.offset_s[2] - 0.1) < 4 * found.sigma_s[2]


def test_one_sensor_alone_determines_nothing():
    lines = lines_of(2, np.zeros(4), used=(1,))
    offset, sigma, *_ = solve(lines)
    assert np.isnan(offset[[0, 2, 3]]).all()
    assert sigma[1] == pytest.approx(PRIOR_S)
    assert offset[1] == pytest.approx(0.0)


def test_no_lines_give_no_offsets():
    empty = Lines(
        *[np.zeros((0, *shape)) for shape in ((), (), (3,), (2, 2), (3,), (3,), (3,), (3,))]
    )
    empty = empty._replace(group=np.zeros(0, np.int64), sensor=np.zeros(0, np.int64))
    offset, sigma, *_ = solve(empty)
    assert np.isnan(offset).all()
    assert np.isnan(sigma).all()


def test_a_wrong_ephemeris_is_named_and_no_clock_is():
    for seed in range(5):
        bias_km = np.array([[POSITION_KM], [POSITION_KM], [0.8], [POSITION_KM]])
        judged = solve(lines_of(seed, np.zeros(4), bias_km=bias_km, n_epochs=150))
        assert judged.cause == [SOUND, SOUND, EPHEMERIS, SOUND]
        assert not judged.wrong.any()
        # Along the lines of sight an error of the ephemeris hardly shows.
        assert judged.size[2] > 2 * judged.size_sigma[2]


def test_a_wrong_clock_is_not_mistaken_for_an_ephemeris():
    for seed in range(5):
        judged = solve(lines_of(seed, (0.0, 0.0, 0.3, 0.0), n_epochs=150))
        assert judged.cause == [SOUND, SOUND, CLOCK, SOUND]


def test_an_offset_that_all_clocks_share_is_found():
    for true_s in (-0.5, 0.05):
        found = solve(lines_of(1, np.full(4, true_s), n_epochs=20))
        assert found.cause == [SOUND] * 4
        assert abs(found.doubt.shared_s - true_s) < 4 * found.doubt.shared_sigma_s < 0.03


def test_sound_sensors_leave_no_doubt():
    for seed in range(5):
        doubt = solve(lines_of(seed, np.zeros(4), n_epochs=20)).doubt
        assert not doubt.undecided
        assert np.isnan(doubt.shared_s)
        assert doubt.spread_log_odds < 3.0


def test_it_is_undecided_which_half_is_wrong():
    bias_km = np.array([[0.3], [0.3], [POSITION_KM], [POSITION_KM]])
    found = solve(lines_of(1, np.zeros(4), bias_km=bias_km, n_epochs=20))
    assert found.cause == [SOUND] * 4
    assert found.doubt.undecided
    assert found.doubt.spread_log_odds > 6.0
    # Two of four are off by 0.3 km per axis; what all share does not show.
    assert 0.05 < found.doubt.spread_km < 0.3


TURN_RAD_S = 7.292115e-5  # of the Earth


def on_the_ground(latitude, longitude, t):
    """Positions and velocities of a site, in axes that do not turn."""
    angle = longitude + TURN_RAD_S * t
    r = 6371.0 * np.stack([
        np.cos(latitude) * np.cos(angle), np.cos(latitude) * np.sin(angle),
        np.full_like(t, np.sin(latitude)),
    ], axis=1)  # fmt: skip
    return r, TURN_RAD_S * np.cross([0.0, 0.0, 1.0], r)


def lines_from_the_ground(seed, offset_s, sigma_rad=ARCSEC):
    """Lines of sight from four sites to ten low objects; the clock of site 2 is off."""
    rng = np.random.default_rng(seed)
    t, parts = np.arange(0.0, 60.0, 6.0), []
    sites = [(0.6, 0.0), (0.75, 0.12), (0.5, 0.2), (0.65, 0.3)]
    over = np.array([np.cos(0.62) * np.cos(0.15), np.cos(0.62) * np.sin(0.15), np.sin(0.62)])
    for number in range(10):
        side = np.cross(over, rng.normal(size=3))
        radius = rng.uniform(7078.0, 7878.0)
        speed = np.sqrt(GM_KM3_S2 / radius)
        state = np.concatenate([radius * over, speed * side / np.linalg.norm(side)])
        at = trajectory(state, t)[0]
        for sensor, site in enumerate(sites):
            late = offset_s if sensor == 2 else 0.0
            u = trajectory(state, t - late)[0][:, :3] - on_the_ground(*site, t - late)[0]
            u /= np.linalg.norm(u, axis=1, keepdims=True)
            u += rng.normal(size=u.shape) * sigma_rad
            u /= np.linalg.norm(u, axis=1, keepdims=True)
            group = number * len(t) + np.arange(len(t))
            cov = np.tile(sigma_rad**2 * np.eye(2), (len(t), 1, 1))
            which = np.full(len(t), sensor)
            stated = on_the_ground(*site, t)
            parts.append((group, which, u, cov, at[:, :3], at[:, 3:], *stated))
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    order = np.lexsort((columns[1], columns[0]))
    return Lines(*(column[order] for column in columns))


@pytest.mark.parametrize("offset_s", [1.0, 3.0, 4.5])
def test_sensors_on_the_ground_do_not_fall(offset_s):
    for seed in range(3):
        lines = lines_from_the_ground(seed, offset_s)
        guess_s = np.array([0.0, 0.0, offset_s, 0.0])
        found = judge_sensors(lines, np.full(4, 1e-3), np.zeros(4), guess_s)
        assert list(found.cause) == [SOUND, SOUND, CLOCK, SOUND]
        assert abs(found.offset_s[2] - offset_s) < 4 * found.sigma_s[2]
