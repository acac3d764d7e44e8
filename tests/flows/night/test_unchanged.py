"""Unchanged nights: recognised where nothing has changed, and only there."""

import shutil

import pytest

from epipole.flows.night.log_choice import FoundLogs, find_logs
from epipole.flows.night.recorded_nights import unchanged_nights
from epipole.io.work import recipe
from epipole.schemas.given_settings import validate_settings
from epipole.schemas.settings import Settings

NIGHT = "2019-04-01"
OTHER = validate_settings({"tracklets": {"gate_sigma": 5.0}}, "test")


def found(dataset, *logs, night=None, settings=None, known=None) -> list[str]:
    given = find_logs([str(log) for log in logs], night)
    return unchanged_nights(str(dataset), given, night, settings or Settings(), known)


@pytest.fixture
def dataset(night_dataset, tmp_path):
    """Return a dataset that a test may change."""
    return shutil.copytree(night_dataset, tmp_path / "out")


@pytest.mark.parametrize("night", [None, NIGHT])
def test_a_night_of_the_same_logs_is_unchanged(night_log, night_dataset, night):
    assert found(night_dataset, night_log, night=night) == [NIGHT]


def test_a_second_copy_of_a_log_changes_nothing(night_log, night_dataset, tmp_path):
    copy = shutil.copy(night_log, tmp_path / "z.mcap")  # sorts behind the other name
    assert found(night_dataset, night_log, copy) == [NIGHT]


def test_the_logs_of_a_night_are_chosen_once_however_many_there_are(night_log, night_dataset):
    asked = []

    class Counted(FoundLogs):
        def of(self, night):
            asked.append(night)
            return super().of(night)

    given = Counted([str(night_log)] * 50, find_logs(str(night_log), None).rejects)
    assert unchanged_nights(str(night_dataset), given, None, Settings(), None) == [NIGHT]
    assert len(asked) <= 2


def test_other_logs_are_a_change(night_log, dataset, tmp_path):
    renamed = shutil.copy(night_log, tmp_path / "renamed.mcap")
    assert found(dataset, renamed) == []
    other = tmp_path / night_log.name
    data = bytearray(night_log.read_bytes())
    data[len(data) // 2] ^= 1
    other.write_bytes(data)
    assert found(dataset, other) == []
    more = tmp_path / "more.mcap"
    more.write_bytes(data)
    assert found(dataset, night_log, more) == []


def test_files_that_give_nothing_are_no_change(night_log, night_dataset, tmp_path):
    (tmp_path / "empty.mcap").touch()
    shutil.copy(night_log, tmp_path)
    given = find_logs(str(tmp_path), NIGHT)
    assert given.rejects["source"].to_pylist() == ["empty.mcap"]
    assert unchanged_nights(str(night_dataset), given, NIGHT, Settings(), None) == [NIGHT]


def test_other_settings_or_catalogues_are_a_change(night_log, night_dataset):
    assert found(night_dataset, night_log, settings=OTHER) == []
    assert found(night_dataset, night_log, known="f00") == []


def test_other_code_is_a_change(night_log, night_dataset, monkeypatch):
    monkeypatch.setattr(recipe, "code_key", lambda: "other")
    assert found(night_dataset, night_log) == []


def test_another_night_before_is_a_change(night_log, dataset):
    shutil.copytree(dataset / f"night={NIGHT}", dataset / "night=2019-03-31")
    assert found(dataset, night_log, night=NIGHT) == []


def test_a_night_long_before_or_after_is_none(night_log, dataset):
    for other in ("2018-04-01", "2019-04-02"):
        shutil.copytree(dataset / f"night={NIGHT}", dataset / f"night={other}")
    assert found(dataset, night_log, night=NIGHT) == [NIGHT]


@pytest.mark.parametrize("table", ["nights", "positions", "rejects"])
def test_a_night_without_one_of_its_tables_is_made_again(night_log, dataset, table):
    shutil.rmtree(dataset / f"night={NIGHT}" / table)
    assert found(dataset, night_log) == []


def test_a_damaged_night_is_made_again(night_log, dataset):
    (dataset / f"night={NIGHT}/nights/part-0.parquet").write_bytes(b"not parquet")
    assert found(dataset, night_log) == []


def test_nothing_is_unchanged_in_a_dataset_that_is_not_there(night_log, tmp_path):
    assert found(tmp_path / "none", night_log) == []
    assert found(tmp_path / "none", night_log, night=NIGHT) == []
