"""Meeting lines: the mistake that makes lines of sight meet is named, and none where none does."""

import numpy as np
import pytest

from epipole.tasks.algorithms.log_checks.meeting_lines import (
    Sights,
    judge_meetings,
)
from epipole.tasks.algorithms.simulation.paths import state_at

ARCSEC = np.pi / 648_000
N_OBJECTS, N_EPOCHS = 9, 3
R_TEME = np.array([[1.0, -0.005, 0.0], [0.005, 1.0, 0.0], [0.0, 0.0, 1.0]])


def unit(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def scene(rng, common=True, n_sensors=4, start_s=0.0):
    """Return the views that low sensors have of objects of a middle orbit."""
    elements = np.stack([
        np.array([7000.0 + 40 * k, 0.001, rng.uniform(0.5, 1.7), *rng.uniform(0, 6.28, 3)])
        for k in range(n_sensors)
    ])  # fmt: skip
    middle = 12_000 * unit(rng.normal(size=3))
    objects = middle + rng.normal(0, 1000, (N_OBJECTS, 3))
    rows = []
    for epoch in range(N_EPOCHS):
        for sensor in range(n_sensors):
            r, v = state_at(elements[sensor], start_s + 20.0 * epoch)
            seen = objects if common else middle + rng.normal(0, 1000, (N_OBJECTS, 3))
            u = unit(unit(seen - r) + rng.normal(0, 10 * ARCSEC, (N_OBJECTS, 3)))
            tracklets = sensor * N_OBJECTS + np.arange(N_OBJECTS)
            rows += [
                (20.0 * epoch, sensor, tracklet, direction, r, v)
                for tracklet, direction in zip(tracklets, u, strict=True)
            ]
    return sights_of(rows)


def sights_of(rows):
    epoch_s, sensor, tracklet, u, r, v = (np.array(each) for each in zip(*rows, strict=True))
    n = len(epoch_s)
    return Sights(epoch_s, sensor, tracklet, u, np.full(n, 10 * ARCSEC), r, v, np.full(n, 0.02))


def constellation(rng, n_satellites=12, n_common=12, n_others=40):
    """Return the views of two sensors on each satellite that look everywhere.

    Some objects are seen by two satellites, the others by one.
    """
    elements = np.stack([
        np.array([7000.0, 0.001, 0.9, 0.1 * k, 0.0, 0.3 * (k % 3)]) for k in range(n_satellites)
    ])  # fmt: skip
    rows = []
    for number in range(n_common + n_others):
        a, b = rng.choice(n_satellites, 2, replace=False)
        where = state_at(elements[a], 0.0)[0] + rng.normal(0, 900, 3)
        moves = rng.normal(0, 5, 3)
        for satellite in (a, b) if number < n_common else (a,):
            sensor = 2 * satellite + rng.integers(2)
            for epoch_s in (0.0, 10.0, 20.0):
                r, v = state_at(elements[satellite], epoch_s)
                u = unit(unit(where + moves * epoch_s - r) + rng.normal(0, 10 * ARCSEC, 3))
                rows.append((epoch_s, sensor, 2 * number + (satellite == b), u, r, v))
    sights = sights_of(rows)
    number, tracklet = (np.unique(each, return_inverse=True)[1] for each in sights[1:3])
    return sights._replace(sensor=number, tracklet=tracklet)


def stated_meetings(sights):
    return judge_meetings(sights, R_TEME)[0]


def find_reading(sights, R):
    return judge_meetings(sights, R)[1]


def moved(sights, r_km, only=None):
    """Return the sights with other stated positions, of one sensor only if given."""
    mine = np.ones(len(r_km), bool) if only is None else sights.sensor == only
    return sights._replace(r_km=np.where(mine[:, None], r_km, sights.r_km))


def later(sights, offset_s):
    """Return positions at times of frames that are later by an offset, nearly."""
    return sights.r_km + offset_s * sights.v_km_s


MISTAKES = {
    "other_inertial_frame": lambda sights: sights.r_km @ R_TEME.T,
    "axes_of_states": lambda sights: sights.r_km[:, [1, 0, 2]],
    "earth_fixed_times": lambda sights: turned(sights.r_km, 37.0),
}


def turned(r_km, offset_s):
    angle = 7.292115e-5 * offset_s
    c, s = np.cos(angle), np.sin(angle)
    return r_km @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]).T


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_named_where_lines_meet_or_have_nothing_in_common(seed):
    rng = np.random.default_rng(seed)
    sights = scene(rng)
    assert (stated_meetings(sights).share > 0.9).all()
    assert stated_meetings(sights).is_sound.all()
    assert find_reading(sights, R_TEME) == []
    assert not stated_meetings(scene(rng, common=False)).is_sound.any()
    assert find_reading(scene(rng, common=False), R_TEME) == []


@pytest.mark.parametrize("cause", MISTAKES)
@pytest.mark.parametrize("only", [None, 2])
def test_a_mistake_is_named_for_the_sensors_that_have_it(cause, only):
    named = 0
    for seed in range(3):
        sights = scene(np.random.default_rng(seed))
        found = find_reading(moved(sights, MISTAKES[cause](sights), only), R_TEME)
        for each in found:
            assert (each.cause, each.sensor) == (cause, -1 if only is None else only)
            assert each.share - each.stated_share > 0.2
        named += len(found)
    assert named >= 2


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("cause", MISTAKES)
def test_a_mistake_of_all_is_named_where_most_objects_are_seen_by_one(cause, seed):
    sights = constellation(np.random.default_rng(seed))
    assert find_reading(sights, R_TEME) == []
    assert 0.2 < stated_meetings(sights).share.mean() < 0.6
    (found,) = find_reading(moved(sights, MISTAKES[cause](sights)), R_TEME)
    assert (found.cause, found.sensor) == (cause, -1)
    assert found.share < 0.6


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("cause", MISTAKES)
def test_no_mistake_is_named_where_all_objects_are_seen_by_one(cause, seed):
    sights = constellation(np.random.default_rng(seed), n_common=0, n_others=60)
    assert find_reading(sights, R_TEME) == []
    assert find_reading(moved(sights, MISTAKES[cause](sights)), R_TEME) == []
    assert stated_meetings(sights).is_sound.sum() <= 1


@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_views_changes_nothing(seed):
    rng = np.random.default_rng(seed)
    sights = constellation(rng)
    sights = moved(sights, MISTAKES["axes_of_states"](sights))
    order = rng.permutation(len(sights.epoch_s))
    (found,) = find_reading(sights, R_TEME)
    (again,) = find_reading(Sights(*(each[order] for each in sights)), R_TEME)
    assert again.cause == found.cause
    np.testing.assert_allclose(again[3:6], found[3:6], rtol=1e-9)


def test_exchanged_ephemerides_are_named_with_both_sensors():
    sights = scene(np.random.default_rng(3))
    r_km = sights.r_km.copy()
    r_km[sights.sensor == 1], r_km[sights.sensor == 2] = (
        sights.r_km[sights.sensor == 2], sights.r_km[sights.sensor == 1],
    )  # fmt: skip
    (found,) = find_reading(moved(sights, r_km), R_TEME)
    assert (found.cause, {found.sensor, found.other}) == ("ephemerides_exchanged", {1, 2})


@pytest.mark.parametrize("offset_s", [18.0, -37.0])
def test_times_of_frames_against_those_of_states_are_named_with_their_offset(offset_s):
    sights = scene(np.random.default_rng(4))
    (found,) = find_reading(moved(sights, later(sights, offset_s)), R_TEME)
    assert (found.cause, found.offset_s) == ("frames_and_states_apart", offset_s)


def test_exchanged_ephemerides_of_satellites_with_two_sensors_are_named_for_both():
    sights = scene(np.random.default_rng(3), n_sensors=6)
    r_km = sights.r_km.copy()
    for a, b in ((2, 4), (3, 5)):  # of two satellites that have two sensors each
        sights.r_km[sights.sensor == a + 1 - a % 2] = sights.r_km[sights.sensor == a - a % 2]
        r_km[sights.sensor == a], r_km[sights.sensor == b] = (
            sights.r_km[sights.sensor == b], sights.r_km[sights.sensor == a],
        )  # fmt: skip
    found = find_reading(moved(sights, r_km), R_TEME)
    assert {frozenset((each.sensor, each.other)) for each in found} == {
        frozenset((2, 4)), frozenset((3, 5)),
    }  # fmt: skip


def test_few_views_decide_nothing():
    sights = scene(np.random.default_rng(4))
    one = Sights(*(each[sights.sensor == 0] for each in sights))
    assert find_reading(one, R_TEME) == []
    assert not stated_meetings(one).is_sound.any()
    none = Sights(*(each[:0] for each in sights))
    assert find_reading(none, R_TEME) == []
    assert all(len(each) == 0 for each in stated_meetings(none))


@pytest.mark.parametrize("common", [True, False])
@pytest.mark.parametrize("sigma_arcsec", [10.0, 3000.0])
def test_views_that_would_meet_anyway_are_told_from_those_of_common_objects(common, sigma_arcsec):
    sights = scene(np.random.default_rng(5), common)
    sights = sights._replace(sigma_rad=np.full(len(sights.epoch_s), sigma_arcsec * ARCSEC))
    stated = stated_meetings(sights)
    # With the larger errors, the views of 27 other objects meet everywhere.
    vague = sigma_arcsec > 100
    assert (stated.share > 0.6).all() == (common or vague)
    assert (stated.by_accident > 0.7).all() == vague
    assert stated.is_sound.all() == (common and not vague)
