"""Runs of a night that has not changed: it is not made again, unless that is asked for."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from epipole.flows.command_line.main import app
from epipole.flows.nightly import nightly

NIGHT = "2019-04-01"

pytestmark = pytest.mark.usefixtures("prefect", "no_early_server")


def state(folder: Path) -> dict[str, tuple[int, bytes]]:
    """Return the files of a dataset but for the records of its runs."""
    files = [f for f in folder.rglob("*") if f.is_file() and f.parent.name != "runs"]
    return {str(p.relative_to(folder)): (p.stat().st_ino, p.read_bytes()) for p in files}


def run(*arguments) -> tuple[int, str]:
    ended = CliRunner().invoke(app, ["run", *map(str, arguments)])
    return ended.exit_code, ended.stdout


@pytest.mark.long
def test_a_run_tells_what_an_unchanged_night_holds_and_writes_nothing(night_run, night_log):
    out, first = night_run
    before = state(out)
    second = nightly([str(night_log)], str(out))
    assert state(out) == before
    assert second.unchanged
    assert second.as_dict() | {"unchanged": False} == first.as_dict()


@pytest.mark.long
def test_a_run_that_is_asked_to_makes_the_same_night_again(night_log, tmp_path):
    out = tmp_path / "out"
    first = nightly([str(night_log)], str(out))
    before = state(out)
    again = nightly([str(night_log)], str(out), again=True)
    after = state(out)
    assert again == first
    assert {name: data for name, (_, data) in after.items()} == {
        name: data for name, (_, data) in before.items()
    }
    assert all(after[name][0] != before[name][0] for name in after)


def test_the_command_line_knows_it_before_prefect_is_there(night_run, night_log, monkeypatch):
    import epipole.flows.command_line.run_nightly as started

    def fail(*_):
        raise AssertionError("Prefect was started")

    monkeypatch.setattr(started.Nights, "_start", fail)
    code, text = run(night_log, "--out", night_run[0], "--quiet", "--json")
    told = json.loads(text)
    assert code == 0
    assert told["unchanged"]
    assert told["positions"] == night_run[1].positions


def test_a_range_of_nights_tells_how_each_ended(night_run, night_log, monkeypatch):
    arguments = (night_log, "--out", night_run[0], "--night", "2019-03-31", "--to", "2019-04-01")
    code, text = run(*arguments)
    assert code == 0
    assert text.splitlines() == [
        "2019-03-31  no frames", "2019-04-01  unchanged", "1 without frames, 1 unchanged",
    ]  # fmt: skip
    code, text = run(*arguments, "--quiet", "--json")
    assert [night["outcome"] for night in json.loads(text)] == ["without frames", "unchanged"]


@pytest.fixture
def fail_first(monkeypatch):
    """Return a function after which 2019-03-31 fails with an error."""
    import epipole.flows.command_line.run_nightly as started

    real = started.unchanged_nights

    def fail_with(error):
        def fail(dataset, given, night, *rest):
            if night == "2019-03-31":
                raise error
            return real(dataset, given, night, *rest)

        monkeypatch.setattr(started, "unchanged_nights", fail)

    return fail_with


def test_a_night_that_fails_does_not_stop_the_next(night_run, night_log, fail_first):
    from epipole.schemas.errors import DatasetError

    fail_first(DatasetError("the disk is full"))
    code, text = run(night_log, "--out", night_run[0], "--night", "2019-03-31", "--to", NIGHT)
    assert code == 1
    assert text.splitlines() == [
        "2019-03-31  failed: the disk is full", "2019-04-01  unchanged", "1 failed, 1 unchanged",
    ]  # fmt: skip


def test_an_unforeseen_error_of_a_night_does_not_stop_the_next_either(
    night_run, night_log, fail_first, monkeypatch
):
    import epipole.flows.command_line.run_nightly as started

    fail_first(RuntimeError("a bug"))
    code, text = run(night_log, "--out", night_run[0], "--night", "2019-03-31", "--to", NIGHT)
    assert code == 1
    assert text.splitlines() == [
        "2019-03-31  failed: a bug", "2019-04-01  unchanged", "1 failed, 1 unchanged",
    ]  # fmt: skip
    monkeypatch.setattr(started, "is_stopping", lambda: True)  # as an error that Ctrl-C has made
    code, text = run(night_log, "--out", night_run[0], "--night", "2019-03-31", "--to", NIGHT)
    assert (code, text) == (1, "")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--to", NIGHT], "give the first night"),
        (["--night", NIGHT, "--to", "2019-03-31"], "is before"),
        (["--night", NIGHT, "--to", "tomorrow"], "is not a date"),
        (["--night", NIGHT, "--stale"], "it chooses the nights"),
        (["--night", NIGHT, "--last-nights", "2"], "give it with --night yesterday"),
        (["--last-nights", "2"], "give it with --night yesterday"),
    ],
)
def test_a_range_that_is_none_is_refused(night_log, tmp_path, options, says):
    ended = CliRunner().invoke(app, ["run", str(night_log), "--out", str(tmp_path), *options])
    assert ended.exit_code == 2
    assert says in ended.output


def test_stale_nights_are_made_again_and_others_are_not(night_run, night_log):
    code, text = run(night_log, "--out", night_run[0], "--stale")
    assert (code, text.splitlines()) == (0, ["no night"])
