"""Clusters of false centroids are thinned."""

import numpy as np

from epipole.tasks.algorithms.star_identification.frames.clusters import thinned

BOX = np.array([-0.1, 0.1, -0.1, 0.1])


def directions(x, y):
    u = np.stack([x, y, np.ones_like(x)], axis=-1)
    return u / np.linalg.norm(u, axis=-1, keepdims=True)


def test_of_a_cluster_the_brightest_few_are_kept_and_all_that_is_elsewhere():
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.1, 0.1, (2, 30))
    cluster = rng.normal(0.0625, 0.003, (2, 200))
    mixed = rng.permutation(230)
    u = directions(np.append(x, cluster[0]), np.append(y, cluster[1]))[mixed]
    kept = thinned(u, BOX)
    assert np.isin(np.flatnonzero(mixed < 30), kept).mean() > 0.9
    assert (mixed[kept] >= 30).sum() <= 16
    first_of_cluster = np.flatnonzero(mixed >= 30)[0]
    assert first_of_cluster in kept


def test_a_crowd_that_is_everywhere_is_no_cluster():
    u = directions(*np.random.default_rng(1).uniform(-0.1, 0.1, (2, 900)))
    assert len(thinned(u, BOX)) == 900


def test_few_none_and_those_outside_are_kept():
    assert len(thinned(np.empty((0, 3)), BOX)) == 0
    assert thinned(directions(np.array([0.0, 5.0]), np.array([0.0, -9.0])), BOX).tolist() == [0, 1]
