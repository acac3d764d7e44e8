"""Matching: aged catalogues name what they hold, and nothing that they do not."""

import numpy as np
import pytest
from scenes.aged_elements import HIGH, LOW, aged
from scenes.walker import NIGHT_NS, satellites

from epipole.tasks.algorithms.known_objects.matching import (
    MAX_ROWS,
    MIN_MATCHES,
    KnownSatellites,
    Observed,
    candidates,
    judge,
    learn_errors,
    spread_rows,
)
from epipole.tasks.algorithms.known_objects.prediction import (
    HIGH_ORBIT,
    LOW_ORBIT,
    ElementErrors,
    Screen,
    is_deep_space,
    predict,
    satellites_of,
)

pytestmark = pytest.mark.long

NOON_NS = NIGHT_NS + 43_200_000_000_000


def observed(each, rng, sigma_km, count=6, arc_s=300.0):
    (satellite,) = satellites_of(np.array([each.elements]))
    start = NOON_NS + rng.uniform(-3e13, 3e13)
    times = np.sort((start + rng.uniform(0, arc_s, count) * 1e9).astype(np.int64))
    r_km = predict([satellite], times)[0, :, :3] + rng.normal(0, sigma_km, (count, 3))
    return Observed(times, r_km, np.tile(np.eye(3) * sigma_km**2, (count, 1, 1)))


def catalogue_of(sets):
    epochs = np.array([each.epoch_ns for each in sets], np.int64)
    made = satellites_of(np.array([each.elements for each in sets]).reshape(-1, 10))
    return KnownSatellites(made, epochs, LOW_ORBIT, HIGH_ORBIT), Screen(made)


def verdict(each, sets, rng, sigma_km=0.1):
    catalogue, screen = catalogue_of(sets)
    return judge(candidates(observed(each, rng, sigma_km), catalogue, screen), 0.99)


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(3)
    truth = satellites(90, rng)
    return truth, aged(truth, NOON_NS, rng.uniform(0.2, 6.0, len(truth)), rng)


def test_listed_satellites_are_known_and_others_unknown(scene):
    truth, known = scene
    rng = np.random.default_rng(4)
    catalogue, screen = catalogue_of(known[:60])
    right = 0
    for row, each in enumerate(truth):
        found = judge(candidates(observed(each, rng, 0.3), catalogue, screen), 0.99)
        if row >= 60:
            assert found.status == "unknown"
        elif found.status == "known":
            assert found.best.row == row
            right += 1
    assert right >= 58


def test_probabilities_and_distances_are_told(scene):
    truth, known = scene
    found = verdict(truth[0], known[:60], np.random.default_rng(5))
    assert (found.status, found.rows) == ("known", (0,))
    assert found.probability > 0.99
    assert 0 < found.best.distance_km < 60
    assert 0 < found.best.mahalanobis < 8


def test_two_satellites_in_one_place_are_ambiguous_and_all_are_named(scene):
    truth, known = scene
    pair = [known[0], known[0]._replace(number=7)]
    found = verdict(truth[0], pair, np.random.default_rng(6))
    assert found.status == "ambiguous"
    assert sorted(found.rows) == [0, 1]
    assert found.probability > 0.99


def test_an_object_far_from_a_listed_one_in_its_own_orbit_is_unknown(scene):
    truth, known = scene
    elements = list(truth[0].elements)
    elements[7] += 0.03  # 200 km ahead in a low orbit
    other = truth[0]._replace(elements=tuple(elements))
    found = verdict(other, known[:1], np.random.default_rng(7))
    assert found.status == "unknown"


def test_without_satellites_or_near_ones_an_object_is_unknown(scene):
    truth, known = scene
    assert verdict(truth[0], [], np.random.default_rng(8)).best is None
    assert verdict(truth[0], known[1:2], np.random.default_rng(8)).status == "unknown"


def test_one_position_is_enough_for_a_low_satellite(scene):
    truth, known = scene
    rng = np.random.default_rng(9)
    row = next(k for k, each in enumerate(truth) if each.elements[8] > 0.04)
    catalogue, screen = catalogue_of(known)
    one = observed(truth[row], rng, 0.1, count=1)
    assert judge(candidates(one, catalogue, screen), 0.99).best.row == row


def test_errors_are_learnt_from_sure_matches():
    rng = np.random.default_rng(10)
    truth = satellites(150, rng, high=0.0)
    known = aged(truth, NOON_NS, rng.uniform(0.2, 6.0, len(truth)), rng)
    catalogue, screen = catalogue_of(known)
    best = [judge(candidates(observed(each, rng, 0.05), catalogue, screen), 0.999).best
            for each in truth]  # fmt: skip
    start = ElementErrors(5.0, 5.0, 2.0, 0.3, 2.0, 0.5)
    made = [catalogue.satellites[match.row] for match in best]
    learnt = learn_errors(best, made, start)
    # Qualities are log-normal with a factor of 1.6, so the squares are larger by 1.56 on average.
    factor = np.exp(np.log(1.6) ** 2)
    assert learnt.along_km_day == pytest.approx(LOW.drift_km_day * factor, rel=0.35)
    assert learnt.across_km == pytest.approx(LOW.across_km * factor, rel=0.35)
    assert learnt.radial_km == pytest.approx(LOW.radial_km * factor, rel=0.35)
    assert learn_errors(best[: MIN_MATCHES - 1], made[: MIN_MATCHES - 1], start) == start


def test_both_kinds_of_orbits_are_in_the_scene(scene):
    _, known = scene
    high = [is_deep_space(s) for s in satellites_of(np.array([e.elements for e in known]))]
    assert 10 < sum(high) < 60
    assert HIGH.along_km > LOW.along_km


def test_rows_are_spread_over_the_time_and_preferred_ones_come_first():
    times = np.arange(1000, dtype=np.int64)
    rows = spread_rows(times, np.ones(1000, bool))
    assert len(rows) == MAX_ROWS
    assert (rows[0], rows[-1]) == (0, 999)
    preferred = times % 100 == 5
    assert preferred[spread_rows(times, preferred)].all()
    assert spread_rows(times[:3], np.zeros(3, bool)).tolist() == [0, 1, 2]
    assert len(spread_rows(times[:0], np.zeros(0, bool))) == 0
