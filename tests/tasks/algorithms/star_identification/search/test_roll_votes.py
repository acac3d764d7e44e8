"""Coarse votes of a pivot's companions."""

import numpy as np
import pytest

from epipole.tasks.algorithms.star_identification.search.roll_votes import (
    MAX_COUNTED,
    count_roll_votes,
    make_roll_table,
)
from epipole.tasks.algorithms.star_identification.star_pairs import TURN, NearStars

REACH, TOLERANCE, WIDE = 0.1, 2e-4, 40


def neighbours(rng, counts):
    """Return the near neighbours of stars, by the number that each has."""
    n = int(np.sum(counts))
    return NearStars(
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64), np.zeros(n, np.int32),
        REACH * np.sqrt(rng.uniform(0.01, 1, n)), rng.integers(0, TURN, n).astype(np.uint16), REACH,
    )  # fmt: skip


def levels(near, chord, angle, min_votes=1, max_stars=10_000, share=0.0):
    """Return the votes of each star, and how many are enough."""
    n, stars = len(chord), len(near.first) - 1
    level = np.zeros(stars, np.uint8)
    table = make_roll_table(chord, np.full(n, TOLERANCE), angle, np.full(n, WIDE), REACH)
    enough = count_roll_votes(near, 0, stars, table, share, min_votes, max_stars, level)
    return level, enough


@pytest.mark.parametrize("shown", range(1, 9))
@pytest.mark.parametrize("turned", [0, 511, 512, 33_000, 65_535])
def test_all_neighbours_that_are_shown_agree(shown, turned):
    rng = np.random.default_rng(shown)
    near = neighbours(rng, [9])
    chord = near.chord[:shown] + rng.uniform(-1, 1, shown) * TOLERANCE
    angle = (near.turn[:shown].astype(np.int64) - turned + rng.integers(-WIDE, WIDE, shown)) % TURN
    level, _ = levels(near, np.minimum(chord, REACH), angle)
    assert level[0] == min(shown, MAX_COUNTED)


def test_no_neighbour_agrees_more_often_than_within_a_bin():
    """Against a count of the turns one by one, whose bins are wider."""
    rng = np.random.default_rng(1)
    near = neighbours(rng, rng.integers(0, 12, 300))
    chord, angle = REACH * np.sqrt(rng.uniform(0, 1, 200)), rng.integers(0, TURN, 200)
    level, _ = levels(near, chord, angle)
    for s in range(300):
        mine = slice(near.first[s], near.first[s + 1])
        alike = np.abs(near.chord[mine, None] - chord) <= 2 * TOLERANCE
        entry, q = np.nonzero(alike)
        turn = (near.turn[mine].astype(np.int64)[entry] - angle[q]) % TURN
        off = np.abs((turn[:, None] - turn + TURN // 2) % TURN - TURN // 2) <= 1300
        least = max((len(set(entry[row])) for row in off), default=0)
        assert level[s] <= min(least, MAX_COUNTED)


def test_more_votes_are_asked_for_where_too_many_stars_have_enough():
    rng = np.random.default_rng(2)
    near = neighbours(rng, np.full(400, 10))
    chord, angle = REACH * np.sqrt(rng.uniform(0, 1, 300)), rng.integers(0, TURN, 300)
    level, enough = levels(near, chord, angle, 2, 40)
    assert np.sum(level >= enough) <= 40 < np.sum(level >= enough - 1)
    assert levels(near, chord, angle, 5, 400)[1] == 5
    assert levels(near, chord, angle, 2, -1)[1] == MAX_COUNTED + 1


def test_of_many_neighbours_a_share_has_to_agree():
    """Three neighbours are shown: enough for a star that has four, and not for one that has 40."""
    rng = np.random.default_rng(3)
    few, many = neighbours(rng, [4]), neighbours(rng, [40])
    for near, expected in ((few, 3), (many, 0)):
        chord, angle = near.chord[:3].copy(), near.turn[:3].astype(np.int64)
        assert levels(near, chord, angle, share=0.5)[0][0] == expected
        assert levels(near, chord, angle)[0][0] >= 3


def test_more_votes_than_are_counted_are_enough_for_any_share():
    near = neighbours(np.random.default_rng(4), [40])
    shown = MAX_COUNTED + 1
    level, _ = levels(near, near.chord[:shown], near.turn[:shown].astype(np.int64), share=0.5)
    assert level[0] == MAX_COUNTED
