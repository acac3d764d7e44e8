"""Centroids that stay at one pixel are told from those that move."""

import numpy as np

from epipole.tasks.algorithms.star_identification.centroids import static_centroids


def frames(n_frames, hot, n_moving, seed=0, shown=0.8):
    """Places of frames with hot pixels, and others at random; which are hot."""
    rng = np.random.default_rng(seed)
    places, is_hot, first = [], [], [0]
    for _ in range(n_frames):
        on = hot[rng.uniform(size=len(hot)) < shown]
        places += [on + rng.normal(0, 0.05, on.shape), rng.uniform(0, 1023, (n_moving, 2))]
        is_hot += [np.ones(len(on), bool), np.zeros(n_moving, bool)]
        first.append(first[-1] + len(on) + n_moving)
    x, y = np.concatenate(places).T
    return np.array(first), x, y, np.concatenate(is_hot)


def test_hot_pixels_stay_and_hardly_any_other():
    hot = np.random.default_rng(1).uniform(0, 1023, (500, 2))
    hot[:100] = np.floor(hot[:100]) + 0.5 * np.random.default_rng(2).integers(0, 2, (100, 2))
    first, x, y, is_hot = frames(40, hot, 30)
    stays = static_centroids(first, x, y)
    assert stays[is_hot].mean() > 0.99
    assert stays[~is_hot].mean() < 0.005  # those that fall on a hot pixel


def test_few_frames_tell_nothing():
    first, x, y, _ = frames(3, np.full((5, 2), 100.0), 2, shown=1.1)
    assert not static_centroids(first, x, y).any()


def test_two_centroids_of_a_frame_at_one_pixel_count_once():
    first = np.arange(0, 22, 2)
    x, y = np.full((2, 20), 7.1)
    x[2 * 2 :] = np.arange(16) * 10.0  # only two frames show the pair
    assert not static_centroids(first, x, y).any()


def test_invalid_places_do_not_stay():
    first, bad = np.arange(11), np.full(10, np.nan)
    assert not static_centroids(first, bad, np.full(10, 3.0)).any()
    assert not static_centroids(first, np.full(10, np.inf), np.full(10, 3.0)).any()
    assert not static_centroids(np.array([0]), np.empty(0), np.empty(0)).any()
    assert static_centroids(first, np.full(10, -3.2), np.full(10, 3.0)).all()
