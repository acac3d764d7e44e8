"""Doubt: what is said of sensors that disagree, and of times that may be cut."""

import pytest

from epipole.io.work.work_layout import AddedErrors
from epipole.schemas.log_checks import mistakes
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.log_checks.findings import FRAME_TIMES, UNKNOWN, Finding
from epipole.tasks.algorithms.sensor_faults.fault_judgement import Doubt
from epipole.tasks.check.check_sensors import SensorVerdict
from epipole.tasks.check.judge_doubt import doubt_table, fault_table, name_cut_times
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


def test_faults_have_a_sentence_each():
    verdicts = [
        SensorVerdict("a", 0.2, 0.01, "clock"),
        SensorVerdict("b", 0.0, 0.01, "ephemeris", 3.0, 0.1, (3.0, 0.0, 0.0), 0.2),
        SensorVerdict("c", 0.0, 0.01, "ephemeris", 5.0, 0.1, (0.0, 5.0, 0.0), 0.3),
        SensorVerdict("d", 0.0, 0.01, "attitude", 60 * ARCSEC, ARCSEC, (0, 0, 0), 2 * ARCSEC),
        SensorVerdict("e", 0.0, 0.01),
        SensorVerdict("f", 0.3, 0.01, "clock", corrected=True),
    ]
    faults = tuple(one.fault() for one in verdicts[:4])
    assert [fault.km for fault in faults] == pytest.approx([1.522, 2.126, 3.542, 0.0], rel=1e-3)
    assert [fault.bias_km for fault in faults[1:3]] == [(3.0, 0.0, 0.0), (0.0, 5.0, 0.0)]
    rows = fault_table(verdicts, AddedErrors(faults=faults)).to_pylist()
    assert [row["sensor_id"] for row in rows] == ["a", "b", "c", "d", "f"]
    assert [row["unit"] for row in rows] == ["km", "km", "km", "arcsec", "km"]
    assert [row["value"] for row in rows] == pytest.approx([1.522, 0.2, 0.3, 2.0, 0.076], rel=1e-3)
    clock, b, c, attitude, corrected = mistakes(rows)
    assert "a: lines of sight meet those of other sensors if its clock is +0.200 s" in clock
    assert "its ephemeris is 3.00 km" in b
    assert "its ephemeris is 5.00 km" in c
    assert "its prior attitudes are 60.0 arcsec (sigma 1.0 arcsec) off" in attitude
    assert "+0.300 s (sigma 0.010 s) off: 0.076 km of it per axis are left" in corrected


def test_a_fault_of_unknown_kind_or_too_large_has_no_error():
    assert SensorVerdict("a", 0.0, 0.01, "disagrees").fault() is None
    assert SensorVerdict("a", 0.0, 0.01, "ephemeris", 20.0, 0.1).fault() is None
    assert SensorVerdict("a", 2.0, 0.01, "clock").fault() is None
    assert SensorVerdict("a", 0.2, 0.01, "clock", corrected=True).fault() is None
    assert SensorVerdict("a", 0.0, 0.01).fault() is None


def test_whole_seconds_of_an_early_clock_are_cut():
    checks = checks_table({name: [WHOLE] for name in "abc"})
    clocks = [SensorVerdict("a", -0.58, 0.03, "clock"), SensorVerdict("b", 0.4, 0.03, "clock")]
    causes = {row["sensor_id"]: row["cause"] for row in name_cut_times(checks, clocks).to_pylist()}
    assert causes == {"a": "times_cut", "b": "whole_times", "c": "whole_times"}
    early = Doubt(shared_s=-0.6, shared_sigma_s=0.01)
    assert set(name_cut_times(checks, [], early)["cause"].to_pylist()) == {"times_cut"}
    assert name_cut_times(checks, []).equals(checks)
