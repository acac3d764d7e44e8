"""`epipole nights`: which nights the settings of the next run would make otherwise."""

import json

from typer.testing import CliRunner

from epipole.flows.command_line.main import app


def nights(*arguments, code: int = 0):
    ended = CliRunner().invoke(app, ["nights", *map(str, arguments)])
    assert ended.exit_code == code, ended.output
    return ended


def stale(*arguments) -> list[list[str]]:
    return [row["stale"] for row in json.loads(nights(*arguments, "--json").stdout)["nights"]]


def test_logs_that_the_next_run_reads_otherwise_make_a_night_stale(night_dataset):
    assert stale(night_dataset) == [[]]
    assert stale(night_dataset, "--assume", "*.ahead_s=1") == [["other settings"]]


def test_settings_with_a_catalogue_that_is_missing_are_refused_in_one_line(night_dataset, tmp_path):
    (tmp_path / "s.toml").write_text('[identification]\ncatalogue = "gone.parquet"\n')
    ended = nights(night_dataset, "--settings", tmp_path / "s.toml", code=1)
    assert "gone.parquet: no such catalogue file" in ended.output
