"""Stages: the log lines of the check of clocks."""

import logging

from epipole.flows.night.stages import tell_clocks
from epipole.tasks.check.estimate_clocks import Clock

RIGHT = [Clock("a", -0.017, 0.029, False), Clock("b", 0.004, 0.007, False)]
WRONG = Clock("c", 0.25, 0.01, True)


def lines(clocks, caplog):
    with caplog.at_level(logging.INFO):
        tell_clocks(clocks)
    return [(record.levelname, record.getMessage()) for record in caplog.records]


def test_right_clocks_are_one_line_and_each_wrong_one_a_warning(caplog):
    assert lines([*RIGHT, WRONG], caplog) == [
        ("INFO", "clocks of 2 sensors are right within 0.029 s"),
        ("WARNING", "the clock of c is 0.250 s late (sigma 0.010 s)"),
    ]


def test_unknown_clocks_have_no_line(caplog):
    assert lines([], caplog) == []
