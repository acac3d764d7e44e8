"""The offset of all times from UTC, by an aged catalogue."""

import numpy as np
import pytest
from scenes.aged_elements import aged
from scenes.seen_tracklets import seen_from_near
from scenes.walker import NIGHT_NS, satellites

from epipole.tasks.algorithms.known_objects.matching import KnownSatellites
from epipole.tasks.algorithms.known_objects.prediction import (
    HIGH_ORBIT,
    LOW_ORBIT,
    satellites_of,
)
from epipole.tasks.algorithms.known_objects.time_offset import find_time_offset
from epipole.tasks.name.judge_times import IN_USE_S

NOON_NS = NIGHT_NS + 43_200_000_000_000


@pytest.fixture(scope="module")
def scene():
    """Tracklets in a day, and a catalogue of their satellites that is a day old."""
    rng = np.random.default_rng(3)
    truth = satellites(45, rng, high=0.1)
    known = aged(truth, NOON_NS, np.full(len(truth), 1.0), np.random.default_rng(4))
    made = satellites_of(np.array([each.elements for each in known]))
    epochs = np.array([each.epoch_ns for each in known], np.int64)
    seen, _ = seen_from_near(truth, 50, rng)
    return seen, KnownSatellites(made, epochs, LOW_ORBIT, HIGH_ORBIT)


@pytest.mark.parametrize("off_s", [0.4, -1.5, 7.0, 18.0])
def test_an_offset_of_all_times_is_found(scene, off_s):
    seen, catalogue = scene
    seen = seen._replace(time_ns=seen.time_ns + round(off_s * 1e9))
    found = find_time_offset(seen, catalogue, IN_USE_S)
    assert abs(found.offset_s - off_s) < 3 * found.sigma_s
    assert found.sigma_s < 0.2
    assert found.n_known > 0.8 * len(seen.time_ns)
    assert abs(off_s) < 2.0 or found.n_as_written < 0.1 * len(seen.time_ns)


def test_satellites_that_are_not_listed_tell_nothing(scene):
    _, catalogue = scene
    others = satellites(45, np.random.default_rng(8), high=0.1)
    unlisted, _ = seen_from_near(others, 20, np.random.default_rng(9))
    assert find_time_offset(unlisted, catalogue, IN_USE_S).n_known < 4
