"""Judged logs: mistakes of all sensors and of one are named by sensor, and none in sound logs."""

from pathlib import Path

import polars as pl
import pytest
from scenes.log_mistakes import EARTH_FIXED, MISTAKES, rewritten

from epipole.io.logs.reader import read_log
from epipole.schemas.bridge import from_polars, to_polars
from epipole.schemas.log_checks import LISTED, CheckVerdict, LogCause, LogCheck, mistakes
from epipole.tasks.algorithms.log_checks import findings
from epipole.tasks.algorithms.log_checks.findings import WRONG, Finding
from epipole.tasks.read import judge_sensor
from epipole.tasks.read.judge_logs import NightFrames
from epipole.tasks.read.judge_sensor import checks_table, judge_log, rows_by_sensor

ROOT = Path(__file__).parents[3]
SHARED = Path(__file__).resolve().parents[4] / "shared" / "data"
GAP_S = 10.0


def wrong(log):
    """Return the causes of the mistakes of each sensor in the content of a log."""
    found = {}
    for row in judge_log(log, GAP_S).to_pylist():
        causes = found.setdefault(row["sensor_id"], [])
        causes += [row["cause"]] if row["verdict"] == WRONG else []
    return found


@pytest.fixture(scope="module")
def sound():
    return read_log(ROOT / "examples" / "four_sensor_geo.mcap")


@pytest.fixture(scope="module", params=["inertial", "Earth-fixed"])
def log(request, sound):
    names = set(sound.states["sensor_id"].to_pylist())
    return EARTH_FIXED(sound, names) if request.param == "Earth-fixed" else sound


def test_a_sound_log_has_no_mistake(log):
    assert set(map(tuple, wrong(log).values())) == {()}


@pytest.mark.parametrize("who", [["sat1", "sat2", "sat3", "sat4"], ["sat2"]], ids=["all", "one"])
@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_named_in_the_sensors_that_have_it(name, who, sound):
    make, cause = MISTAKES[name]
    who_has = who[:1] if name == "two sensors with one id" else who
    found = wrong(make(sound, who))
    assert found == {n: [cause] if cause and n in who_has else [] for n in found}


@pytest.mark.parametrize("name", ["positions in m", "velocities zero", "velocities negated",
                                  "frames as GPS time", "principal point 0, 0"])  # fmt: skip
def test_a_mistake_is_named_in_earth_fixed_states_too(name, sound):
    make, cause = MISTAKES[name]
    names = sorted(set(sound.states["sensor_id"].to_pylist()))
    assert wrong(make(EARTH_FIXED(sound, names), names)) == {n: [cause] for n in names}


def test_states_beyond_the_bounds_are_named_by_what_was_left_out(sound, tmp_path):
    fast = rewritten(MISTAKES["velocities in m/s"][0](sound, ["sat2"]), tmp_path / "fast.mcap")
    found = wrong(read_log(fast))
    assert found == {"sat1": [], "sat2": ["velocities_too_fast"], "sat3": [], "sat4": []}


def test_a_change_to_larger_images_is_no_mistake(sound):
    changed = to_polars(sound.cameras)
    is_sat2 = pl.col("sensor_id") == "sat2"
    halves = [pl.col(n) // 2 for n in ("width", "height")]
    halves += [pl.col(n) / 2 for n in ("fx_px", "fy_px", "cx_px", "cy_px")]
    binned = changed.filter(is_sat2).with_columns(*halves)
    later = changed.with_columns(pl.when(is_sat2).then(pl.col("time").dt.offset_by("10s"))
                                 .otherwise(pl.col("time")).alias("time"))  # fmt: skip
    cameras = from_polars(sound.cameras.schema, pl.concat([binned, later]))
    assert set(map(tuple, wrong(sound._replace(cameras=cameras)).values())) == {()}


@pytest.mark.parametrize("folder", ["logs", "logs_real_orbits", "logs_constellation/patch"])
def test_no_mistake_is_named_in_logs_of_another_simulator(folder):
    logs = sorted((SHARED / folder).glob("*.mcap"))[:8]
    if not logs:
        pytest.skip("these logs are not here")
    for path in logs:
        assert set(map(tuple, wrong(read_log(path)).values())) == {()}, path


def test_all_checks_and_causes_are_declared_and_have_a_sentence(sound):
    names = {value for name, value in vars(findings).items()
             if name.isupper() and name not in ("SOUND", "WRONG", "UNKNOWN")}  # fmt: skip
    assert names == set(LogCheck)
    assert {findings.SOUND, findings.WRONG, findings.UNKNOWN} == set(CheckVerdict)
    facts = dict.fromkeys(("speed_km_s", "states", "jump_km", "count", "apart_km", "shift_s",
                           "lead_s", "trail_s", "cx_px", "cy_px", "width", "height", "x_px",
                           "y_px", "low", "high", "offset_s", "share_percent", "odds", "lost_s",
                           "length_s", "known", "tracklets", "as_written", "within_s",
                           "sigma_s", "exposure_s", "frames", "interval_s", "size", "size_sigma"),
                          3.0)  # fmt: skip
    rows = [Finding(LogCheck.VELOCITY, cause.verdict, 1.0, 2.0, 3.0, "", cause.value, facts)
            for cause in LogCause]  # fmt: skip
    for cause, row in zip(LogCause, checks_table({"a": rows}).to_pylist(), strict=True):
        assert (row["cause"], row["verdict"]) == (cause, cause.verdict)
        assert row["sentence"].endswith(cause.cure)
        assert "{" not in row["sentence"]


def test_one_sentence_names_the_sensors_of_a_mistake():
    found = [Finding(LogCheck.VELOCITY, WRONG, cause="velocities_negated")]
    checks = checks_table({f"s{k}": found for k in range(LISTED + 2)})
    (sentence,) = mistakes(checks.to_pylist())
    assert sentence.startswith("s0, s1, s2, s3 and 2 more: velocities point backwards")


def test_sensors_without_anything_have_no_rows():
    assert checks_table({}).num_rows == 0
    assert checks_table({"a": []}).num_rows == 0


def test_rows_of_all_sensors_are_found_in_one_pass(sound):
    rows = rows_by_sensor(sound.exposures)
    names = sound.exposures["sensor_id"].to_pylist()
    assert {name: k.tolist() for name, k in rows.items()} == {
        name: [k for k, each in enumerate(names) if each == name] for name in set(names)
    }
    assert rows_by_sensor(sound.exposures.slice(0, 0)) == {}


def test_the_columns_of_a_log_are_searched_once_and_not_per_sensor(sound, monkeypatch):
    calls = []
    monkeypatch.setattr(
        judge_sensor, "rows_by_sensor", lambda rows: calls.append(rows) or rows_by_sensor(rows)
    )
    assert judge_log(sound, GAP_S).num_rows
    assert len(calls) == 2


@pytest.mark.parametrize("n_sensors", [3, 24])
def test_the_times_of_one_sensor_make_no_gap_in_those_of_others(n_sensors):
    sound = [(1000 + k, 2000 + k) for k in range(n_sensors - 1)]
    for shift in (-500, 0, 500):
        night = NightFrames.of_most([(1000 + shift, 2000 + shift), *sound], 0.1)
        assert 1000 <= night.first_ns <= 1003
        assert 1996 <= night.last_ns <= 1000 + 1000 + n_sensors


def test_one_sensor_of_two_has_the_gap_where_the_other_has_frames():
    assert NightFrames.of_most([(0, 50), (0, 100)], 0.1)[:2] == (0, 100)
    assert NightFrames.of_most([(10, 50)], 0.1)[:2] == (10, 50)
    assert NightFrames.of_most([], 0.1)[:2] == (0, 0)
