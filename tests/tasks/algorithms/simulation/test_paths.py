"""Paths between nodes: to a millimetre where SGP4 puts the body."""

import numpy as np
import pytest
from scenes.satellites import EPOCH_NS, ISS, element_set, two_lines
from sgp4.api import Satrec

from epipole.tasks.algorithms.simulation.element_sets import propagate
from epipole.tasks.algorithms.simulation.paths import (
    joined_paths,
    node_times,
    resting_path,
    sampled_paths,
    state_at,
    two_body_paths,
)

MILLIMETRE = 1e-6
KEPLER = np.array([7000.0, 0.01, 1.0, 0.2, 0.3, 0.4])


def places(t_s):
    molniya = element_set(Satrec.twoline2rv(*two_lines("8", 2.006, e=0.7)))
    return propagate(np.array([ISS.elements, molniya.elements]),
                     EPOCH_NS + np.rint(t_s * 1e9).astype(np.int64))[0]  # fmt: skip


def sampled(start_s, end_s):
    t_s = node_times(start_s, end_s)
    return sampled_paths(t_s, places(t_s))


@pytest.mark.parametrize("start_s", [0.0, 12_345.0])
def test_between_nodes_a_body_is_where_sgp4_puts_it(start_s):
    t_s = start_s + np.arange(0.0, 600.0, 0.7)
    expected = places(t_s)
    derivative = (places(t_s + 0.5) - places(t_s - 0.5)) / 1.0
    paths = sampled(start_s, start_s + 600.0)
    for body in range(2):
        r_km, v_km_s = paths.at(t_s, body)
        assert np.linalg.norm(r_km - expected[body], axis=1).max() < MILLIMETRE
        assert np.linalg.norm(v_km_s - derivative[body], axis=1).max() < 1e-6  # 1 mm/s


def test_a_mixture_of_paths_gives_each_body_its_own():
    one, other = sampled(0.0, 100.0), two_body_paths(KEPLER)
    both = joined_paths([one, other, one])
    assert both.is_sampled.tolist() == [True, True, False, True, True]
    t_s = np.array([3.0, 4.0, 50.0, 60.0, 99.0])
    body = np.array([2, 0, 4, 2, 1])
    r_km, v_km_s = both.at(t_s, body)
    for k in range(5):
        part, of = (other, 0) if body[k] == 2 else (one, (0, 1, 0, 0, 1)[body[k]])
        r, v = part.at(t_s[k : k + 1], of)
        np.testing.assert_array_equal((r_km[k], v_km_s[k]), (r[0], v[0]))
    few = both.of(4, 2)
    np.testing.assert_array_equal(few.at(t_s, 0)[0], one.at(t_s, 1)[0])
    np.testing.assert_array_equal(few.at(t_s, 1)[0], state_at(KEPLER, t_s)[0])


def test_a_place_at_rest_stays_there():
    r_km, v_km_s = resting_path(np.array([1.0, 2.0, 3.0])).at(np.array([-500.0, 3.0, 1e5]))
    np.testing.assert_array_equal(r_km, [[1.0, 2.0, 3.0]] * 3)
    assert not v_km_s.any()
