"""Doubt: how many sensors agree, and how many do not."""

import pyarrow as pa
import pytest

from epipole.flows.night.doubt import Attempt, sides_of
from epipole.flows.night.stages import Checked
from epipole.schemas.rejects import Reason
from epipole.schemas.spans import Sensor
from epipole.tasks.algorithms.sensor_faults.fault_judgement import CLOCK, SOUND, Doubt
from epipole.tasks.check.check_sensors import SensorVerdict

WINDOW_NS = 30_000_000_000
WINDOWS = 20
SENSORS = ("A", "B", "C")


class Night:
    """Work and solved parts of one span: five tracklets a sensor, in a window or more.

    `left_out` are the windows, the last ones, of sensor C in which it agrees with no other.
    """

    def __init__(self, left_out):
        self.spans = [Sensor(number, name) for number, name in enumerate(SENSORS)]
        self.verdicts, self.left_out = [], left_out
        self.objects = self

    def all_spans(self):
        return ["span"]

    def holds(self, span):
        return True

    def read(self, span, name, columns):
        joined = [(0, WINDOWS), (1, WINDOWS), (2, WINDOWS - self.left_out)]
        rows = [(s, 0, n * WINDOW_NS - 1) for s, n in joined if n for _ in range(5)]
        return pa.table(dict(zip(columns, zip(*rows, strict=True), strict=True)))

    def of_blocks(self, span, name):
        n = self.left_out
        reasons = [Reason.SENSOR_DISAGREES.value] * n
        return (
            [pa.table({"reason": reasons, "sensor_id": ["C"] * n, "count": [5] * n})] if n else []
        )


def doubted(left_out, late=False):
    night = Night(left_out)
    cause = CLOCK if late else SOUND
    night.verdicts = [
        SensorVerdict(name, 0.0, 1.0, cause if name == "C" else SOUND) for name in SENSORS
    ]
    sides = sides_of(night, night, WINDOW_NS / 1e9)
    return Attempt(night, Checked(night, False, {}, Doubt()), sides).in_doubt()


@pytest.mark.parametrize(("left_out", "doubt"), [(0, False), (3, False), (11, True), (20, True)])
def test_a_sensor_disagrees_that_is_left_out_of_most_windows(left_out, doubt):
    """Two others that agree are too few then."""
    assert doubted(left_out) == doubt


def test_a_clock_needs_no_others_that_agree():
    assert not doubted(20, late=True)
