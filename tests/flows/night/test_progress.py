"""Progress of a run: results in the order of the tasks, steps, and which lines are shown."""

import io
import logging
import sys
import time

import pytest

from epipole.flows.night.progress import ROOT, STEPS, prepare, results, shown, step
from epipole.schemas.stages import Stage


class Collected(logging.Handler):
    def __init__(self):
        super().__init__()
        self.steps = []

    def emit(self, record):
        counts = vars(record)
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


def test_a_stage_without_tasks_is_a_step(steps):
    step(Stage.SOLVE, 0, 0)
    ((stage, done, total, percent),) = steps
    assert (stage, done, total) == ("solve", 0, 0)
    assert 0 < percent < 100


def written(capsys, **how) -> str:
    with shown(**how):
        logging.getLogger("epipole.flows.night.stages").info("read 3 frames")
        logging.getLogger("epipole.tasks.read.read_logs").info("a.mcap: read 3 frames")
        logging.getLogger("epipole.tasks.read.read_logs").warning("a.mcap: damaged")
    return capsys.readouterr().err


def test_lines_of_stages_and_warnings_are_shown(capsys):
    lines = written(capsys, quiet=False, verbose=False).splitlines()
    assert [line.split(" ", 1)[1] for line in lines] == ["read 3 frames", "a.mcap: damaged"]


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_the_bar_on_a_terminal_shows_the_stage_and_moves(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setenv("TERM", "xterm")
    with shown(quiet=False, verbose=False):
        step(Stage.TRACK, 1, 4)
        time.sleep(0.3)  # the bar is drawn ten times per second
        step(Stage.TRACK, 3, 4)
        time.sleep(0.3)
    drawn = sys.stderr.getvalue()
    assert "track" in drawn
    assert "1/4" in drawn
    assert "3/4" in drawn


def test_lines_of_tasks_are_shown_on_request(capsys):
    assert "a.mcap: read 3 frames" in written(capsys, quiet=False, verbose=True)


def test_a_quiet_run_shows_nothing(capsys, monkeypatch):
    monkeypatch.setattr(ROOT, "handlers", list(ROOT.handlers))
    monkeypatch.setattr(ROOT, "propagate", True)
    assert written(capsys, quiet=True, verbose=False) == ""


def test_no_line_is_shown_twice(capsys):
    also = logging.StreamHandler()  # such as Prefect's console handler
    logging.getLogger().addHandler(also)
    try:
        assert written(capsys, quiet=False, verbose=False).count("damaged") == 1
    finally:
        logging.getLogger().removeHandler(also)


def test_afterwards_logging_is_as_before(capsys):
    before = (list(ROOT.handlers), ROOT.level, ROOT.propagate)
    written(capsys, quiet=False, verbose=True)
    assert (ROOT.handlers, ROOT.level, ROOT.propagate) == before


def test_a_line_is_one_line_and_a_warning_is_shown_once(capfd):
    log = logging.getLogger("epipole.flows.here")
    with shown(quiet=False, verbose=False):
        log.info("sensor \x1b[2J\nof a log")
        for _ in range(2):
            log.warning("twice")
    first, second = capfd.readouterr().err.splitlines()
    assert first.endswith(" sensor \\x1b[2J\\nof a log")
    assert second.endswith(" twice")
