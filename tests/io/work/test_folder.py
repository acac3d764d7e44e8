"""Unfinished work: that of stopped runs, never that of a run that goes on."""

import contextlib
import shutil
from pathlib import Path

import pytest
from scenes.busy_folder import N_FILES, busy

from epipole.io.datasets.dataset import lock_nights
from epipole.io.work.folder import clear_unfinished, unfinished_work, work_root
from epipole.schemas.errors import DatasetError

NIGHT, NEXT = "2019-04-01", "2019-04-02"


def leave_work(dataset, night, key="0123456789abcdef", size=5):
    folder = dataset / ".staging" / f"work-{night}-{key}"
    folder.mkdir(parents=True)
    (folder / "part").write_bytes(b"x" * size)
    return folder


def test_work_is_counted_by_night(tmp_path):
    leave_work(tmp_path, NIGHT)
    leave_work(tmp_path, NIGHT, "f" * 16, size=2)
    leave_work(tmp_path, NEXT)
    found = [(each.night, each.size) for each in unfinished_work(str(tmp_path))]
    assert found == [(NIGHT, 7), (NEXT, 5)]


def test_work_of_a_run_that_goes_on_is_left_alone(tmp_path):
    mine, left = leave_work(tmp_path, NIGHT), leave_work(tmp_path, NEXT)
    with lock_nights(str(tmp_path), [NIGHT]):
        assert [each.night for each in clear_unfinished(str(tmp_path))] == [NEXT]
        assert mine.exists()
        assert not left.exists()


def test_a_dataset_without_work_has_none(tmp_path):
    assert unfinished_work(str(tmp_path / "none")) == []
    assert clear_unfinished(str(tmp_path / "none")) == []
    assert not (tmp_path / "none").exists()


def test_work_of_a_run_that_begins_or_ends_meanwhile_stops_nothing(tmp_path):
    left = leave_work(tmp_path, NIGHT)
    with busy(left):
        for _ in range(500):
            (found,) = unfinished_work(str(tmp_path))
            assert 5 <= found.size <= 5 + N_FILES


def test_work_that_cannot_be_removed_is_not_said_to_be(tmp_path, monkeypatch):
    left = leave_work(tmp_path, NIGHT)
    rmtree = shutil.rmtree

    def refuse(folder, **options):  # as the files of another user
        if Path(folder) != left:
            rmtree(folder, **options)

    monkeypatch.setattr(shutil, "rmtree", refuse)
    with pytest.raises(DatasetError, match=f"{left.name}: cannot be removed"):
        clear_unfinished(str(tmp_path))


def test_a_dataset_that_cannot_be_written_is_not_one_without_work(tmp_path, monkeypatch):
    leave_work(tmp_path, NIGHT)

    @contextlib.contextmanager
    def refuse(dataset, nights):
        raise DatasetError(f"{dataset}: cannot be written (Permission denied)")
        yield

    monkeypatch.setattr("epipole.io.work.folder.lock_nights", refuse)
    with pytest.raises(DatasetError, match="cannot be written"):
        clear_unfinished(str(tmp_path))


def test_a_url_with_a_slash_at_its_end_is_the_same_dataset(tmp_path, monkeypatch):
    monkeypatch.setenv("EPIPOLE_CACHE", str(tmp_path / "cache"))
    assert work_root("memory://nights/ds/") == work_root("memory://nights/ds")
