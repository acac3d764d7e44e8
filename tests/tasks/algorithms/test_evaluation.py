"""The arithmetic of an evaluation."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, kstest

from epipole.tasks.algorithms.evaluation import (
    attitude_errors,
    majority,
    pairs_within,
    squared_normalised_errors,
)


def test_attitude_errors_are_about_the_sensors_own_axes():
    true = Rotation.random(1, random_state=3)
    turn = Rotation.from_rotvec([[3e-5, 4e-5, -7e-5]])
    cross, roll = attitude_errors((turn * true).as_quat(), -true.as_quat())
    np.testing.assert_allclose([cross[0], roll[0]], [5e-5, -7e-5], rtol=1e-9)
    assert [len(v) for v in attitude_errors(np.empty((0, 4)), np.empty((0, 4)))] == [0, 0]


def test_honest_errors_have_chi_square_of_three():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(4000, 3, 3))
    error = np.einsum("nij,nj->ni", root, rng.normal(size=(4000, 3)))
    nees = squared_normalised_errors(error, root @ root.transpose(0, 2, 1))
    assert kstest(nees, chi2(3).cdf).pvalue > 0.01


@pytest.mark.parametrize("bad", [np.full((3, 3), np.nan), np.zeros((3, 3)), -np.eye(3)])
def test_an_invalid_covariance_gives_infinity_and_does_not_change_others(bad):
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
