"""Of too many detections, the fullest frames keep their brightest."""

import numpy as np

from epipole.tasks.identify.tabulate import within_limit


def test_within_the_bound_everything_is_kept():
    assert within_limit(np.array([0, 0, 3]), np.array([1.0, np.nan, 2.0]), 3).all()
    assert len(within_limit(np.empty(0, np.int64), np.empty(0), 1_000)) == 0


def test_full_frames_are_cut_to_one_number_or_one_more_and_others_keep_all():
    frame = np.repeat(np.arange(4), [2, 50, 5, 40])
    kept = within_limit(frame, np.random.default_rng(0).uniform(1, 2, len(frame)), 40)
    a, b = np.bincount(frame[kept])[[1, 3]]
    assert (a + b, abs(a - b)) == (33, 1)
    assert kept[(frame == 0) | (frame == 2)].all()


def test_the_brightest_are_kept_and_those_without_flux_go_first():
    frame = np.zeros(6, np.int64)
    flux = np.array([np.nan, 5.0, 1.0, 9.0, np.nan, 3.0])
    np.testing.assert_array_equal(np.flatnonzero(within_limit(frame, flux, 3)), [1, 3, 5])
    np.testing.assert_array_equal(np.flatnonzero(within_limit(frame, flux, 5)), [0, 1, 2, 3, 5])


def test_of_more_frames_than_the_bound_the_brightest_are_kept():
    flux = np.array([1.0, 7.0, np.nan, 3.0, 9.0, 2.0, 8.0, 4.0, 5.0, 6.0])
    kept = within_limit(np.arange(10), flux, 4)
    np.testing.assert_array_equal(np.flatnonzero(kept), [1, 4, 6, 9])
