"""Stages: the log lines of the check of clocks."""

import logging

from epipole.flows.night.stages import log_verdicts
from epipole.tasks.check.check_sensors import SensorVerdict

RIGHT = [SensorVerdict("a", -0.017, 0.029), SensorVerdict("b", 0.004, 0.007)]
WRONG = SensorVerdict("c", 0.25, 0.01, "clock")


def lines(clocks, caplog):
    with caplog.at_level(logging.INFO):
        log_verdicts(clocks)
    return [(record.levelname, record.getMessage()) for record in caplog.records]


def test_right_clocks_are_one_line_and_each_wrong_one_a_warning(caplog):
    assert lines([*RIGHT, WRONG], caplog) == [
        ("INFO", "clocks of 2 sensors agree with each other within 0.029 s"),
        ("WARNING", "the clock of c is 0.250 s late (sigma 0.010 s)"),
    ]


def test_unknown_clocks_have_no_line(caplog):
    assert lines([], caplog) == []
