"""Whether the stars of a field are among the centroids."""

import numpy as np
import pytest
from scenes.random_stars import MATCHING, angle_between, frame, random_attitude, random_catalogue

from epipole.tasks.algorithms.star_identification.frame import problem_of
from epipole.tasks.algorithms.star_identification.search.pair_hypotheses import make_scratch
from epipole.tasks.algorithms.star_identification.search.verify_field import (
    field_log_odds,
    make_centroid_cells,
)
from epipole.tasks.algorithms.star_identification.star_grid import (
    by_bands,
    pattern_pairs,
    sky_grid,
    sky_to_limit,
)

CATALOGUE = random_catalogue()
SKY = sky_to_limit(CATALOGUE, 99.0)
STARS = by_bands(SKY.catalogue.u_icrs)


@pytest.fixture(scope="module")
def tables():
    return sky_grid(SKY, 0.005), pattern_pairs(CATALOGUE.u_icrs[:2000], 0.4)


def odds(problem, i, j, s, other):
    """Return the log odds, the work and the attitude."""
    room = make_scratch(len(problem.centroids.u), 3)
    places = make_centroid_cells(problem.centroids.u, problem.image.box)
    c = np.linalg.norm(SKY.catalogue.u_icrs[s] - SKY.catalogue.u_icrs[other])
    found, work = field_log_odds(problem, i, s, j, other, c, STARS, places, room)
    return found, work, room.R.copy()


def test_the_true_stars_of_a_pair_are_told_from_others(tables):
    rng, right, wrong = np.random.default_rng(0), [], []
    for seed in range(20):
        R = random_attitude(seed)
        seen, row = frame(CATALOGUE, R, seed, n_false=500)
        problem = problem_of(seen, SKY, *tables, MATCHING, crowded=True)
        apart = np.linalg.norm(seen.u[:, None] - seen.u, axis=2)
        stars = (row >= 0)[:, None] & (row >= 0) & (apart > 0.05) & (apart < 0.12)
        i, j = np.argwhere(stars)[0]
        found, work, attitude = odds(problem, i, j, row[i], row[j])
        assert angle_between(attitude, R) < 0.01
        assert work > 0
        right.append(found)
        a, b = rng.permutation(len(STARS.u))[:2]
        wrong.append(odds(problem, i, j, a, b)[0])
    assert np.median(right) > 20
    assert np.mean(np.array(right) > 5) >= 0.9
    assert np.max(wrong) < 0


def test_a_pair_alone_is_no_evidence(tables):
    """Without any other star of the field, what is left are misses."""
    seen, row = frame(CATALOGUE, random_attitude(1), 1)
    stars = np.flatnonzero(row >= 0)
    two = seen._replace(**{k: getattr(seen, k)[stars[:2]] for k in ("u", "sigma_rad")})
    two = two._replace(instrumental_mag=seen.instrumental_mag[stars[:2]])
    problem = problem_of(two, SKY, *tables, MATCHING, crowded=True)
    assert odds(problem, 0, 1, *row[stars[:2]])[0] < 0
