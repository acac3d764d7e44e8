"""`epipole nights`: which nights the settings of the next run would make otherwise."""

import json
import shutil

import pytest
from typer.testing import CliRunner

from epipole.flows.command_line.main import app


def nights(*arguments, code: int = 0):
    ended = CliRunner().invoke(app, ["nights", *map(str, arguments)])
    assert ended.exit_code == code, ended.output
    return ended


def stale(*arguments) -> list[list[str]]:
    return [row["stale"] for row in json.loads(nights(*arguments, "--json").stdout)["nights"]]


@pytest.fixture
def dataset(night_dataset, tmp_path):
    """Return a copy of the dataset of one night, without the records of what other tests ran."""
    return shutil.copytree(night_dataset, tmp_path / "out", ignore=shutil.ignore_patterns("runs"))


def test_logs_that_the_next_run_reads_otherwise_make_a_night_stale(dataset):
    assert stale(dataset) == [[]]
    assert stale(dataset, "--assume", "*.ahead_s=1") == [["other settings"]]


def test_settings_with_a_catalogue_that_is_missing_are_refused_in_one_line(night_dataset, tmp_path):
    (tmp_path / "s.toml").write_text('[identification]\ncatalogue = "gone.parquet"\n')
    ended = nights(night_dataset, "--settings", tmp_path / "s.toml", code=1)
    assert "gone.parquet: no such catalogue file" in ended.output


def test_decades_without_a_night_are_one_line(dataset):
    # A sensor whose clock was never set writes 1980, where GPS begins.
    shutil.copytree(dataset / "night=2019-04-01", dataset / "night=1980-01-06")
    shutil.copytree(dataset / "night=2019-04-01", dataset / "night=2019-04-04")
    shown = nights(dataset).stdout.splitlines()
    assert [line.split("  ")[0] for line in shown if line[:2] in ("19", "20")] == [
        "1980-01-06", "1980-01-07 to 2019-03-31", "2019-04-01", "2019-04-02", "2019-04-03",
        "2019-04-04",
    ]  # fmt: skip
