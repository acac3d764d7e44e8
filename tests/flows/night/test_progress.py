"""Progress of a run: results in the order of the tasks, and steps."""

import logging

import pytest

from epipole.flows.night.progress import STEPS, compile_step, prepare, results, step
from epipole.schemas.stages import Stage


class Collected(logging.Handler):
    def __init__(self):
        super().__init__()
        self.steps = []
        self.lines = []

    def emit(self, record):
        counts = vars(record)
        self.lines.append(record.getMessage())
        self.steps.append((counts["stage"], counts["done"], counts["total"], counts["percent"]))


@pytest.fixture
def steps():
    handler = Collected()
    STEPS.addHandler(handler)
    yield handler.steps
    STEPS.removeHandler(handler)


class Future:
    def __init__(self, value):
        self.value = value

    def result(self):
        if isinstance(self.value, Exception):
            raise self.value
        return self.value


def test_results_come_in_the_order_of_the_tasks_and_count_up(steps):
    assert results(Stage.TRACK, [Future(3), Future(1), Future(2)]) == [3, 1, 2]
    assert [done for _, done, _, _ in steps] == [0, 1, 2, 3]
    assert {stage for stage, *_ in steps} == {"track"}


def test_the_error_of_a_task_is_the_error_of_the_stage(steps):
    with pytest.raises(ValueError, match="no good"):
        results(Stage.TRACK, [Future(1), Future(ValueError("no good")), Future(2)])
    assert [done for _, done, _, _ in steps] == [0, 1]


def test_stages_one_after_another_make_a_whole(steps):
    prepare("compile")
    for stage in Stage:
        step(stage, 0, 2)
        step(stage, 2, 2)
    percents = [percent for *_, percent in steps]
    assert percents == sorted(percents)
    assert (percents[0], percents[-1]) == (0.0, 100.0)


def test_the_parts_of_a_stage_make_the_stage(steps):
    step(Stage.TRACK, 1, 1)
    for k in range(4):
        results(Stage.SOLVE, [Future(1), Future(2)], (k, 4))
    step(Stage.CHECK, 0, 1)
    percents = [percent for *_, percent in steps]
    assert percents == sorted(percents)
    assert (percents[0], percents[-2]) == (percents[1], percents[-1])
    assert len(set(percents)) == 9  # two tasks of four parts, and the start
    assert [done for _, done, _, _ in steps][1:-1] == [0, 1, 2] * 4


def test_a_line_has_a_total_where_it_is_known():
    handler = Collected()
    STEPS.addHandler(handler)
    compile_step(7, 220)
    compile_step(7, 0)
    STEPS.removeHandler(handler)
    assert handler.lines == ["compile: 7 of 220", "compile: 7"]


def test_a_stage_without_tasks_is_a_step(steps):
    step(Stage.SOLVE, 0, 0)
    ((stage, done, total, percent),) = steps
    assert (stage, done, total) == ("solve", 0, 0)
    assert 0 < percent < 100
