"""Object identity: a number holds while a tracklet continues, and is never shared."""

import numpy as np

from epipole.tasks.algorithms.orbits.object_identity import ObjectRegistry


def name(registry, *groups):
    return registry.name_groups([np.array(g) for g in groups])


def test_a_number_holds_while_one_tracklet_continues():
    registry = ObjectRegistry()
    assert name(registry, [1, 2], [3, 4]) == [0, 1]
    assert name(registry, [4, 5], [2, 6]) == [1, 0]
    assert name(registry, [6, 7]) == [0]


def test_a_new_object_gets_a_new_number():
    registry = ObjectRegistry()
    name(registry, [1, 2])
    assert name(registry, [3, 4]) == [1]
    assert name(registry, [1, 5], [6, 7]) == [0, 2]


def test_two_groups_never_share_a_number_and_the_larger_claim_wins():
    registry = ObjectRegistry()
    name(registry, [1, 2, 3])
    assert name(registry, [1, 8], [2, 3]) == [1, 0]


def test_no_group_is_no_trouble():
    assert name(ObjectRegistry()) == []


def test_long_tracklets_count_more_than_short_ones():
    registry = ObjectRegistry(np.array([60.0, 57.0, 2.0, 3.0, 2.0]))
    name(registry, [0, 1, 2, 3, 4])
    assert name(registry, [2, 3, 4], [0, 1]) == [1, 0]
