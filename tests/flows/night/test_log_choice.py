"""The choice of logs: those of a night, whatever else lies in the folder."""

import datetime
from pathlib import Path
from unittest.mock import patch

import fsspec
import numpy as np
import prefect.runtime
import pytest
from prefect.exceptions import ParameterTypeError
from prefect.utilities.callables import parameter_schema
from prefect.utilities.schema_tools.validation import ValidationError, validate

from epipole.flows.night import log_choice
from epipole.flows.night.log_choice import find_logs, night_asked, nights_asked_before, run_name
from epipole.flows.nightly import nightly
from epipole.io.logs.writer import LogWriter
from epipole.schemas.errors import EpipoleError, LogError

MINUTE_NS = 60_000_000_000
HOUR_NS = 60 * MINUTE_NS


def instant(text: str) -> int:
    return int(np.datetime64(text, "ns").astype(np.int64))


def write_log(path: Path, start_ns: int, end_ns: int) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with LogWriter(path) as log:
        for k, t in enumerate((start_ns, end_ns)):
            log.frame("a", t, frame_number=k, exposure_s=0.1, x_px=[1.0], y_px=[2.0])
    return path


@pytest.fixture
def folder(tmp_path) -> Path:
    """Return a folder with a log every six hours of three days, the last of each over midnight."""
    folder = tmp_path / "logs"
    for day in (1, 2, 3):
        for hour in (1, 7, 13, 19):
            start_ns = instant(f"2019-04-0{day}T{hour:02}:00:00")
            write_log(folder / f"d{day}h{hour:02}.mcap", start_ns, start_ns + 6 * HOUR_NS - 1)
    return folder


def names(where, night) -> list[str]:
    return [Path(path).stem for path in find_logs(where, night).paths]


OF_THE_SECOND = ["d1h19", "d2h01", "d2h07", "d2h13", "d2h19"]


def test_the_logs_of_a_night_are_found_also_those_over_midnight(folder):
    assert names(str(folder), "2019-04-02") == OF_THE_SECOND
    assert len(names(str(folder), None)) == 12


@pytest.mark.parametrize("where", ["{}/*.mcap", "file://{}", "file://{}/d*.mcap", "memory://logs"])
def test_a_folder_a_glob_and_a_url_give_the_same_logs(where, folder):
    memory = fsspec.filesystem("memory")
    memory.put(str(folder), "/logs", recursive=True)
    try:
        assert names(where.format(folder), "2019-04-02") == OF_THE_SECOND
    finally:
        memory.rm("/logs", recursive=True)


@pytest.mark.parametrize("where", ["{}", "{}/**/*.mcap", "memory://logs", "file://{}"])
def test_logs_in_subfolders_are_found_however_deep(where, folder):
    write_log(folder / "sat9" / "2019" / "x.mcap", *[instant("2019-04-02T12:00:00")] * 2)
    (folder / "sat9" / "notes.txt").touch()
    memory = fsspec.filesystem("memory")
    memory.put(str(folder), "/logs", recursive=True)
    try:
        assert names(where.format(folder), "2019-04-02") == sorted([*OF_THE_SECOND, "x"])
    finally:
        memory.rm("/logs", recursive=True)


def test_logs_are_found_behind_links_and_each_folder_is_read_once(folder, tmp_path):
    elsewhere = tmp_path / "disk2" / "day"
    write_log(elsewhere / "x.mcap", *[instant("2019-04-02T12:00:00")] * 2)
    (folder / "more").symlink_to(elsewhere.parent)
    (folder / "again").symlink_to(elsewhere)
    (elsewhere / "round").symlink_to(folder)
    assert sorted(names(str(folder), "2019-04-02")) == sorted([*OF_THE_SECOND, "x"])


def test_a_log_that_is_named_twice_counts_once(folder):
    where = [str(folder), f"{folder}/*.mcap", str(folder / "d2h01.mcap")]
    assert names(where, "2019-04-02") == OF_THE_SECOND


def test_a_log_that_ends_close_to_midnight_may_have_frames_of_the_night(tmp_path):
    midnight_ns = instant("2019-04-02")
    for minutes in (5, 39, 41):
        end_ns = midnight_ns - minutes * MINUTE_NS
        write_log(tmp_path / f"before{minutes:02}.mcap", end_ns - HOUR_NS, end_ns)
        start_ns = midnight_ns + 24 * HOUR_NS + minutes * MINUTE_NS
        write_log(tmp_path / f"until{minutes:02}.mcap", start_ns, start_ns + HOUR_NS)
    assert names(str(tmp_path), "2019-04-02") == ["before05", "before39", "until05", "until39"]


def test_a_log_that_was_never_closed_is_taken_for_its_nights_or_for_every_one(
    tmp_path, monkeypatch
):
    start_ns = instant("2019-04-01T01:00")
    with LogWriter(tmp_path / "open.mcap", chunk_size=1, compression="none") as log:
        for k in range(9):
            log.frame("a", start_ns + k, frame_number=k, exposure_s=0.1, x_px=[1.0], y_px=[2.0])
    write_log(tmp_path / "other.mcap", *[instant("2019-04-03T12:00")] * 2)
    whole = (tmp_path / "open.mcap").read_bytes()
    (tmp_path / "open.mcap").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "begun.mcap").write_bytes(whole)
    real = log_choice.read_log_times
    monkeypatch.setattr(
        log_choice, "read_log_times", lambda path: None if "begun" in path else real(path)
    )
    assert names(str(tmp_path), "2019-04-01") == ["begun", "open"]
    assert names(str(tmp_path), "2019-04-03") == ["begun", "other"]


def test_a_log_that_is_named_itself_is_taken_whenever_it_was_logged(folder):
    where = [str(folder), str(folder / "d3h13.mcap")]
    assert names(where[1:], "2019-04-02") == ["d3h13"]
    assert names(where[::-1], "2019-04-02") == ["d3h13", *OF_THE_SECOND]
    assert names(where, "2019-04-02") == [*OF_THE_SECOND, "d3h13"]  # also if found before


def test_a_file_that_is_no_log_is_left_out_with_a_row_of_rejects(folder, caplog):
    (folder / "empty.mcap").touch()
    found = find_logs(str(folder), "2019-04-02")
    assert [Path(path).stem for path in found.paths] == OF_THE_SECOND
    (row,) = found.rejects.to_pylist()
    assert (row["source"], row["stage"], row["reason"], row["count"]) == (
        "empty.mcap", "read", "no_mcap", 1,
    )  # fmt: skip
    assert "empty.mcap: not an MCAP file" in caplog.text


def test_a_file_that_is_named_and_no_log_is_an_error(folder):
    (folder / "empty.mcap").touch()
    with pytest.raises(LogError, match=r"empty\.mcap: not an MCAP file"):
        find_logs(str(folder / "empty.mcap"), "2019-04-02")


def test_a_found_log_that_cannot_be_read_stops_the_night(folder, monkeypatch):
    def refused(path):
        if path.endswith("d1h01.mcap"):
            raise LogError(f"{path}: cannot be read: Input/output error") from OSError(5, "x")

    monkeypatch.setattr(log_choice, "read_log_times", refused)
    with pytest.raises(LogError, match=r"d1h01\.mcap: cannot be read"):
        find_logs(str(folder), "2019-04-02")


def test_a_night_without_logs_is_an_error_that_says_what_there_is(folder):
    with pytest.raises(
        LogError,
        match=r"logs: no frames on 2019-05-01 in these logs; they have 2019-04-01 to 2019-04-04",
    ):
        find_logs(str(folder), "2019-05-01")


@pytest.mark.parametrize(
    ("where", "says"),
    [
        ("{}/none.mcap", "no such file; check the path"),
        ("{}/*.bag", "no file matches; check the pattern"),
        ("{}/bare", r"no logs in this folder \(\*\.mcap\); check the path"),
        ("file://{}/none", "no such log, and no folder with logs"),
        ("memory://none", r"no such log, and no folder with logs \(\*\.mcap\); check the URL"),
        ("nostore://x", "cannot be read: .*nostore"),
    ],
)
def test_a_place_without_logs_is_an_error_that_names_it(where, says, folder):
    (folder / "bare").mkdir()
    with pytest.raises(LogError, match=says):
        find_logs(where.format(folder), None)


def test_a_folder_without_any_log_is_an_error(tmp_path):
    (tmp_path / "a.mcap").write_text("PNG")
    with pytest.raises(LogError, match="none of 1 files is an MCAP log"):
        find_logs(str(tmp_path), None)


WRONG = [
    ({"night": "tonight"}, "field 'night'.*'tonight' does not match"),
    ({"night": "2019-04-01/"}, "field 'night'.*'2019-04-01/' does not match"),
    ({"night": "2019-4-1"}, "field 'night'.*'2019-4-1' does not match"),
    ({"settings": {"sensors": {"state_gap": 1}}}, r"'settings\.sensors'.*'state_gap' was unexp"),
    ({"settings": {"sensors": {"state_gap_s": -1}}}, r"'settings\.sensors\.state_gap_s'.*-1 is"),
    ({"settings": {"sensor": {}}}, "field 'settings'.*'sensor' was unexpected"),
    ({"logs": 1}, "field 'logs'"),
]


@pytest.mark.parametrize(("wrong", "says"), WRONG)
def test_the_server_refuses_a_wrong_parameter_and_names_it(wrong, says):
    schema = parameter_schema(nightly).model_dump_for_openapi()
    right = {"logs": "/data/logs", "out": "/data/dataset", "night": "yesterday", "settings": {}}
    assert validate(right, schema, raise_on_error=True) == []
    with pytest.raises(ValidationError, match=says):
        validate(right | wrong, schema, raise_on_error=True)


@pytest.mark.parametrize(("wrong", "_"), WRONG)
def test_the_flow_refuses_it_too(wrong, _):
    with pytest.raises(ParameterTypeError):
        nightly.validate_parameters({"logs": "a", "out": "b"} | wrong)


def test_the_form_on_the_page_says_what_each_parameter_is():
    properties = parameter_schema(nightly).properties
    assert all("description" in properties[name] for name in ("logs", "out", "night", "replace"))


def test_yesterday_is_the_day_before_the_run_was_scheduled():
    due = datetime.datetime(2019, 4, 2, 6, tzinfo=datetime.UTC)
    with patch.object(prefect.runtime, "flow_run", DueAt(due, {"night": "yesterday"})):
        assert night_asked("yesterday") == "2019-04-01"
        assert run_name() == "night 2019-04-01"
    zone = datetime.timezone(datetime.timedelta(hours=9))
    with patch.object(
        prefect.runtime, "flow_run", DueAt(due.astimezone(zone), {"logs": "/data/logs"})
    ):
        assert night_asked("yesterday") == "2019-04-01"
        assert run_name() == "all nights of logs"


@pytest.mark.parametrize(
    ("logs", "name"),
    [
        ("/data/a.mcap", "a.mcap"), (["s3://b/logs/"], "logs"), (["a", "b"], "2 logs"), ("/", "/"),
        ("a\nb" * 40, ("a\\nb" * 40)[:60]),
    ],
)  # fmt: skip
def test_a_run_of_no_one_night_is_called_by_its_logs(logs, name):
    with patch.object(prefect.runtime, "flow_run", DueAt(None, {"logs": logs})):
        assert run_name().startswith(f"all nights of {name[:50]}")
        assert len(run_name()) < 90


class DueAt:
    def __init__(self, scheduled_start_time, parameters):
        self.scheduled_start_time = scheduled_start_time
        self.parameters = parameters


def test_a_range_of_nights():
    asked = "2019-03-30/2019-04-02"
    assert night_asked(asked) == "2019-04-02"
    before = ["2019-03-30", "2019-03-31", "2019-04-01"]
    assert nights_asked_before(asked, "2019-04-02", 9) == before
    assert nights_asked_before("yesterday", "2019-04-02", 4) == before
    assert nights_asked_before("2019-04-02", "2019-04-02", 4) == []
    assert nights_asked_before(None, None, 4) == []
    with patch.object(prefect.runtime, "flow_run", DueAt(None, {"night": asked})):
        assert run_name() == f"night {asked}"
    with pytest.raises(EpipoleError, match="2019-03-30 is before 2019-04-02; give the first"):
        night_asked("2019-04-02/2019-03-30")


def test_a_day_that_no_month_has_is_an_error_of_the_run():
    with pytest.raises(EpipoleError, match=r"night 2019-02-30: no such date; give one such as"):
        night_asked("2019-02-30")
    with patch.object(prefect.runtime, "flow_run", DueAt(None, {"night": "2019-02-30"})):
        assert run_name() == "night 2019-02-30"
