"""Tracklets: aged catalogues name those of what they hold, and nothing that they do not."""

import numpy as np
import pytest
from scenes.aged_elements import aged
from scenes.seen_tracklets import TO_SUN, seen_from_near
from scenes.walker import NIGHT_NS, satellites

from epipole.tasks.algorithms.known_objects.matching import KnownSatellites
from epipole.tasks.algorithms.known_objects.prediction import (
    HIGH_ORBIT,
    LOW_ORBIT,
    predict,
    satellites_of,
    sensitivities,
)
from epipole.tasks.algorithms.known_objects.tracklet_matching import (
    _changes,
    judge_tracklets,
    match_tracklets,
    residuals_of,
    weigh_pairs,
)
from epipole.tasks.algorithms.known_objects.tracklet_search import find_pairs

pytestmark = pytest.mark.long

NOON_NS = NIGHT_NS + 43_200_000_000_000


def catalogue_of(sets):
    made = satellites_of(np.array([each.elements for each in sets]).reshape(-1, 10))
    epochs = np.array([each.epoch_ns for each in sets], np.int64)
    return KnownSatellites(made, epochs, LOW_ORBIT, HIGH_ORBIT)


def named(seen, sets, least=0.99):
    catalogue = catalogue_of(sets)
    pairs = match_tracklets(seen, catalogue)
    weights = weigh_pairs(seen, pairs, catalogue)
    return judge_tracklets(len(seen.time_ns), pairs, weights, least), pairs


def shown(names, pairs):
    """The satellite of each tracklet; -1 where it is not known."""
    return np.array([
        pairs.satellite[p] if s == "known" else -1 for s, p in zip(*names[::2], strict=True)
    ])  # fmt: skip


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(3)
    truth = satellites(45, rng, high=0.1)
    return truth, *seen_from_near(truth, 300, rng)


@pytest.mark.parametrize("age_days", [0.5, 6.0])
def test_listed_satellites_are_known_and_others_unknown(scene, age_days):
    truth, seen, rows = scene
    known = aged(truth, NOON_NS, np.full(len(truth), age_days), np.random.default_rng(4))
    names, pairs = named(seen, known[:30])
    found = shown(names, pairs)
    assert (found[found >= 0] == rows[found >= 0]).all()
    assert (found[rows < 30] >= 0).mean() > 0.95
    assert (names.status[rows >= 30] == "unknown").all()
    assert (names.probability[names.status == "known"] >= 0.99).all()


def test_differences_have_the_covariance_of_direction_rates_and_elements(scene):
    truth, seen, rows = scene
    catalogue = catalogue_of(truth)
    pairs = match_tracklets(seen, catalogue)
    right = pairs.take(pairs.satellite == rows[pairs.tracklet])
    assert len(right.tracklet) == len(rows)
    # Exact elements: what is left is the noise of the tracklets.
    residuals = residuals_of(seen, right, catalogue)
    offsets = np.array([each.offset for each in residuals])
    assert abs(offsets.mean()) < 4 / np.sqrt(offsets.size)
    assert np.mean(offsets**2) == pytest.approx(1.0, abs=0.15)
    assert np.allclose([each.cov for each in residuals], np.eye(4))


@pytest.mark.parametrize("high", [0.0, 1.0])
def test_errors_of_elements_move_a_satellite_as_in_sgp4(high):
    (each,) = satellites(1, np.random.default_rng(6), high=high)
    (satellite,) = satellites_of(np.array([each.elements]))
    # Soon after the epoch: later a tilt turns the node, too.
    times = each.epoch_ns + 600 * 10**9 + np.array([-(10**9), 0, 10**9])
    state = predict([satellite], times[1:2])[0]
    by_position = sensitivities(satellite, times, 1)
    expected = np.concatenate([by_position[1], (by_position[2] - by_position[0]) / 2])
    found = _changes(state)[0]
    scale = np.array([1.0] * 3 + [np.linalg.norm(state[0, :3]) / np.linalg.norm(state[0, 3:])] * 3)
    for columns in ([0], [1, 2], [3, 4], [5]):  # the pairs are turned: their covariances are one
        ours, theirs = (scale[:, None] * x[:, columns] for x in (found, expected))
        wanted = theirs @ theirs.T
        assert np.abs(ours @ ours.T - wanted).max() < 0.03 * np.abs(wanted).max()


def test_a_satellite_that_thrusts_is_known_and_one_far_behind_is_not(scene):
    truth, seen, rows = scene
    low = np.array([each.elements[8] > 0.03 for each in truth])
    for off_km, least, most in ((15.0, 0.9, 1.0), (2000.0, 0.0, 0.0)):
        moved = [
            each._replace(elements=(*each.elements[:7], each.elements[7] + off_km / 7000.0,
                                    *each.elements[8:]))
            for each in truth
        ]  # fmt: skip
        found = shown(*named(seen, moved))[low[rows]]
        right = found == rows[low[rows]]
        assert least <= right.mean() <= most
        assert (right | (found < 0)).mean() > 0.995


def test_two_sets_of_one_orbit_are_ambiguous_and_both_are_listed(scene):
    truth, seen, rows = scene
    names, _ = named(seen, [truth[0], truth[0], *truth[1:]])
    (twice,) = np.unique(names.status[rows == 0]) if (rows == 0).any() else ("ambiguous",)
    assert twice == "ambiguous"
    assert all(sorted(names.listed[k]) == [0, 1] for k in np.flatnonzero(rows == 0))


def test_what_is_in_the_shadow_or_too_bright_is_not_the_satellite(scene):
    truth, seen, _ = scene
    everywhere = np.full(len(truth), 300.0), np.full(len(truth), 50.0)
    satellites = catalogue_of(truth).satellites
    bright = find_pairs(seen._replace(magnitude=seen.magnitude * 0 - 12.0), satellites, *everywhere)
    assert not len(bright.tracklet)
    # A satellite behind the Earth as the Sun sees it, within 5,000 km of the axis.
    pairs = find_pairs(seen, satellites, *everywhere)
    sunward = pairs.states[:, :3] @ TO_SUN
    aside = np.linalg.norm(pairs.states[:, :3] - sunward[:, None] * TO_SUN, axis=1)
    assert ((sunward > 0) | (aside > 5000.0)).all()


def test_the_search_finds_each_satellite_that_is_ahead_or_behind(scene):
    truth, seen, rows = scene
    for off_km in (-150.0, 150.0):
        ahead = off_km / 7000.0
        moved = [each._replace(elements=(*each.elements[:7], each.elements[7] + ahead,
                                         *each.elements[8:])) for each in truth]  # fmt: skip
        made = catalogue_of(moved).satellites
        pairs = find_pairs(seen, made, np.full(len(truth), 300.0), np.full(len(truth), 5.0))
        right = pairs.tracklet[pairs.satellite == rows[pairs.tracklet]]
        low = np.flatnonzero([truth[row].elements[8] > 0.03 for row in rows])
        assert np.isin(low, right).mean() > 0.98
    assert np.array_equal(pairs.tracklet, np.sort(pairs.tracklet))


def test_without_tracklets_or_satellites_nothing_is_named(scene):
    truth, seen, _ = scene
    names, pairs = named(seen, [])
    assert set(names.status) == {"unknown"}
    assert (names.pair == -1).all()
    assert not len(pairs.tracklet)
    none = seen.take(np.zeros(0, int))
    assert not len(named(none, truth)[0].status)


def test_rows_do_not_depend_on_the_order_of_tracklets(scene):
    truth, seen, rows = scene
    order = np.random.default_rng(8).permutation(len(rows))
    one, two = named(seen, truth), named(seen.take(order), truth)
    assert np.array_equal(one[0].status[order], two[0].status)
    assert np.array_equal(shown(*one)[order], shown(*two))
