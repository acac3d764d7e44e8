"""Names of logs and datasets that cannot be used are refused in one line."""

import errno
import os

import pytest

from epipole.io.datasets.dataset import check_folder
from epipole.io.logs.listing import list_logs
from epipole.io.logs.reader import read_log
from epipole.schemas.errors import DatasetError, LogError


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("", "is empty"),
        (" ", "is empty"),
        ("a\0", "zero"),
        ("\udcff", "UTF-8"),
        ("a\ud800", "UTF-8"),
    ],
)
def test_a_name_that_cannot_be_used_is_refused(name, why, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(LogError, match=f"the name .*{why}"):
        list_logs(name)
    with pytest.raises(DatasetError, match=f"the name .*{why}"):
        check_folder(name)


def test_a_log_in_a_folder_whose_name_is_not_utf_8_is_named(tmp_path):
    (tmp_path / "good.mcap").touch()
    (tmp_path / os.fsdecode(b"\xff.mcap")).touch()
    with pytest.raises(LogError, match="the name is not UTF-8; rename it"):
        list_logs(str(tmp_path))


def test_a_named_pipe_is_not_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe.mcap")
    with pytest.raises(LogError, match="is a pipe or a device, not a file"):
        list_logs(str(tmp_path / "pipe.mcap"))
    with pytest.raises(LogError, match="is a pipe or a device, not a file"):
        read_log(tmp_path / "pipe.mcap")
    with pytest.raises(LogError, match="no logs in this folder"):
        list_logs(str(tmp_path))


def test_an_output_of_an_unknown_kind_is_one_line():
    with pytest.raises(DatasetError, match=r"^foo://x: cannot be read: Protocol not known: foo$"):
        check_folder("foo://x")


def test_a_folder_among_the_logs_that_cannot_be_read_is_named(tmp_path, monkeypatch, caplog):
    for name in ("open", "closed"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.mcap").touch()
    scandir = os.scandir

    def refuse(folder):
        if str(folder).endswith("closed"):
            raise PermissionError(errno.EACCES, "Permission denied", str(folder))
        return scandir(folder)

    monkeypatch.setattr(os, "scandir", refuse)
    assert list_logs(str(tmp_path)) == ([str(tmp_path / "open" / "a.mcap")], False)
    assert f"{tmp_path}/closed: left out: cannot be read: Permission denied" in caplog.text
