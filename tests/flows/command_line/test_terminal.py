"""What a run shows: the lines of its stages, bars on a terminal, progress elsewhere."""

import io
import logging
import sys
import time

from epipole.flows.command_line import terminal
from epipole.flows.command_line.terminal import shown
from epipole.flows.night.progress import ROOT, compile_step, step
from epipole.schemas.stages import Stage


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
        compile_step(20, 220)
        step(Stage.TRACK, 1, 4)
        time.sleep(0.3)  # the bar is drawn ten times per second
        step(Stage.TRACK, 3, 4)
        time.sleep(0.3)
    drawn = sys.stderr.getvalue()
    assert "compile" in drawn
    assert "20/220" in drawn
    assert "left" in drawn
    assert "track" in drawn
    assert "1/4" in drawn
    assert "3/4" in drawn


def test_a_stage_that_is_done_makes_room_for_the_next_and_parts_have_numbers(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setenv("TERM", "xterm")
    with shown(quiet=False, verbose=False):
        step(Stage.SOLVE, 1, 2, (3, 5))
        time.sleep(0.3)
        compile_step(220, 220)
        time.sleep(0.3)
    drawn = sys.stderr.getvalue()
    assert "solve 4/5" in drawn
    assert "compile" not in drawn


def test_a_long_stage_tells_its_progress_without_a_terminal_now_and_then(capsys, monkeypatch):
    with shown(quiet=False, verbose=False):
        step(Stage.TRACK, 1, 4)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(terminal, "LINE_EVERY_S", 0.0)
    with shown(quiet=False, verbose=False):
        for k in range(5):
            step(Stage.TRACK, k, 4)
        compile_step(7, 220)
    lines = [line.split(" ", 1)[1] for line in capsys.readouterr().err.splitlines()]
    assert lines == [*(f"track: {k} of 4" for k in (1, 2, 3)), "compile: 7 of 220"]


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
    log = logging.getLogger("epipole.flows.run_here")
    with shown(quiet=False, verbose=False):
        log.info("sensor \x1b[2J\nof a log")
        for _ in range(2):
            log.warning("twice")
    first, second = capfd.readouterr().err.splitlines()
    assert first.endswith(" sensor \\x1b[2J\\nof a log")
    assert second.endswith(" twice")
