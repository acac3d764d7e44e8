"""Votes of a pivot's companions."""

import numpy as np
from scenes.random_stars import MATCHING, frame, optics, random_attitude, random_catalogue

from epipole.tasks.algorithms.star_identification.frame import problem_of
from epipole.tasks.algorithms.star_identification.search.lost_in_space import mixed_order
from epipole.tasks.algorithms.star_identification.search.votes import (
    MAX_CELL_VOTES,
    count_votes,
    make_votes,
)
from epipole.tasks.algorithms.star_identification.star_grid import (
    pattern_pairs,
    sky_grid,
    sky_to_limit,
)


def test_a_cell_with_more_votes_than_a_byte_holds_stays_full():
    """Errors of a twentieth of the image: a companion has hundreds of neighbours of any star."""
    catalogue = random_catalogue()
    sky = sky_to_limit(catalogue, 99.0)
    pairs = pattern_pairs(catalogue.u_icrs, 2 * optics().half_diagonal_rad)
    seen, _ = frame(catalogue, random_attitude(0), 0, 60.0, n_false=60)
    problem = problem_of(seen, sky, sky_grid(sky, 0.02), pairs, MATCHING, False)
    room = np.zeros(MAX_CELL_VOTES + 20, np.int64)
    votes = make_votes(pairs.n_stars, 40)._replace(reached=room[: MAX_CELL_VOTES + 2])
    full = 0
    for pivot in range(10):
        count_votes(problem, pivot, mixed_order(40), 40, 0, votes)
        full = max(full, room[MAX_CELL_VOTES])
        assert not room[MAX_CELL_VOTES + 1 :].any()
    assert full > 0
