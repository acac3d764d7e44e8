"""The command line: what it prints, and one clear line where it could not do its work."""

import errno
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from mcap.writer import Writer

from epipole.flows.command_line.main import main
from epipole.io.logs.writer import LogWriter
from epipole.io.settings_file import read_settings
from epipole.schemas.settings import Settings

START_NS = int(np.datetime64("2019-04-01T04:00:00", "ns").astype(np.int64))
EPIPOLE = [sys.executable, "-c", "from epipole.flows.command_line.main import main; main()"]


@pytest.fixture
def epipole(monkeypatch, capfd, tmp_path, no_early_server):
    """Return a function that runs a command line and gives (exit code, stdout, stderr)."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["epipole", *map(str, arguments)])
        capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            main()
        return ended.value.code or 0, *capfd.readouterr()

    return call


def one_line(err: str) -> str:
    """Return the line that says what is wrong; the lines of log before it are of stages."""
    lines = [line for line in err.splitlines() if not re.match(r"\d\d:\d\d:\d\d ", line)]
    assert len(lines) == 1, err
    assert lines[0].startswith("epipole: ")
    return lines[0]


def without_frames(path: Path) -> None:
    with LogWriter(path) as log:
        log.state("a", START_NS, position_km=[7000.0, 0.0, 0.0])


def of_unknown_encoding(path: Path) -> None:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("epipole.CentroidFrame", "flatbuffer", b"")
        channel = writer.register_channel("/a/centroids", "flatbuffer", schema)
        writer.add_message(channel, START_NS, b"123", START_NS)
        writer.finish()


def of_a_sensor_called(name: str):
    def write(path: Path) -> None:
        with LogWriter(path) as log:
            log.frame(name, START_NS, frame_number=1, exposure_s=0.1, x_px=[1.0], y_px=[2.0])

    return write


BAD_LOGS = {
    "a folder": (Path.mkdir, "no logs in this folder"),
    "empty": (Path.touch, "not an MCAP file"),
    "text": (lambda path: path.write_text("PNG"), "not an MCAP file"),
    "without frames": (without_frames, "no frames in these logs"),
    "of an unknown encoding": (of_unknown_encoding, "left out: unknown_encoding 1"),
    "of a sensor that leaves its folder": (of_a_sensor_called("../x"), "left out: bad_sensor_id 1"),
    "without calibration": (of_a_sensor_called("a"), "no sensor has a calibration"),
}


@pytest.mark.parametrize("kind", BAD_LOGS)
def test_a_log_that_cannot_be_used_is_one_line_and_nothing_is_written(
    kind, epipole, prefect, tmp_path
):
    write, says = BAD_LOGS[kind]
    write(tmp_path / "bad.mcap")
    code, out, err = epipole("run", "bad.mcap", "--out", "out")
    assert code == 1
    assert out == ""
    assert "bad.mcap" in one_line(err)
    assert says in one_line(err)
    assert [p.name for p in tmp_path.iterdir()] == ["bad.mcap"]


def test_a_missing_log_is_said_before_prefect_starts(epipole, tmp_path):
    code, _, err = epipole("run", "none.mcap", "--out", "out")
    assert (code, err) == (1, "epipole: none.mcap: no such file; check the path\n")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[sensors]\nstate_gap_s = -1", r"sensors\.state_gap_s = -1: .*greater than 0"),
        (
            "[sensors]\nstate_gap = 1",
            r"unknown setting sensors\.state_gap \(did you mean \w+\?\); `epipole",
        ),
        ("[sensors", "not TOML"),
    ],
)
def test_a_bad_setting_is_named(text, says, epipole, night_log, tmp_path):
    (tmp_path / "s.toml").write_text(text)
    code, _, err = epipole("run", night_log, "--out", "out", "--settings", "s.toml")
    assert code == 1
    assert re.search(rf"s\.toml: {says}", one_line(err))
    assert not (tmp_path / "out").exists()


def test_a_missing_settings_file_is_named(epipole, night_log):
    code, _, err = epipole("run", night_log, "--out", "out", "--settings", "none.toml")
    assert code == 1
    assert "none.toml: No such file" in one_line(err)


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_an_output_that_is_no_dataset_is_refused_and_left_alone(kind, epipole, night_log, tmp_path):
    if kind == "folder":
        (tmp_path / "out").mkdir()
    holiday = tmp_path / "out" / "holiday.jpg" if kind == "folder" else tmp_path / "out"
    holiday.write_text("sun")
    code, _, err = epipole("run", night_log, "--out", "out")
    assert code == 1
    assert "out: " in one_line(err)
    assert holiday.read_text() == "sun"


def test_an_output_that_cannot_be_written_is_one_line(epipole, night_log, prefect, tmp_path):
    (tmp_path / "file").touch()
    code, _, err = epipole("run", night_log, "--out", "file/out")
    assert code == 1
    assert "file/out: " in one_line(err)


@pytest.mark.parametrize("date", ["tonight", "2019-4-1", "20190401"])
def test_a_night_that_is_no_date_is_a_wrong_use(date, epipole, night_log):
    code, _, err = epipole("run", night_log, "--out", "out", "--night", date)
    assert code == 2
    assert "is not a date such as 2019-04-01" in " ".join(err.split())


def test_the_settings_it_prints_are_read_back_as_the_defaults(epipole, tmp_path):
    code, out, _ = epipole("settings")
    assert code == 0
    (tmp_path / "s.toml").write_text(out)
    assert read_settings(tmp_path / "s.toml") == Settings()
    for group in Settings.model_fields:
        assert f"[{group}]" in out


def test_a_run_ends_in_a_summary_on_standard_output(epipole, night_log, prefect, tmp_path):
    code, out, err = epipole("run", night_log, "--out", "out/")
    assert code == 0
    assert re.search(r"frames +240 of 4 sensors in 1 log\n", out)
    assert re.search(r"objects +9 in [\d,]+ detections, \d+ tracklets\n", out)
    assert re.search(r"dataset +out/\ntook +[\d.]+ s\n$", out)
    assert all(re.match(r"\d\d:\d\d:\d\d ", line) for line in err.splitlines())
    assert "published out/night=2019-04-01" in err


@pytest.mark.long
def test_a_quiet_run_says_nothing(epipole, night_log, prefect):
    assert epipole("run", night_log, "--out", "out", "--quiet") == (0, "", "")


def test_json_is_all_that_is_on_standard_output(epipole, night_log, prefect, tmp_path):
    code, out, _ = epipole("run", night_log, "--out", "out", "--json", "--quiet")
    found = json.loads(out)
    positions = pl.read_parquet(tmp_path / "out/night=*/positions/*.parquet")
    assert code == 0
    assert found["positions"] == len(positions)
    assert found["nights"] == ["2019-04-01"]
    assert found["seconds"] > 0


def test_info_says_what_a_log_holds(epipole, night_log):
    code, out, err = epipole("info", night_log)
    assert (code, err) == (0, "")
    assert out.count("frames       60 at 1 Hz, 2019-04-01T04:00:") == 4
    assert out.count("calibration  512 x 512 px, 2.0 x 2.0 deg") == 4
    assert epipole("info", night_log.parent, night_log)[1] == out  # each log once


def test_info_shows_the_other_logs_of_a_folder_with_a_broken_file(epipole, night_log, tmp_path):
    folder = tmp_path / "logs"
    folder.mkdir()
    (folder / "broken.mcap").write_bytes(b"not a log")
    (folder / "night.mcap").symlink_to(night_log)
    code, out, err = epipole("info", "logs")
    assert (code, err) == (1, "")
    assert "broken.mcap: not an MCAP file" in out
    assert out.count("frames       60 at 1 Hz") == 4
    code, out, _ = epipole("info", "logs", "--json")
    assert [("error" in log, len(log.get("sensors", []))) for log in json.loads(out)] == [
        (True, 0), (False, 4),
    ]  # fmt: skip
    code, out, err = epipole("info", "logs", "logs/broken.mcap")  # named: a mistake
    assert (code, out) == (1, "")
    assert "broken.mcap: not an MCAP file" in err


def test_info_says_what_cannot_be_used(epipole, tmp_path):
    with LogWriter(tmp_path / "n.mcap") as log:
        for k, x in enumerate([[1.0], [np.nan]]):
            log.frame("a", START_NS + k, frame_number=k, exposure_s=0.1, x_px=x, y_px=[2.0])
    _, out, _ = epipole("info", "n.mcap")
    assert "states       none in this log; frames without any give no positions" in out
    assert "calibration  none in this log; a run leaves a sensor without any out" in out
    assert re.search(r"left out: 1 \w+ of a", out)
    _, as_json, _ = epipole("info", "n.mcap", "--json")
    assert json.loads(as_json)[0]["sensors"][0]["frames"] == 1


def test_info_shows_a_log_that_has_calibrations_alone(epipole, tmp_path):
    # Recorders that write frames, states and calibrations to separate files are usual.
    with LogWriter(tmp_path / "n.mcap") as log:
        camera = dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), 0.0)
        camera |= {"width": 512, "height": 256, "fx_px": 1e3, "fy_px": 1e3}
        log.camera("a", START_NS, camera | {"cx_px": 255.5, "cy_px": 127.5})
    _, out, _ = epipole("info", "n.mcap")
    assert "  a\n    frames       0\n" in out
    assert "calibration  512 x 256 px" in out


def test_simulate_writes_a_constellation_to_a_folder(epipole):
    options = ("--satellites", "2", "--near", "--objects", "50", "--seconds", "2", "--seed", "3")
    code, out, _ = epipole("simulate", "constellation", "--out", "logs", *options)
    assert code == 0
    assert re.search(r"log +logs \(2 logs\)\n", out)
    assert "4 sensors, 52 objects" in out
    assert sorted(p.name for p in Path("logs").iterdir()) == ["s001.mcap", "s002.mcap"]
    again = ("--satellites", "2", "--hours", "1", "--seconds", "2")
    code, _, err = epipole("simulate", "constellation", "--out", "other", *again)
    assert code == 1
    assert one_line(err) == "epipole: give hours or seconds, not both"


def test_simulate_writes_the_log_and_says_so(epipole, tmp_path):
    code, out, _ = epipole("simulate", "four_sensor_geo", "--out", "a.mcap", "--seed", "5")
    assert code == 0
    assert "4 sensors, 9 objects, 240 frames" in out
    epipole("simulate", "four_sensor_geo", "--out", "b.mcap", "--seed", "5")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_an_unknown_scene_is_one_line(epipole, tmp_path):
    code, _, err = epipole("simulate", "five_sensor_geo", "--out", "a.mcap")
    assert code == 1
    assert "five_sensor_geo" in one_line(err)
    assert list(tmp_path.iterdir()) == []


def test_help_and_version_need_neither_prefect_nor_arrow():
    code = (
        "import sys; sys.argv = ['epipole', sys.argv[1]]\n"
        "from epipole.flows.command_line.main import main\n"
        "try: main()\n"
        "except SystemExit as e: assert not e.code\n"
        "assert not {'prefect', 'pyarrow', 'numpy', 'numba'} & set(sys.modules)\n"
    )
    for flag in ("--help", "--version"):
        ran = subprocess.run([sys.executable, "-c", code, flag], capture_output=True, text=True)
        assert ran.returncode == 0, ran.stderr
        assert "epipole" in ran.stdout


@pytest.mark.long
def test_a_run_by_itself_leaves_nothing_of_its_libraries_on_the_terminal(night_log, tmp_path):
    ran = subprocess.run(
        [*EPIPOLE, "run", str(night_log), "--out", str(tmp_path / "out")],
        capture_output=True, text=True, cwd=tmp_path,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.startswith("nights      2019-04-01\n")
    assert all(re.match(r"\d\d:\d\d:\d\d ", line) for line in ran.stderr.splitlines()), ran.stderr


@pytest.mark.long
@pytest.mark.parametrize(
    ("by", "says"), [(signal.SIGINT, "interrupted"), (signal.SIGTERM, "stopped")]
)
def test_a_run_that_is_stopped_says_so_and_leaves_nothing_half_written(
    night_log, tmp_path, by, says
):
    run = subprocess.Popen(
        [*EPIPOLE, "run", str(night_log), "--out", "out"], cwd=tmp_path, text=True,
        stderr=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip
    lines = [run.stderr.readline()]  # the first stage has ended: Prefect runs
    os.killpg(run.pid, by)  # to its server too, as a terminal does
    lines += run.stderr.readlines()
    assert run.wait(timeout=60) == 128 + by
    assert one_line("".join(lines)) == f"epipole: {says}"
    time.sleep(0.1)
    assert left_unfinished(tmp_path) == []


def left_unfinished(folder: Path) -> list[str]:
    """Return what a stopped run left that is no finished part, which the next run reuses."""
    parts = re.compile(r"out(/\.staging(/work-[^/.]*(/[^.][^/]*)*)?)?")
    left = sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))
    return [path for path in left if not parts.fullmatch(path)]


def test_the_dataset_of_an_evaluation_may_be_a_url(epipole, s3, night_log):
    for _ in range(2):
        code, _, err = epipole("evaluate", "s3://nights/none", "--truth", night_log)
        assert code == 1
        assert "s3://nights/none: no dataset here" in one_line(err)


@pytest.mark.parametrize("name", ["", "\udcff"], ids=["empty", "not UTF-8"])
@pytest.mark.parametrize(
    "command",
    [
        ("info",),
        ("calibrate",),
        ("run", "--out", "out"),
        ("run", "log.mcap", "--out"),
        ("simulate", "four_sensor_geo", "--out"),
        ("catalog", "build", "hipparcos", "--out"),
    ],
    ids=" ".join,
)
def test_a_name_that_cannot_be_used_is_one_line(command, name, epipole, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = epipole(*command, name)
    assert (code, out) == (1, "")
    assert ("is empty" if not name else "is not UTF-8") in one_line(err)
    assert list(tmp_path.iterdir()) == []


def test_export_says_what_it_wrote(epipole, night_dataset, tmp_path):
    night = "2019-04-01"
    command = ("export", "opm", night_dataset, "--night", night, "--out")
    code, out, err = epipole(*command, "a")
    assert (code, err) == (0, "")
    assert out.startswith("folder  a\nfiles   ")
    _, as_json, _ = epipole(*command, "b", "--json")
    assert json.loads(as_json)["files"] == sorted(p.name for p in (tmp_path / "b").iterdir())
    code, _, err = epipole(*command, "b")
    assert (code, err.count("\n")) == (1, 1)


def test_an_unchanged_night_is_found_without_prefect():
    # Prefect takes two seconds to import: more than all else that such a run does.
    code = (
        "import sys; import epipole.flows.command_line.run_nightly\n"
        "assert 'prefect' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_file_in_a_folder_that_may_not_be_entered_is_one_line(epipole, night_log, monkeypatch):
    def refuse(where):  # as Path.is_file does, for all users but root
        raise PermissionError(errno.EACCES, "Permission denied", where)

    monkeypatch.setattr("epipole.io.catalogues.element_sets._bytes_of", refuse)
    code, out, err = epipole("run", night_log, "--out", "out", "--known", "closed/a.tle")
    assert (code, out) == (1, "")
    assert "closed/a.tle: may not be read or written" in one_line(err)
