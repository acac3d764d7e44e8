"""The doctor: sound logs end with 0, mistakes with 1; a run writes the same checks."""

import json

import polars as pl
import pytest
from mcap.writer import Writer
from scenes.log_mistakes import MISTAKES, centroid_sigma, rewritten, starts_of_exposures

from epipole.flows import api
from epipole.flows.command_line.main import app
from epipole.flows.doctor import NOT_SHOWN, as_dict, doctor, lines
from epipole.flows.evaluate import evaluate
from epipole.flows.nightly import nightly
from epipole.io.datasets.dataset import night_reader, read_table
from epipole.io.logs.reader import read_log
from epipole.schemas.errors import LogError, LogWarning
from epipole.schemas.given_settings import with_assumptions
from epipole.schemas.log_checks import CheckVerdict
from epipole.schemas.settings import Settings
from epipole.tasks.report.night_facts import needs_look, read_night_facts

NIGHT = "2019-04-01"


@pytest.fixture(scope="module")
def wrong_log(night_log, tmp_path_factory):
    """Return the log with velocities of one sensor negated."""
    log = MISTAKES["velocities negated"][0](read_log(night_log), ["sat2"])
    return rewritten(log, tmp_path_factory.mktemp("wrong") / "wrong.mcap")


def run(*arguments):
    from typer.testing import CliRunner

    return CliRunner().invoke(app, [str(each) for each in arguments])


def test_a_sound_log_ends_with_0_and_says_what_is_not_shown(night_log):
    result = run("doctor", night_log)
    assert result.exit_code == 0
    assert result.output.endswith("no mistake found\n")
    assert all(each in result.output for each in NOT_SHOWN)


def test_a_mistake_ends_with_1_and_has_its_cure(wrong_log):
    result = run("doctor", wrong_log, "--json")
    found = json.loads(result.output)
    assert (result.exit_code, found["sound"]) == (1, False)
    (mistake,) = found["mistakes"]
    assert mistake.startswith("sat2: velocities point backwards along the path of positions; ")
    assert lines(doctor([str(wrong_log)]))[-1] == f"  {mistake}"


@pytest.mark.parametrize(
    ("mistake", "cure"),
    [
        ("positions in m", "position_unit=m"),
        ("velocities in m/s", "velocity_unit=m/s"),
        ("frames as GPS time", "frames_ahead_s=18"),
    ],
)
def test_a_log_that_is_read_as_it_was_meant_has_no_mistake(night_log, tmp_path, mistake, cure):
    log = rewritten(MISTAKES[mistake][0](read_log(night_log), ["sat2"]), tmp_path / "a.mcap")
    assert run("doctor", log).exit_code == 1
    assert run("doctor", log, "--assume", f"sat2.{cure}").exit_code == 0


def test_what_a_run_would_leave_out_ends_with_1(night_log, tmp_path):
    log, copy = api.read_log(night_log), tmp_path / "a.mcap"
    with pytest.warns(LogWarning, match="bad_exposure"):
        api.write_log(copy, log.frames.with_columns(exposure_s=-1.0), log.states, log.cameras)
    result = run("doctor", copy, "--json")
    found = json.loads(result.output)
    assert (result.exit_code, found["sound"], found["mistakes"]) == (1, False, [])
    (left_out,) = found["left_out"]
    assert left_out.startswith(f"{log.frames.height} bad_exposure: ")
    assert f"  {left_out}" in lines(doctor([str(copy)]))


def test_a_file_that_is_no_log_is_refused(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"x")
    with pytest.raises(LogError):
        doctor([str(tmp_path / "a.mcap")])


def test_logs_without_anything_are_refused(tmp_path):
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()
    with pytest.raises(LogError, match="neither frames nor states in these logs"):
        doctor([str(tmp_path / "a.mcap")])


def test_assumptions_on_sensors_that_logs_do_not_have_are_named(night_log):
    assumed = ("--assume", "sat9.time=gps", "--assume", "*.time=utc")
    says = "assumed of sat9, of which these logs have nothing: check the id"
    assert says in run("doctor", night_log, *assumed).output.splitlines()
    assert json.loads(run("doctor", night_log, *assumed, "--json").output)["assumed_in_vain"] == [
        "sat9"
    ]
    assert "assumed of" not in run("doctor", night_log, "--assume", "sat1.time=utc").output


def test_a_run_warns_of_assumptions_on_sensors_that_logs_do_not_have(
    prefect, night_log, tmp_path, caplog
):
    assume = [{"sensor": "sat9", "time": "gps"}, {"sensor": "*", "time": "utc"}]
    nightly([str(night_log)], str(tmp_path / "out"), Settings(sensors={"assume": assume}))
    assert ("`sensors.assume` names sat9, of which these logs have nothing: check the id"
            in caplog.messages)  # fmt: skip


def test_a_run_writes_the_same_checks_and_shows_mistakes(prefect, wrong_log, tmp_path, caplog):
    summary = nightly([str(wrong_log)], str(tmp_path / "out"))
    rows = read_table(str(tmp_path / "out"), "checks", NIGHT).to_pylist()
    # A night has several sensors, and stars.
    only_runs = ("lines_of_sight", "frames_all_night", "centroid_sigma")
    rows = [row for row in rows if row["check"] not in only_runs]
    key = ("sensor_id", "check")
    rows = sorted(rows, key=lambda row: [row[name] for name in key])
    alone = as_dict(doctor([str(wrong_log)]))
    alone["checks"] = [row for row in alone["checks"] if row["check"] not in only_runs]
    assert rows == sorted(alone["checks"], key=lambda row: [row[name] for name in key])
    assert summary.mistakes == alone["mistakes"]
    assert f"mistake     {summary.mistakes[0]}" in summary.lines()
    assert f"needs a look: {summary.mistakes[0]}" in summary.sentence()
    assert summary.mistakes[0] in caplog.messages
    rejects = read_table(str(tmp_path / "out"), "rejects", NIGHT).to_pylist()
    (unused,) = [row for row in rejects if row["reason"] == "wrong_velocity"]
    assert unused["sensor_id"] == "sat2"
    assert unused["count"] > 20
    facts = read_night_facts(night_reader(str(tmp_path / "out"), NIGHT), "out")
    assert needs_look(facts)[0].sentence == summary.mistakes[0]


@pytest.mark.parametrize(
    ("stated_px", "sentence"),
    [(1e-6, "stars scatter by 0.15 px, stated are 1e-06 px; "),
     (10.0, "stars scatter by only 0.15 px, stated are 10 px; ")],
)  # fmt: skip
def test_errors_of_centroids_that_stars_contradict_are_named_and_not_used(
    prefect, night_log, tmp_path, stated_px, sentence
):
    names = ["sat1", "sat2", "sat3", "sat4"]
    wrong = rewritten(
        centroid_sigma(stated_px)(read_log(night_log), names), tmp_path / "wrong.mcap"
    )
    summary = nightly([str(wrong)], str(tmp_path / "out"))
    (mistake,) = summary.mistakes
    assert mistake.startswith(f"{', '.join(names)}: {sentence}")
    assert (summary.identified, summary.objects) == (summary.frames, 9)
    assert evaluate(tmp_path / "out", night_log).nees_in_99 > 0.95


def test_the_doctor_says_which_sensor_has_no_calibration(night_log, tmp_path):
    log, copy = api.read_log(night_log), tmp_path / "a.mcap"
    with pytest.warns(LogWarning, match="sat1: 60 frames and no valid calibration"):
        api.write_log(copy, log.frames, log.states, log.cameras.filter(pl.col.sensor_id != "sat1"))
    result = run("doctor", copy)
    assert result.exit_code == 1
    assert "write the calibration that `epipole calibrate` finds" in result.output


def test_a_sound_night_has_no_wrong_check(night_dataset):
    verdicts = set(read_table(str(night_dataset), "checks", NIGHT)["verdict"].to_pylist())
    assert CheckVerdict.WRONG not in verdicts
    assert CheckVerdict.SOUND in verdicts


def test_a_run_names_the_reading_that_makes_lines_of_sight_meet(prefect, night_log, tmp_path):
    log = read_log(night_log)
    names = sorted(set(log.states["sensor_id"].to_pylist()))
    wrong = rewritten(MISTAKES["z negated"][0](log, names), tmp_path / "wrong.mcap")
    assert doctor([str(wrong)]).mistakes == []  # the states alone are an orbit
    summary = nightly([str(wrong)], str(tmp_path / "out"))
    (mistake,) = summary.mistakes
    assert mistake.startswith(f"{', '.join(names)}: ")
    assert "with the states' axes exchanged or negated" in mistake
    assert summary.positions == 0


def test_the_start_of_exposures_is_named_and_positions_carry_the_doubt(
    prefect, night_log, tmp_path
):
    log = read_log(night_log)
    wrong = rewritten(starts_of_exposures(1.0)(log, ["sat1", "sat2", "sat3", "sat4"]),
                      tmp_path / "wrong.mcap")  # fmt: skip
    assert doctor([str(wrong)]).mistakes == []
    summary = nightly([str(wrong)], str(tmp_path / "out"))
    (mistake,) = summary.mistakes
    assert mistake.startswith("sat1, sat2, sat3, sat4: times of frames are -0.49")
    assert mistake.endswith("write the middle of the exposure, or assume `frame_time` (`--assume`)")
    assert summary.verdicts == {"sensors_in_doubt": 9}
    # Without the doubt, none of the positions is within its ellipsoid.
    assert evaluate(tmp_path / "out", night_log).nees_in_99 > 0.95
    as_meant = with_assumptions(Settings(), ["*.frame_time=start"])
    summary = nightly([str(wrong)], str(tmp_path / "meant"), settings=as_meant)
    assert (summary.mistakes, summary.verdicts) == ([], {"sound": 9})
