"""The nights of a dataset: what each holds, and why a run would make it otherwise."""

import json
import shutil

import pytest
from typer.testing import CliRunner

from epipole.flows.command_line.main import app
from epipole.flows.night.recorded_nights import published_nights
from epipole.io.work import recipe
from epipole.schemas.given_settings import validate_settings
from epipole.schemas.settings import Settings

NIGHT, NEXT = "2019-04-01", "2019-04-02"


@pytest.fixture
def dataset(night_dataset, tmp_path):
    """Return a dataset that a test may change."""
    return shutil.copytree(night_dataset, tmp_path / "out")


def stale(dataset, settings=None, known=None) -> dict[str, list[str]]:
    held = published_nights(str(dataset), settings or Settings(), known)
    return {night.date: night.stale for night in held}


def test_a_night_just_made_is_not_stale_and_tells_what_it_holds(night_dataset):
    (night,) = published_nights(str(night_dataset), Settings(), None)
    assert night.stale == []
    assert (night.row["logs"], night.row["sensors"], night.row["objects"]) == (1, 4, 9)
    assert night.row["frames"] == night.row["identified"] == 240
    assert night.row["faults"] == []


def test_what_differs_is_named(night_dataset, monkeypatch):
    other = validate_settings({"tracklets": {"gate_sigma": 5.0}}, "test")
    assert stale(night_dataset, other) == {NIGHT: ["other settings"]}
    assert stale(night_dataset, known="f00") == {NIGHT: ["another catalogue of known objects"]}
    monkeypatch.setattr(recipe, "code_key", lambda: "other")
    assert stale(night_dataset) == {NIGHT: ["other code"]}


def test_a_night_is_stale_whose_night_before_was_made_since(dataset):
    shutil.copytree(dataset / f"night={NIGHT}", dataset / f"night={NEXT}")
    assert stale(dataset) == {NIGHT: [], NEXT: ["another night before"]}


def test_an_old_a_damaged_and_an_incomplete_night_are_stale(dataset):
    for name in ("2020-01-01", "2021-01-01", "2022-01-01"):
        shutil.copytree(dataset / f"night={NIGHT}", dataset / f"night={name}")
    shutil.rmtree(dataset / "night=2020-01-01/nights")
    (dataset / "night=2021-01-01/nights/part-0.parquet").write_bytes(b"not parquet")
    shutil.rmtree(dataset / "night=2022-01-01/pairs")
    found = stale(dataset)
    assert found["2020-01-01"] == ["an older version"]
    assert "cannot be read" in found["2021-01-01"][0]
    assert found["2022-01-01"] == ["no table pairs"]


def nights(*arguments) -> str:
    ended = CliRunner().invoke(app, ["nights", *map(str, arguments)])
    assert ended.exit_code == 0, ended.output
    return ended.stdout


def test_the_command_shows_a_line_per_night_that_fits_a_terminal(dataset):
    shutil.copytree(dataset / f"night={NIGHT}", dataset / f"night={NEXT}")
    lines = nights(dataset).splitlines()
    assert lines[0].split() == ["night", "frames", "stars", "objects", "positions", "left", "out"]
    assert lines[1].split()[:6] == [NIGHT, "240", "100.0", "%", "9", lines[1].split()[5]]
    assert lines[2].endswith("stale: another night before")
    assert max(map(len, lines)) <= 100
    assert nights(dataset, "--stale").splitlines()[1:] == lines[2:]
    told = json.loads(nights(dataset, "--json"))
    assert [night["night"] for night in told["nights"]] == [NIGHT, NEXT]


def test_the_command_says_where_there_is_nothing(dataset, tmp_path):
    (tmp_path / "empty").mkdir()
    assert nights(tmp_path / "empty") == "no nights\n"
    missing = CliRunner().invoke(app, ["nights", str(tmp_path / "none")])
    assert missing.exit_code == 1
    assert missing.output.endswith("none: no such folder; check the path\n")
    assert nights(dataset, "--stale") == "no night is stale\n"


def test_unfinished_work_is_told_and_can_be_removed(dataset):
    work = dataset / ".staging" / f"work-{NEXT}-0123456789abcdef"
    work.mkdir(parents=True)
    (work / "part").write_bytes(b"x" * (3 << 20))
    assert nights(dataset).splitlines()[-1].startswith(f"{NEXT}  3 MiB of a stopped run: unfinish")
    assert nights(dataset, "--clear").splitlines()[-1].endswith("removed")
    assert not (dataset / ".staging").exists()
    assert "stopped run" not in nights(dataset)
