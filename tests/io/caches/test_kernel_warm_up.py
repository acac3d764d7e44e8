"""A first run has a second process compile kernels, and is none the worse for it."""

import subprocess
import sys
import time

import pytest

from epipole.io.caches import kernel_warm_up
from epipole.io.caches.kernel_warm_up import (
    compile_beside,
    compile_kernels,
    report_compiling,
)
from epipole.io.caches.kernels import new_kernel_folder, only_one


class Helper:
    """A process that works until it is stopped."""

    def __init__(self, command, **pipes):
        self.process = subprocess.Popen(
            [sys.executable, "-c", "import sys; sys.stdin.read()"], stdin=subprocess.PIPE
        )
        self.kill, self.communicate = self.process.kill, self.process.communicate


@pytest.fixture
def folder(tmp_path, monkeypatch):
    folder = tmp_path / "kernels" / "0123"
    folder.mkdir(parents=True)
    monkeypatch.setenv("EPIPOLE_CACHE", str(tmp_path))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder))
    return folder


@pytest.fixture
def started(folder, monkeypatch):
    """Return the list of processes that were started."""
    started = []

    def start(*arguments, **options):
        started.append(Helper(*arguments, **options))
        return started[-1]

    monkeypatch.setattr(kernel_warm_up.os, "cpu_count", lambda: 2)
    monkeypatch.setattr(kernel_warm_up, "Popen", start)
    return started


def test_only_the_first_run_that_ends_well_has_a_helper(started):
    for _ in range(3):
        with compile_beside():
            pass
    assert len(started) == 1


def test_the_helper_ends_with_the_run_also_where_that_fails(started, folder):
    def run():
        with compile_beside() as compiling:
            assert compiling
            assert started[0].process.poll() is None
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run()
    assert started[0].process.poll() is not None
    assert new_kernel_folder() == folder  # the next run has one again


def test_the_helper_ends_when_the_process_that_started_it_is_gone():
    module = "epipole.io.caches.kernel_warm_up"
    code = f"from {module} import _end_with_parent; _end_with_parent(); exit(9)"
    helper = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE)
    helper.communicate(timeout=60)
    assert helper.returncode == 0


def test_one_cpu_or_no_second_process_leaves_all_to_the_run(started, monkeypatch):
    monkeypatch.setattr(kernel_warm_up.os, "cpu_count", lambda: 1)
    with compile_beside() as compiling:
        assert compiling
    assert not started


def test_a_process_that_cannot_be_started_does_not_stop_the_run(folder, monkeypatch):
    def refuse(*arguments, **options):
        raise OSError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(kernel_warm_up.os, "cpu_count", lambda: 2)
    monkeypatch.setattr(kernel_warm_up, "Popen", refuse)
    with compile_beside() as compiling:
        assert compiling


def test_a_folder_of_the_users_own_or_none_at_all_is_left_alone(started, monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "mine"))
    with compile_beside() as compiling:
        assert not compiling
    monkeypatch.setenv("EPIPOLE_CACHE", "off")
    with compile_beside() as compiling:
        assert not compiling
    assert not started


def test_two_first_runs_at_once_have_one_helper_at_work(folder):
    with only_one(folder) as first, only_one(folder) as second:
        assert first
        assert not second
    with only_one(folder) as again:
        assert again


def test_a_kernel_that_cannot_be_compiled_is_left_to_the_run(monkeypatch):
    from epipole.io.caches import kernel_list

    compiled = []

    class Kernel:
        compile = compiled.append

    listed = [("good:one", ["int64"]), ("no.such:kernel", ["int64"])]
    monkeypatch.setattr(kernel_list, "read_kernels", lambda: listed)
    there = {"good:one": Kernel}
    monkeypatch.setattr(kernel_list, "kernel", lambda name: there[name])
    compile_kernels()
    assert [tuple(map(str, types)) for types in compiled] == [("int64",)]


def test_what_is_compiled_is_counted_from_the_files_that_appear(folder, monkeypatch):
    monkeypatch.setattr(kernel_warm_up, "LOOKED_EVERY_S", 0.01)

    def counted(is_first: bool) -> list[tuple[int, int]]:
        told = []
        with report_compiling(lambda *count: told.append(count), is_first):
            (folder / "some").mkdir(exist_ok=True)
            (folder / "some" / f"{len(list(folder.glob('*/*')))}.nbi").touch()
            while not told:
                time.sleep(0.01)
        return told

    assert counted(True)[-1] == (1, kernel_warm_up.FILES_OF_A_RUN)
    assert counted(False)[-1] == (1, 0)  # one more: nobody knows how many are needed


def test_a_run_that_compiles_nothing_tells_nothing(folder, monkeypatch):
    monkeypatch.setattr(kernel_warm_up, "LOOKED_EVERY_S", 0.01)
    with report_compiling(lambda *_: pytest.fail("nothing was compiled"), False):
        time.sleep(0.05)
