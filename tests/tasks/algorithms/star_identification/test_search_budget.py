"""What searches may cost: together, in a pass, and of one frame."""

import numpy as np
import pytest

from epipole.tasks.algorithms.star_identification.search_budget import (
    AT_ONCE,
    HEAD_START,
    PER_FRAME,
    SearchBudget,
)


def test_a_pass_earns_its_share_from_frame_to_frame():
    budget = SearchBudget(100, 0.5)
    assert budget.total_s == pytest.approx(50 * PER_FRAME)
    allowance = budget.allow(np.arange(100), 0.05)
    size_s = 0.05 * budget.total_s
    assert allowance.left_s(0, 0.01) == pytest.approx(HEAD_START * size_s)
    assert allowance.left_s(99, 1.0) == pytest.approx(size_s)
    allowance.spend(50, 0.5 * size_s)
    assert allowance.left_s(60, 0.6) == pytest.approx(0.1 * size_s)
    assert budget.allow(np.arange(100), 0.05, one_will_do=True).left_s(0, 0.01) < size_s
    assert budget.frame_s[50] == pytest.approx(0.5 * size_s)


def test_one_frame_costs_its_part_in_all_passes_together():
    budget = SearchBudget(1000, 0.5)
    budget.allow(np.arange(1000), 0.5).spend(7, 0.375 * AT_ONCE)
    again = budget.allow(np.array([3, 7]), 0.5)
    assert again.left_s(0, 1.0) == pytest.approx(0.5 * AT_ONCE)
    assert again.left_s(1, 1.0) == pytest.approx(0.125 * AT_ONCE)


def test_a_single_frame_may_cost_what_a_frame_may_cost_at_once():
    assert SearchBudget(1, 0.5).total_s == pytest.approx(0.5 * AT_ONCE)
    assert SearchBudget(1, 0.5, 0.3).total_s == pytest.approx(0.15 * AT_ONCE)
    assert SearchBudget(1, 20.0).total_s == pytest.approx(20.0 * AT_ONCE)
