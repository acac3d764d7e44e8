"""A sensor followed from frame to frame."""

import numpy as np
import pytest
from scenes.random_stars import (
    MATCHING,
    angle_between,
    frame,
    join,
    random_attitude,
    random_catalogue,
)
from scipy.spatial.transform import Rotation

from epipole.tasks.algorithms.star_identification.following import (
    ACCELERATION_SIGMA,
    new_memory,
    predict,
    remember,
)
from epipole.tasks.algorithms.star_identification.sequence import (
    Priors,
    identify_sequence,
    no_priors,
)
from epipole.tasks.algorithms.star_identification.star_grid import (
    pattern_pairs,
    pattern_size,
    sky_grid,
    sky_to_limit,
)

ARCSEC = np.pi / 648000
P_FIX = np.eye(3) * ARCSEC**2
CATALOGUE = random_catalogue()
SKY = sky_to_limit(CATALOGUE, 99.0)
GRID = sky_grid(SKY, 0.005)


def _pairs():
    optics = frame(CATALOGUE, np.eye(3), 0)[0].optics
    n = pattern_size(SKY, optics.solid_angle_sr)
    return pattern_pairs(CATALOGUE.u_icrs[:n], 2 * optics.half_diagonal_rad)


def _turning(n, rate=0.005, seed=0):
    """Return the attitudes of a sensor that turns evenly, one per second."""
    first = random_attitude(seed)
    axis = np.array([0.5, -0.7, 0.4])
    return [Rotation.from_rotvec(rate * k * axis).as_matrix() @ first for k in range(n)]


def turned_by(R, angle):
    """Return an attitude turned about the sensor's x axis [rad]."""
    return Rotation.from_rotvec([angle, 0.0, 0.0]).as_matrix() @ R


def _identify(frames, priors=None, t_s=None, pairs=_pairs):
    n = len(frames)
    t_s = np.arange(n) * 1.0 if t_s is None else t_s
    priors = no_priors(n) if priors is None else priors
    found, status = identify_sequence(t_s, join(frames), priors, SKY, GRID, pairs, MATCHING)
    return found.each(), status


def _remembering(*fixes):
    """Return the memory of a sensor with these times and attitudes, known to an arc second."""
    memory = new_memory(1)
    for t_s, R in fixes:
        remember(memory, t_s, R, P_FIX)
    return memory


def _predict(memory, t_s):
    R, P = np.empty((3, 3)), np.empty((3, 3))
    return predict(memory, t_s, R, P), R, P


def test_a_turning_sensor_is_predicted_to_where_it_turns():
    for rate in (0.0, 1e-6, 0.005, 0.3):
        R = _turning(3, rate)
        useful, found, cov = _predict(_remembering((0.0, R[0]), (1.0, R[1])), 2.0)
        assert useful
        assert angle_between(found, R[2]) < 1e-9
        # (1 + 1)^2 + 1 of the errors, and what an uneven turn adds.
        assert cov[0, 0] == pytest.approx(5 * ARCSEC**2 + ACCELERATION_SIGMA**2)


def test_backward_in_time_the_turn_is_the_other_way():
    R = _turning(3)
    _, found, _ = _predict(_remembering((2.0, R[2]), (1.0, R[1])), 0.0)
    assert angle_between(found, R[0]) < 1e-9


def test_predictions_grow_useless_with_the_gap_and_after_a_slew():
    R = _turning(2)
    assert not _predict(_remembering(), 0.0)[0]
    assert _predict(_remembering((0.0, R[0])), 5.0)[0]
    assert not _predict(_remembering((0.0, R[0])), 1000.0)[0]
    assert not _predict(_remembering((0.0, R[0]), (1.0, R[1])), 1000.0)[0]
    assert not _predict(_remembering((0.0, R[0]), (1.0, _turning(2, 1.0)[1])), 2.0)[0]


def test_after_the_first_frames_no_search_is_needed():
    R = _turning(12)
    frames = [frame(CATALOGUE, r, k, n_false=10)[0] for k, r in enumerate(R)]
    searched = []

    def counted():
        searched.append(1)
        return _pairs()

    solutions, _ = _identify(frames, pairs=counted)
    assert len(searched) <= 2  # then its rate is known
    for r, s in zip(R, solutions, strict=True):
        assert angle_between(s.R_sensor_from_icrs, r) < 300 * ARCSEC


def test_stars_of_a_sensor_that_turns_far_are_those_of_its_field():
    # Ten times the margin within which stars around a field are listed.
    R = _turning(100, rate=0.006)
    frames, true = zip(*[frame(CATALOGUE, r, k, n_false=3) for k, r in enumerate(R)], strict=True)
    for solution, star in zip(_identify(list(frames))[0], true, strict=True):
        claimed = solution.star >= 0
        np.testing.assert_array_equal(solution.star[claimed], star[claimed])
        assert claimed.sum() >= 0.9 * (star >= 0).sum()


def test_after_a_slew_the_sensor_is_found_again():
    R = _turning(4) + _turning(4, seed=9)
    solutions, status = _identify([frame(CATALOGUE, r, k)[0] for k, r in enumerate(R)])
    assert status == [None] * 8
    for r, s in zip(R, solutions, strict=True):
        assert angle_between(s.R_sensor_from_icrs, r) < 300 * ARCSEC


def test_a_frame_with_few_stars_is_found_from_the_frame_after_it():
    R = _turning(4, rate=1e-4)
    frames = [frame(CATALOGUE, r, k)[0] for k, r in enumerate(R)]
    few = frames[0]  # four stars: too few for a search, enough next to an attitude
    frames[0] = few._replace(
        u=few.u[:4], sigma_rad=few.sigma_rad[:4], instrumental_mag=np.full(4, np.nan)
    )
    solutions, status = _identify(frames)
    assert status[0] is None
    assert angle_between(solutions[0].R_sensor_from_icrs, R[0]) < 500 * ARCSEC


def test_too_few_centroids_and_no_match_are_told_apart():
    R = _turning(3)
    frames = [frame(CATALOGUE, r, k)[0] for k, r in enumerate(R)]
    frames[1] = frames[1]._replace(
        u=frames[1].u[:2], sigma_rad=frames[1].sigma_rad[:2], instrumental_mag=np.zeros(2)
    )
    frames[2] = frame(CATALOGUE, R[2], 2, n_false=8, missing=1.0)[0]
    solutions, status = _identify(frames)
    assert status == [None, "too_few_stars", "no_match"]
    assert solutions[1] is None
    assert solutions[2] is None


def test_a_right_prior_spares_the_search_and_a_wrong_one_is_overruled():
    R = _turning(3)
    frames = [frame(CATALOGUE, r, k)[0] for k, r in enumerate(R)]

    def never():
        raise AssertionError("searched the whole sky")

    sigma = np.full(3, 60 * ARCSEC)
    right = Priors(np.array(R), sigma)
    assert _identify(frames, right, pairs=never)[1] == [None] * 3
    wrong = Priors(np.array([random_attitude(77)] * 3), sigma)
    solutions, _ = _identify(frames, wrong)
    for r, s in zip(R, solutions, strict=True):
        assert angle_between(s.R_sensor_from_icrs, r) < 300 * ARCSEC


def test_priors_that_go_wrong_after_they_were_confirmed_are_overruled():
    """Frames at random attitudes: none can be followed from the one before."""
    R = np.array([random_attitude(k) for k in range(12)])
    frames = [frame(CATALOGUE, r, k)[0] for k, r in enumerate(R)]
    drifting = Priors(R.copy(), np.full(12, 20 * ARCSEC))
    drifting.R_sensor_from_icrs[4:] = [turned_by(r, 600 * ARCSEC) for r in R[4:]]
    solutions, status = _identify(frames, drifting)
    assert status == [None] * 12
    for r, s in zip(R, solutions, strict=True):
        assert angle_between(s.R_sensor_from_icrs, r) < 300 * ARCSEC


def test_frames_without_stars_after_confirmed_priors_are_searched_rarely():
    R = np.array([random_attitude(k) for k in range(300)])
    dark = frame(CATALOGUE, random_attitude(0), 0, n_false=6, missing=1.0)[0]
    frames = [frame(CATALOGUE, r, k)[0] if k < 10 else dark for k, r in enumerate(R)]
    status = _identify(frames, Priors(R, np.full(300, 60 * ARCSEC)))[1]
    assert status[:10] == [None] * 10
    assert 8 <= status.count("no_match") <= 30


def test_a_dark_log_is_searched_ever_more_rarely():
    dark = frame(CATALOGUE, random_attitude(0), 0, n_false=6, missing=1.0)[0]
    calls = []

    def counted():
        calls.append(1)
        return table

    table = _pairs()
    _identify([dark] * 300, pairs=counted)
    assert 10 <= len(calls) <= 40


def test_a_frame_that_was_skipped_says_so():
    dark = frame(CATALOGUE, random_attitude(0), 0, n_false=6, missing=1.0)[0]
    status = _identify([dark] * 200)[1]
    searched = [k for k, code in enumerate(status) if code == "no_match"]
    assert set(status) == {"no_match", "not_searched"}
    assert searched[:6] == [0, 1, 2, 3, 4, 5]  # a few in a row first
    assert max(np.diff(searched)) == 33


@pytest.mark.long
@pytest.mark.parametrize("n_dark", [40, 150])
def test_frames_skipped_before_the_sensor_is_found_are_found_from_there(n_dark):
    dark = frame(CATALOGUE, random_attitude(0), 0, n_false=6, missing=1.0)[0]
    R = _turning(60)
    frames = [dark] * n_dark + [frame(CATALOGUE, r, k)[0] for k, r in enumerate(R)]
    assert _identify(frames)[1][n_dark:] == [None] * 60


@pytest.mark.long
def test_what_was_skipped_behind_a_slew_is_searched():
    dark = frame(CATALOGUE, random_attitude(0), 0, n_false=6, missing=1.0)[0]
    R = _turning(20, seed=5) + _turning(60, seed=9)  # the first stay is shorter than the skip
    frames = [dark] * 110 + [frame(CATALOGUE, r, k)[0] for k, r in enumerate(R)]
    solutions, status = _identify(frames)
    assert status[110:] == [None] * 80
    for r, s in zip(R, solutions[110:], strict=True):
        assert angle_between(s.R_sensor_from_icrs, r) < 300 * ARCSEC


def test_a_sensor_that_failed_before_is_searched_rarely_from_the_start():
    dark = frame(CATALOGUE, random_attitude(0), 0, n_false=6, missing=1.0)[0]
    frames = join([dark] * 200)
    _, status = identify_sequence(
        np.arange(200.0), frames, no_priors(200), SKY, GRID, _pairs, MATCHING, hopeless=True
    )
    assert 5 <= status.count("no_match") <= 10


def test_frames_are_followed_from_anchors_both_ways_without_a_search():
    R = _turning(30, rate=1e-4)
    frames = [frame(CATALOGUE, r, k)[0] for k, r in enumerate(R)]
    anchors = no_priors(30)
    anchors.R_sensor_from_icrs[15], anchors.sigma_rad[15] = R[15], 20 * ARCSEC

    def never():
        raise AssertionError("searched the whole sky")

    found, status = identify_sequence(
        np.arange(30.0), join(frames), anchors, SKY, GRID, never, MATCHING, anchored=True
    )
    assert status == [None] * 30
    assert found.solved.all()
