"""A second look at frames that show few of their centroids to be stars."""

import numpy as np
from scenes.random_stars import (
    MATCHING,
    angle_between,
    frame,
    join,
    optics,
    random_attitude,
    random_catalogue,
)

from epipole.tasks.algorithms.star_identification.centroids import unsolved
from epipole.tasks.algorithms.star_identification.frame import (
    FrameCentroids,
    Solution,
    search_frame,
)
from epipole.tasks.algorithms.star_identification.reidentify_poor_frames import (
    poor_frames,
    reidentify_poor_frames,
)
from epipole.tasks.algorithms.star_identification.sequence import SensorSky
from epipole.tasks.algorithms.star_identification.star_grid import (
    pattern_pairs,
    sky_grid,
    sky_to_limit,
)

CATALOGUE = random_catalogue()
SKY = sky_to_limit(CATALOGUE, 6.5)
PAIRS = pattern_pairs(CATALOGUE.u_icrs[:1500], 2 * optics().half_diagonal_rad)
SIGMA_PX = 0.3
GRID = sky_grid(SKY, 9.0 * SIGMA_PX * optics().pixel_rad)
WHERE = SensorSky(SKY, GRID, lambda: PAIRS)


def searched(seen):
    return search_frame(seen, SKY, GRID, PAIRS, MATCHING).solution


def solved_frames(frames):
    """Return the solutions of frames, by a search of each."""
    solutions = unsolved(join(frames).first)
    for k, seen in enumerate(frames):
        solutions.enter(k, searched(seen))
    return solutions


def with_spots_of(seen, before, n):
    """Return a frame with the n brightest spots of another one, and where these are."""
    columns = [np.concatenate([a[:n], b]) for a, b in zip(before[:3], seen[:3], strict=True)]
    order = np.argsort(columns[2], kind="stable")
    return FrameCentroids(*[c[order] for c in columns], *seen[3:]), np.flatnonzero(order < n)


def test_spots_that_stay_from_the_frame_before_are_not_taken_for_its_sky():
    frames = [frame(CATALOGUE, random_attitude(k), k, SIGMA_PX)[0] for k in range(8)]
    before = searched(frames[2])
    frames[3], stayed = with_spots_of(frames[3], frames[2], 5)
    solutions = solved_frames(frames)
    # What follows from the frame before: its attitude, with five stars that are no longer there.
    star, chi2 = np.full(len(frames[3].u), -1, np.int64), np.zeros(len(frames[3].u))
    star[stayed] = before.star[:5]
    solutions.enter(3, Solution(before.R_sensor_from_icrs, before.cov_rad2, star, chi2, 30.0))
    assert poor_frames(solutions).tolist() == [3]
    factors = reidentify_poor_frames(join(frames), solutions, WHERE, MATCHING)
    assert angle_between(solutions.R_sensor_from_icrs[3], random_attitude(3)) < 1e-3
    assert np.sum(solutions.frame(3).star >= 0) > 10
    assert (factors == 1.0).all()


def test_a_frame_with_larger_errors_gets_all_its_stars_and_their_errors():
    frames = [frame(CATALOGUE, random_attitude(k), k, SIGMA_PX)[0] for k in range(8)]
    solutions = solved_frames(frames)
    shaken, true = frame(CATALOGUE, random_attitude(5), 5, 4 * SIGMA_PX)
    right = searched(shaken)
    frames[5] = shaken._replace(sigma_rad=shaken.sigma_rad / 4)
    star, chi2 = np.full(len(true), -1, np.int64), np.zeros(len(true))
    star[:4] = right.star[:4]
    solutions = solved_frames([*frames[:5], shaken, *frames[6:]])
    solutions.enter(5, right._replace(star=star, chi2=chi2))
    factors = reidentify_poor_frames(join(frames), solutions, WHERE, MATCHING)
    assert np.sum(solutions.frame(5).star >= 0) > 0.8 * np.sum(true >= 0)
    assert 2.5 < factors[5] < 6.0


def test_frames_like_the_others_and_few_frames_are_left_alone():
    frames = [frame(CATALOGUE, random_attitude(k), k, SIGMA_PX)[0] for k in range(8)]
    solutions = solved_frames(frames)
    before = solutions.R_sensor_from_icrs.copy()
    assert (reidentify_poor_frames(join(frames), solutions, WHERE, MATCHING) == 1.0).all()
    np.testing.assert_array_equal(solutions.R_sensor_from_icrs, before)
    assert len(poor_frames(solved_frames(frames[:3]))) == 0
    assert len(poor_frames(unsolved(np.zeros(1, np.int64)))) == 0
