"""A short round of odd command lines, and those that were mended, one by one."""

import pytest
from typer.testing import CliRunner

from damage.odd_commands import fault_of, faults
from damage.sound_logs import EXAMPLE
from epipole.flows.command_line.main import app
from epipole.io.catalogues.element_sets import parse_element_sets
from epipole.schemas.errors import CatalogueError

pytestmark = pytest.mark.usefixtures("no_early_server")


def test_odd_command_lines_end_in_one_line(tmp_path):
    found = [(words, fault) for words, fault in faults(60, seed=11, folder=tmp_path) if fault]
    assert found == []


@pytest.mark.parametrize(
    "words",
    [
        *(["simulate", "four_sensor_geo", "--out", "a.mcap", "--start", f"{year}-01-01T00:00:00Z"]
          for year in ("0001", "1677", "2262", "9999")),
        ["simulate", "four_sensor_geo", "--out", "a.mcap", "--logs", "1000000000"],
        ["simulate", "/dev/zero", "--out", "a.mcap"],
        ["simulate", "a\0b", "--out", "a.mcap"],
        ["nights", "missing"], ["nights", "http://[::1"], ["nights", "."],
        ["nights", ".", "--settings", "/dev/zero"],
        ["info", "http://[::1"], ["info", "reference://"],
        ["run", "a.mcap", "--out", "x" * 5000], ["run", "a.mcap", "--out", "x/" * 2500],
        ["run", "a.mcap", "--out", "x" * 300],
        ["deploy-files", "--out", "x/" * 2500], ["deploy-files", "--out", "x" * 300],
        ["evaluate", ".", "--truth", "x" * 300],
        *(["overlay", "dataset", str(EXAMPLE), "--out", out] for out in ("", ".", "dataset")),
    ],
    ids=lambda words: " ".join(words)[:60],
)  # fmt: skip
def test_a_command_that_cannot_work_says_so_in_one_line(words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "stray").touch()
    (tmp_path / "dataset" / "night=2019-04-01" / "nights").mkdir(parents=True)
    assert fault_of(words) is None
    ended = CliRunner().invoke(app, words)
    assert ended.exit_code == 1, ended.stderr
    assert len(ended.stderr) < 1200


def test_a_wrong_truth_folder_is_told_what_one_is(tmp_path):
    ended = CliRunner().invoke(app, ["evaluate", "none", "--truth", str(tmp_path)])
    assert "frames.parquet, points.parquet, scenario.json missing" in ended.stderr
    assert "give the folder LOG.truth that `epipole simulate` writes" in ended.stderr


def test_half_a_surrogate_pair_in_a_name_is_replaced():
    fields = (
        '"NORAD_CAT_ID": 5, "EPOCH": "2019-04-01T00:00:00", "MEAN_MOTION": 1.0, "ECCENTRICITY": 0, '
        '"INCLINATION": 0, "RA_OF_ASC_NODE": 0, "ARG_OF_PERICENTER": 0, "MEAN_ANOMALY": 0, '
        '"BSTAR": 0, "MEAN_MOTION_DOT": 0, "MEAN_MOTION_DDOT": 0'
    )
    (found,), faults_ = parse_element_sets(f'[{{"OBJECT_NAME": "A\\ud800B", {fields}}}]'.encode())
    assert found.name.encode() == b"A?B"
    assert faults_ == []


def test_a_field_of_csv_that_is_longer_than_any_is_an_error_of_one_line():
    table = b"OBJECT_NAME,MEAN_MOTION\n" + b"x" * 131_073 + b",1\n"
    with pytest.raises(CatalogueError, match="not an OMM in CSV: field larger than field limit"):
        parse_element_sets(table)
