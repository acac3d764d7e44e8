"""The choice of logs: those of a night, whatever else lies in the folder."""

from pathlib import Path

import fsspec
import numpy as np
import pytest

from epipole.flows.night import log_choice
from epipole.flows.night.log_choice import find_logs
from epipole.io.logs.writer import LogWriter
from epipole.schemas.errors import LogError

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


def test_a_log_that_was_never_closed_is_taken_for_every_night(folder):
    whole = (folder / "d1h01.mcap").read_bytes()
    (folder / "open.mcap").write_bytes(whole[: len(whole) // 2])
    assert "open" in names(str(folder), "2019-04-03")


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
