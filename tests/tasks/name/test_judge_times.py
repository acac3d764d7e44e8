"""Whether times are UTC: verdicts and sentences."""

import numpy as np
import pytest

from epipole.tasks.algorithms.known_objects.time_offset import TimeOffset
from epipole.tasks.name.judge_times import finding_of
from epipole.tasks.read.judge_sensor import sentence_of


@pytest.mark.parametrize(
    ("offset", "verdict", "words"),
    [
        (TimeOffset(np.nan, np.nan, 0, 0), "unknown", "0 of 40 tracklets are known satellites"),
        (TimeOffset(18.0, 0.1, 4, 0), "unknown", "too few to tell"),
        (TimeOffset(0.3, 0.1, 30, 30), "sound", "UTC within 0.5 s, by 30 tracklets"),
        (TimeOffset(18.1, 0.2, 30, 0), "wrong", "GPS and UTC differ by 18 s; write UTC in frames"),
        (TimeOffset(-7200.0, 0.2, 30, 0), "wrong", "clocks that differ by 2 h"),
        (TimeOffset(7.0, 0.2, 30, 1), "wrong", "no time scale in use is that far"),
        (TimeOffset(2.0, 0.9, 30, 9), "sound", "within 3.8 s"),
    ],
)
def test_an_offset_is_named_beyond_its_error(offset, verdict, words):
    found = finding_of(offset, 40)
    assert found.verdict == verdict
    assert words in sentence_of(found)
