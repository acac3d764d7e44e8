"""Only folders that nobody else can write to are trusted; temporary ones are private."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from scenes.busy_folder import busy

from epipole.io.caches import kernels
from epipole.io.caches.arrays import cache_folder, cached
from epipole.io.caches.kernels import HANDED_ON, kernel_folder, use_kernel_cache
from epipole.io.caches.private_folders import fault_of, private_folder, temporary_folder
from epipole.io.work.folder import work_root
from epipole.schemas.errors import EpipoleError

ARRAYS = {"a": np.arange(3)}


@pytest.fixture(autouse=True)
def no_kernel_cache(monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.setenv(HANDED_ON, "")
    monkeypatch.setattr(kernels, "_folder", None)


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """Return the cache folder that the user has named; it exists and only he may write to it."""
    folder = tmp_path / "cache"
    folder.mkdir(mode=0o700)
    monkeypatch.setenv("EPIPOLE_CACHE", str(folder))
    return folder


def give_away(path: Path) -> None:
    if os.geteuid():
        pytest.skip("only root can give a file to another user")
    os.chown(path, 65534, 65534)


def is_private(path: Path) -> bool:
    return path.stat().st_mode & 0o077 == 0


def test_a_private_folder_is_private_and_new_in_each_process():
    folder = private_folder("test")
    assert is_private(folder)
    assert private_folder("test") == folder
    code = "from epipole.io.caches.private_folders import private_folder as p; print(p('test'))"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    other = Path(ran.stdout.strip())
    assert other != folder
    assert not other.exists()  # removed as its process ended


@pytest.mark.parametrize("mode", [0o770, 0o707, 0o777])
def test_a_cache_that_others_can_write_to_is_not_used(mode, folder, caplog):
    folder.chmod(mode)
    used = cache_folder()
    assert used != folder
    assert is_private(used)
    assert cache_folder() == used  # said once
    (line,) = caplog.messages
    assert line.startswith(f"{folder}: no cache here (other users can write to it): ")
    assert list(folder.iterdir()) == []


def test_a_cache_of_another_user_is_not_used(folder):
    give_away(folder)
    assert fault_of(folder) == "belongs to another user"
    assert cache_folder() != folder


def test_a_new_cache_is_private_whatever_the_umask(folder):
    old = os.umask(0)
    try:
        folder.rmdir()
        assert cache_folder() == folder
        use_kernel_cache()
    finally:
        os.umask(old)
    kept = kernel_folder()
    assert all(map(is_private, (folder, kept)))


def test_kernels_that_another_user_has_left_are_not_run(folder, monkeypatch, caplog):
    use_kernel_cache()
    kept = kernel_folder()
    assert kept == folder / "kernels"
    (kept / "planted.nbi").touch()
    give_away(kept / "planted.nbi")
    monkeypatch.setenv(HANDED_ON, "")
    use_kernel_cache()
    assert kernel_folder() == private_folder("kernels")
    assert "has files of another user" in caplog.text


def test_a_kernel_folder_in_which_another_run_writes_is_used(folder):
    (folder / "kernels").mkdir(mode=0o700)
    with busy(folder / "kernels"):
        for _ in range(500):
            assert kernels._trusted(folder / "kernels") == folder / "kernels"


def test_a_kernel_folder_that_others_can_write_to_is_not_used(folder, monkeypatch):
    (folder / "kernels").mkdir()
    (folder / "kernels").chmod(0o777)
    use_kernel_cache()
    assert kernel_folder() == private_folder("kernels")


def test_arrays_that_another_user_has_left_are_made_again(folder):
    cached("key", lambda: {"a": np.zeros(3)})
    give_away(folder / "key.npz")
    np.testing.assert_array_equal(cached("key", lambda: ARRAYS)["a"], ARRAYS["a"])


@pytest.mark.parametrize("cache", ["off", "on"])
def test_work_folders_of_stores_are_private(cache, folder, monkeypatch):
    if cache == "off":
        monkeypatch.setenv("EPIPOLE_CACHE", "off")
    root = work_root("s3://nights/dataset")
    assert is_private(root.parent)
    assert root.is_relative_to(folder if cache == "on" else private_folder("work"))


def ran(**environment: str) -> subprocess.CompletedProcess[str]:
    """Return how a process ends that imports kernels: numba looks for a folder then."""
    kept = {k: v for k, v in os.environ.items() if k not in ("EPIPOLE_CACHE", "XDG_CACHE_HOME")}
    code = (
        "import epipole.tasks, os\n"
        "import epipole.io.logs.messages.scan\n"
        f"print(os.environ.get({HANDED_ON!r}))\n"
    )
    kept |= {"NUMBA_CACHE_DIR": "", HANDED_ON: ""}
    return subprocess.run(
        [sys.executable, "-c", code], env=kept | environment,
        capture_output=True, text=True,
    )  # fmt: skip


def test_without_a_writable_home_one_line_says_so(tmp_path):
    (tmp_path / "home").touch()
    run = ran(HOME=str(tmp_path / "home"))
    assert run.returncode == 0, run.stderr
    (line,) = run.stderr.splitlines()
    assert line.startswith(f"{tmp_path}/home/.cache/epipole: no cache here (Not a directory): ")
    assert not Path(run.stdout.strip()).exists()  # nothing is left behind


def test_without_a_cache_kernels_are_temporary(monkeypatch):
    monkeypatch.setenv("EPIPOLE_CACHE", "off")
    use_kernel_cache()
    assert kernel_folder() == private_folder("kernels")


MAKE = """
import sys
from epipole.io.caches.private_folders import private_folder, temporary_folder
with temporary_folder("night") as folder:
    print(folder, private_folder("work"), flush=True)
    sys.stdin.read()
"""


def making(folder: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", MAKE], env=os.environ | {"TMPDIR": str(folder)},
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip


def test_temporary_folders_of_a_killed_process_are_removed_by_the_next_one(tmp_path):
    with making(tmp_path) as killed:
        assert len(killed.stdout.readline().split()) == 2
        killed.kill()
    assert len(list(tmp_path.iterdir())) == 2
    with making(tmp_path) as living, making(tmp_path) as other:
        theirs = {path for run in (living, other) for path in run.stdout.readline().split()}
        assert {str(path) for path in tmp_path.iterdir()} == theirs
        living.communicate()
        other.communicate()
    assert list(tmp_path.iterdir()) == []


def test_without_a_place_for_temporary_folders_one_line_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "missing"))
    with pytest.raises(EpipoleError, match=r"no temporary folder can be made .*set TMPDIR"):
        private_folder("nowhere")


def test_a_kernel_folder_of_the_user_that_cannot_be_written_is_not_used(folder, monkeypatch):
    (folder / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder / "file"))
    use_kernel_cache()
    assert kernel_folder() == folder / "kernels"


def test_a_run_whose_kernel_folder_cannot_be_written_says_so_in_one_line(tmp_path):
    (tmp_path / "file").touch()
    run = ran(NUMBA_CACHE_DIR=str(tmp_path / "file"), EPIPOLE_CACHE=str(tmp_path / "cache"))
    assert run.returncode == 0, run.stderr
    (line,) = run.stderr.splitlines()
    assert line == f"NUMBA_CACHE_DIR={tmp_path}/file: kernels are not kept here (File exists)"
    assert run.stdout.strip() == f"{tmp_path}/cache/kernels"


def test_a_temporary_folder_that_another_process_removes_at_once_is_made_anew(monkeypatch):
    made, mkdtemp = [], tempfile.mkdtemp

    def make(prefix):
        made.append(mkdtemp(prefix=prefix))
        if len(made) == 1:
            os.rmdir(made[0])
        return made[-1]

    monkeypatch.setattr(tempfile, "mkdtemp", make)
    with temporary_folder("test") as folder:
        assert str(folder) == made[1]
        assert folder.is_dir()
