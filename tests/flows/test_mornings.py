"""What an operator meets in the morning: logs that are empty, open or late, and sensors missing."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from epipole.flows.command_line.main import app
from epipole.flows.night.log_choice import find_logs
from epipole.flows.night.recorded_nights import unchanged_nights
from epipole.flows.night.stages import read
from epipole.flows.nightly import make_nights, nightly
from epipole.io.datasets.dataset import read_table
from epipole.io.logs.writer import LogWriter
from epipole.schemas.given_settings import validate_settings

DAYS = ("2019-04-01", "2019-04-02")
SECOND_NS = 1_000_000_000
OPTICS = {
    "width": 512, "height": 512, "fx_px": 14666.0, "fy_px": 14666.0, "cx_px": 255.5,
    "cy_px": 255.5, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0,
}  # fmt: skip
PLAIN = validate_settings({"report": {"write": False}}, "test")

pytestmark = pytest.mark.usefixtures("prefect")


def write_log(path: Path, day: str, n_frames: int = 10, **others: int) -> Path:
    """Write a log of sensors without stars, from four in the morning, a chunk for each frame.

    `others` are sensors beside `a`, with their numbers of frames.
    """
    start_ns = int(np.datetime64(f"{day}T04:00", "ns").astype(np.int64))
    with LogWriter(path, chunk_size=1, compression="none") as log:
        for sensor, count in {"a": n_frames, **others}.items():
            log.camera(sensor, start_ns, OPTICS)
            for k in range(count):
                t = start_ns + k * SECOND_NS
                log.frame(sensor, t, frame_number=k, exposure_s=0.1, x_px=[1.0], y_px=[2.0])
    return path


def unchanged(folder: Path, out: Path, day: str | None) -> list[str]:
    return unchanged_nights(str(out), find_logs(str(folder), day), day, PLAIN, None)


def sources(out: Path, day: str) -> list[str]:
    return read_table(out, "sources", day, ["name"])["name"].to_pylist()


def test_logs_that_give_nothing_are_on_no_night_and_open_ones_on_their_own(tmp_path):
    folder, out = tmp_path / "logs", tmp_path / "out"
    folder.mkdir()
    write_log(folder / "first.mcap", DAYS[0])
    whole = write_log(tmp_path / "second.mcap", DAYS[1]).read_bytes()
    (folder / "second.mcap").write_bytes(whole[: len(whole) // 2])  # still written
    with LogWriter(folder / "nothing.mcap"):
        pass
    (folder / "broken.mcap").touch()
    for day in DAYS:
        nightly(str(folder), str(out), PLAIN, night=day)
    assert [sources(out, day) for day in DAYS] == [["first.mcap"], ["second.mcap"]]
    for day in DAYS:
        rejects = read_table(out, "rejects", day).to_pylist()
        found = {row["source"]: row["reason"] for row in rejects if row["stage"] == "read"}
        assert found.items() >= {"nothing.mcap": "nothing_read", "broken.mcap": "no_mcap"}.items()
        assert unchanged(folder, out, day) == [day]
    assert unchanged(folder, out, None) == list(DAYS)

    (folder / "second.mcap").write_bytes(whole)
    assert [unchanged(folder, out, day) for day in DAYS] == [[DAYS[0]], []]
    nightly(str(folder), str(out), PLAIN, night=DAYS[1])  # not refused: the log has grown
    assert read_table(out, "frames", DAYS[1]).num_rows == 10

    for name in ("nothing.mcap", "broken.mcap"):  # moved away
        (folder / name).unlink()
    assert unchanged(folder, out, None) == list(DAYS)
    shutil.copy(folder / "second.mcap", folder / "z.mcap")
    assert unchanged(folder, out, None) == list(DAYS)  # a copy adds nothing


def test_a_log_whose_copy_is_complete_only_after_it_was_read_makes_its_night_again(
    tmp_path, monkeypatch
):
    folder, out = tmp_path / "logs", tmp_path / "out"
    folder.mkdir()
    log = folder / "a.mcap"
    with LogWriter(tmp_path / "whole.mcap", chunk_size=1, compression="none") as two_days:
        for day in DAYS:
            start_ns = int(np.datetime64(f"{day}T04:00", "ns").astype(np.int64))
            two_days.camera("a", start_ns, OPTICS)
            for k in range(10):
                t, centroid = start_ns + k * SECOND_NS, {"x_px": [1.0], "y_px": [2.0]}
                two_days.frame("a", t, frame_number=k, exposure_s=0.1, **centroid)
    whole = (tmp_path / "whole.mcap").read_bytes()
    log.write_bytes(whole[: len(whole) // 4])

    def read_before_the_rest_came(*given):
        frames = read(*given)
        log.write_bytes(whole)
        return frames

    monkeypatch.setattr("epipole.flows.nightly.read", read_before_the_rest_came)
    nightly(str(folder), str(out), PLAIN, night=DAYS[0])
    assert read_table(out, "frames", DAYS[0]).num_rows < 10
    assert unchanged(folder, out, DAYS[0]) == []
    monkeypatch.undo()
    nightly(str(folder), str(out), PLAIN, night=DAYS[0])
    assert read_table(out, "frames", DAYS[0]).num_rows == 10
    assert unchanged(folder, out, DAYS[0]) == [DAYS[0]]


def test_late_logs_make_their_nights_again_in_order(tmp_path, monkeypatch, no_early_server):
    folder, out = tmp_path / "logs", tmp_path / "out"
    folder.mkdir()
    write_log(folder / "second.mcap", DAYS[1])

    def morning():
        with monkeypatch.context() as patched:
            patched.setattr("epipole.flows.nightly.night_asked", lambda night: DAYS[1])
            return nightly(str(folder), str(out), PLAIN, night="yesterday")

    assert morning().earlier == ()  # there is no log of the day before
    write_log(folder / "first.mcap", DAYS[0])
    late = morning()
    assert [sentence[:16] for sentence in late.earlier] == [f"{DAYS[0]} made:"]
    assert not late.unchanged  # the night before is another one
    again = morning()
    assert again.unchanged
    assert again.earlier == ()

    write_log(folder / "more.mcap", DAYS[0], 15)
    settings = tmp_path / "settings.toml"
    settings.write_text("[report]\nwrite = false\n")
    asked = ["run", str(folder), "--out", str(out), "--settings", str(settings)]
    ended = CliRunner().invoke(app, [*asked, "--stale"])
    assert [line[:10] for line in ended.stdout.splitlines()] == [*DAYS, "2 made"]
    ended = CliRunner().invoke(app, [*asked, "--stale"])
    assert ended.stdout.splitlines() == ["no night"]
    ended = CliRunner().invoke(app, [*asked, "--night", "yesterday", "--last-nights", "2"])
    assert ended.stdout.splitlines()[-1] == "2 without frames"


def test_a_night_whose_logs_cannot_be_read_is_recorded_as_failed_by_the_command_too(tmp_path):
    log, out = write_log(tmp_path / "a.mcap", DAYS[0]), tmp_path / "out"
    nightly(str(log), str(out), PLAIN, night=DAYS[0])
    wrong = tmp_path / "b.mcap"
    wrong.write_text("no log")
    asked = ["run", str(log), str(wrong), "--out", str(out), "--night", DAYS[0], "--to", DAYS[1]]
    assert CliRunner().invoke(app, asked).exit_code == 1
    nights = json.loads(CliRunner().invoke(app, ["nights", str(out), "--json"]).stdout)["nights"]
    assert {row["night"]: row["state"] for row in nights} == dict.fromkeys(DAYS, "failed")
    assert all("b.mcap: not an MCAP file" in row["message"] for row in nights)


def test_a_range_of_nights_is_made_in_order_and_again_if_asked(tmp_path):
    folder, out = tmp_path / "logs", tmp_path / "out"
    folder.mkdir()
    days = [f"2019-04-{day:02}" for day in (28, 29, 30)]
    for day in (days[0], days[2]):
        write_log(folder / f"{day}.mcap", day)
    asked = {
        "logs": str(folder),
        "out": str(out),
        "settings": PLAIN,
        "night": "2019-04-28/2019-04-30",
    }
    summary = nightly(**asked)
    assert (summary.nights, summary.unchanged) == ([days[2]], False)
    assert [sentence[:16] for sentence in summary.earlier] == [f"{days[0]} made:"]
    assert (same := nightly(**asked)).unchanged
    assert same.earlier == ()
    anew = nightly(**asked, again=True)
    assert not anew.unchanged
    assert [sentence[:16] for sentence in anew.earlier] == [f"{days[0]} made:"]

    (folder / f"{days[0]}.mcap").unlink()  # a night that fails stops no other
    write_log(folder / "other.mcap", days[0], 3)
    failed = nightly(**asked)
    assert failed.unchanged
    assert failed.earlier[0].startswith(f"{days[0]} failed: ")


def test_what_is_wrong_with_a_night_before_does_not_stop_the_one_asked_for(tmp_path, monkeypatch):
    folder, out = tmp_path / "logs", tmp_path / "out"
    folder.mkdir()
    for day in DAYS:
        write_log(folder / f"{day}.mcap", day)
        nightly(str(folder), str(out), PLAIN, night=day)
    (folder / f"{DAYS[0]}.mcap").unlink()
    write_log(folder / "other.mcap", DAYS[0], 3)
    monkeypatch.setattr("epipole.flows.nightly.waiting_nights", lambda: {DAYS[0], "2019-05-01"})
    summary = nightly(str(folder), str(out), PLAIN, night=DAYS[1])
    assert summary.unchanged
    (sentence,) = summary.earlier
    assert f"was also made from {DAYS[0]}.mcap" in sentence


def test_an_unforeseen_error_of_a_night_before_does_not_stop_the_one_asked_for(
    tmp_path, monkeypatch
):
    folder, out = tmp_path / "logs", tmp_path / "out"
    folder.mkdir()
    for day in DAYS:
        write_log(folder / f"{day}.mcap", day)

    def broken(order, night):
        if night == DAYS[0]:
            raise ZeroDivisionError("unforeseen")
        return make_nights(order, night)

    monkeypatch.setattr("epipole.flows.nightly.make_nights", broken)
    asked = f"{DAYS[0]}/{DAYS[1]}"
    summary = nightly(str(folder), str(out), PLAIN, night=asked)
    assert summary.nights == [DAYS[1]]
    assert summary.earlier == (f"{DAYS[0]} failed: unforeseen",)


def test_sensors_that_are_absent_or_stop_early_are_named(tmp_path):
    folder, out = tmp_path / "logs", tmp_path / "out"
    folder.mkdir()
    write_log(folder / "first.mcap", DAYS[0], 60, b=60, c=58)
    write_log(folder / "second.mcap", DAYS[1], 60, b=30)
    first, second = (nightly(str(folder), str(out), PLAIN, night=day) for day in DAYS)
    assert [s for s in first.mistakes if "no frames" in s] == []
    assert [s for s in second.mistakes if "no frames" in s] == [
        "b: no frames for 30 s of the 59 s of the night, the longest time from 04:00:29 to "
        "04:00:59 UTC",
        "c: no frames in the whole night",
    ]
    (row,) = read_table(out, "nights", DAYS[1]).to_pylist()
    assert row["sensor_ids"] == ["a", "b"]
    assert unchanged(folder, out, DAYS[1]) == [DAYS[1]]
    told = validate_settings({"sensors": {"expected": ["a", "d"], "max_gaps": 1.0}}, "test")
    third = nightly(str(folder), str(out), told, night=DAYS[1])
    assert [s for s in third.mistakes if "no frames" in s] == ["d: no frames in the whole night"]
