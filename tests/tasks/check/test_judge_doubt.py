"""Doubt: what is said of sensors that disagree, and of times that may be cut."""

import pytest

from epipole.tasks.algorithms.log_checks.findings import FRAME_TIMES, UNKNOWN, Finding
from epipole.tasks.algorithms.sensor_faults.fault_judgement import Doubt
from epipole.tasks.check.check_sensors import SensorVerdict
from epipole.tasks.check.judge_doubt import doubt_table, name_cut_times
from epipole.tasks.read.judge_sensor import checks_table

WHOLE = Finding(FRAME_TIMES, UNKNOWN, 1.0, expected=0.0, unit="s", cause="whole_times")


@pytest.mark.parametrize(
    ("shared_s", "exposures_s", "cause"),
    [
        (float("nan"), (1.0, 1.0), "sensors_in_doubt"),
        (-0.498, (1.0, 1.0), "exposure_start"),
        (0.505, (1.0, 1.0), "exposure_end"),
        (-0.4, (1.0, 1.0), "shared_offset"),
        (-0.498, (1.0, 0.5), "shared_offset"),
        (-0.041, (0.08, 0.08), "shared_offset"),
        (-0.498, (0.0, 0.0), "shared_offset"),
    ],
)
def test_an_offset_of_half_the_exposure_is_its_start_or_end(shared_s, exposures_s, cause):
    doubt = Doubt(shared_s=shared_s, shared_sigma_s=0.005)
    rows = doubt_table(doubt, 0.5, dict(zip("ab", exposures_s, strict=True))).to_pylist()
    assert [(row["sensor_id"], row["verdict"]) for row in rows] == [("a", "wrong"), ("b", "wrong")]
    assert {row["cause"] for row in rows} == {cause}


def test_whole_seconds_of_an_early_clock_are_cut():
    checks = checks_table({name: [WHOLE] for name in "abc"})
    clocks = [SensorVerdict("a", -0.58, 0.03, "clock"), SensorVerdict("b", 0.4, 0.03, "clock")]
    causes = {row["sensor_id"]: row["cause"] for row in name_cut_times(checks, clocks).to_pylist()}
    assert causes == {"a": "times_cut", "b": "whole_times", "c": "whole_times"}
    early = Doubt(shared_s=-0.6, shared_sigma_s=0.01)
    assert set(name_cut_times(checks, [], early)["cause"].to_pylist()) == {"times_cut"}
    assert name_cut_times(checks, []).equals(checks)
