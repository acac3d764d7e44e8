"""Batches: each piece once and in order, of about equal work, few whatever the night."""

import pickle

import numpy as np
import pytest

from epipole.schemas.spans import Sensor, Span
from epipole.tasks.common.batches import (
    FEW_TASKS,
    FRAMES_OF_TASK,
    MANY_TASKS,
    MAX_TASKS,
    OF_PIECE,
    SMALL_TASK,
    in_batches,
)
from epipole.tasks.identify.identify_span import SpanToIdentify


@pytest.mark.parametrize("n", [1, 2, MANY_TASKS, 100, 5000])
def test_pieces_are_in_one_batch_each_in_order(n):
    sizes = np.random.default_rng(n).integers(0, 2 * FRAMES_OF_TASK, n)
    batches = in_batches(list(range(n)), sizes.tolist())
    assert [piece for batch in batches for piece in batch] == list(range(n))
    assert all(len(batch) for batch in batches)


def test_few_sensors_have_a_task_each():
    assert [len(batch) for batch in in_batches("abcd", [600] * 4)] == [1, 1, 1, 1]


@pytest.mark.parametrize("n_frames", [1, 100, FRAMES_OF_TASK])
def test_a_night_of_any_size_has_few_tasks(n_frames):
    batches = in_batches(range(60_000), [n_frames] * 60_000)
    assert len(batches) <= MAX_TASKS
    lengths = [len(batch) for batch in batches]
    assert max(lengths) - min(lengths) <= 1


def test_tasks_have_about_equal_work():
    n_frames = np.random.default_rng(1).integers(1, 400, 10_000).tolist()
    work = [
        sum(n_frames[k] + OF_PIECE for k in batch) for batch in in_batches(range(10_000), n_frames)
    ]
    assert max(work) - min(work) <= 800
    assert sum(work) / len(work) <= FRAMES_OF_TASK


@pytest.mark.parametrize("n_sensors", [8, 50, 192, 1000])
@pytest.mark.parametrize("n_frames", [0, 60, 1200])
def test_small_work_is_not_divided_into_tasks_that_cost_more_than_they_do(n_sensors, n_frames):
    work = [n_frames + OF_PIECE] * n_sensors
    batches = in_batches(range(n_sensors), [n_frames] * n_sensors)
    assert FEW_TASKS <= len(batches) <= max(FEW_TASKS, sum(work) // SMALL_TASK)


def test_nothing_to_do_is_no_batch():
    assert in_batches([], []) == []


def test_a_batch_is_named_by_its_first_piece():
    span = Span(14_400 * 10**9, 16_200 * 10**9)
    pieces = [SpanToIdentify(Sensor(k, f"cam{k}"), span, None) for k in range(3)]
    (batch,) = in_batches(pieces[:1], [1])
    assert str(batch) == "cam0 04:00-04:30"
    three = type(batch)(pieces)
    assert str(three) == "cam0 04:00-04:30 and 2 more"
    assert list(pickle.loads(pickle.dumps(three))) == pieces
