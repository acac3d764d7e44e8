"""The arithmetic of an evaluation."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, kstest

from epipole.tasks.algorithms.evaluation import (
    SampledOrbits,
    attitude_errors,
    count_changes,
    interpolate_orbits,
    majority,
    mean_of_group_means,
    pairs_within,
    squared_normalised_errors,
)


def test_attitude_errors_are_about_the_sensors_own_axes():
    true = Rotation.random(1, random_state=3)
    turn = Rotation.from_rotvec([[3e-5, 4e-5, -7e-5]])
    cross, roll = attitude_errors((turn * true).as_quat(), -true.as_quat())
    np.testing.assert_allclose([cross[0], roll[0]], [5e-5, -7e-5], rtol=1e-9)
    assert [len(v) for v in attitude_errors(np.empty((0, 4)), np.empty((0, 4)))] == [0, 0]


@pytest.mark.parametrize("k", [3, 6])
def test_honest_errors_have_chi_square_of_their_length(k):
    rng = np.random.default_rng(1)
    root = rng.normal(size=(4000, k, k))
    error = np.einsum("nij,nj->ni", root, rng.normal(size=(4000, k)))
    nees = squared_normalised_errors(error, root @ root.transpose(0, 2, 1))
    assert kstest(nees, chi2(k).cdf).pvalue > 0.01


@pytest.mark.parametrize("bad", [np.full((3, 3), np.nan), np.zeros((3, 3)), -np.eye(3)])
def test_an_invalid_covariance_has_an_infinite_nees_and_changes_no_other(bad):
    nees = squared_normalised_errors(np.ones((2, 3)), np.stack([bad, np.eye(3)]))
    assert nees.tolist() == [np.inf, 3.0]


members = st.lists(st.tuples(st.integers(0, 4), st.integers(-1, 3)), max_size=40)


@given(members)
def test_majority_and_pairs_are_those_of_counting_one_by_one(rows):
    group, value = np.array(rows, np.int64).reshape(-1, 2).T
    found = majority(group, value, 5)
    pairs = right = 0
    for k in range(5):
        own = [v for g, v in rows if g == k]
        real = [v for v in own if v >= 0]
        # max() keeps the first of equals.
        most = max(real, key=real.count, default=-1)
        assert (found.value[k], found.votes[k]) == (most, real.count(most))
        couples = [(a, b) for i, a in enumerate(own) for b in own[:i]]
        pairs += len(couples)
        right += sum(a == b >= 0 for a, b in couples)
    assert pairs_within(group, value, 5) == (pairs, right)


@given(members)
def test_changes_are_those_of_comparing_neighbours_one_by_one(rows):
    rows = sorted(rows, key=lambda row: row[0])
    group, value = np.array(rows, np.int64).reshape(-1, 2).T
    expected = sum(a[0] == b[0] and a[1] != b[1] for a, b in itertools.pairwise(rows))
    assert count_changes(group, value) == expected


def test_the_mean_of_group_means_gives_each_group_the_same_weight():
    mean, sigma = mean_of_group_means(np.array([8, 2, 8, 8]), np.array([1.0, 6.0, 2.0, 3.0]))
    assert (mean, sigma) == pytest.approx((4.0, 2.0 / np.sqrt(2)))
    mean, sigma = mean_of_group_means(np.array([0, 1]), np.array([1.0, np.inf]))
    assert (mean, sigma) == (np.inf, np.inf)


def test_interpolated_orbits_are_exact_for_cubics_also_beyond_their_samples():
    rng = np.random.default_rng(4)
    cubic = {k: rng.normal(size=(4, 3)) for k in (3, 9)}
    slope = {k: c[1:] * [[1], [2], [3]] for k, c in cubic.items()}

    def at(coefficients, k, t_s):
        powers = t_s[:, None] ** np.arange(len(coefficients[k]))
        return powers @ coefficients[k]

    t_s = np.array([0.0, 1.0, 2.5])
    orbits = SampledOrbits(
        np.repeat([3, 9], 3), np.tile(t_s, 2),
        *[np.concatenate([at(c, k, t_s) for k in (3, 9)]) for c in (cubic, slope)],
    )  # fmt: skip
    objects, when_s = np.array([9, 3, 9, 3, 9]), np.array([0.3, -0.5, 2.5, 1.7, 3.1])
    r_km, v_km_s = interpolate_orbits(orbits, objects, when_s)
    for i, k in enumerate(objects):
        np.testing.assert_allclose(r_km[i], at(cubic, k, when_s[[i]])[0], atol=1e-12)
        np.testing.assert_allclose(v_km_s[i], at(slope, k, when_s[[i]])[0], atol=1e-12)
    assert interpolate_orbits(orbits, objects[:0], when_s[:0])[0].shape == (0, 3)
