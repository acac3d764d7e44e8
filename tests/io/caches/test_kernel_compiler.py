"""The kernels of the list are compiled by two processes, and put where a wheel can carry them."""

import subprocess
import sys
import time

import pytest
from scenes.busy_folder import busy

from epipole.io.caches import kernel_compiler, kernel_list, kernels
from epipole.io.caches.kernel_compiler import (
    compile_into,
    compile_kernels,
    compiled_share,
    report_compiling,
    second_process,
)
from epipole.io.caches.kernels import folder_of

MODULE = "epipole.io.caches.kernel_compiler"


class Helper:
    """A process that works until it is stopped."""

    def __init__(self, command, **pipes):
        self.process = subprocess.Popen(
            [sys.executable, "-c", "import sys; sys.stdin.read()"], stdin=subprocess.PIPE
        )
        self.kill, self.communicate = self.process.kill, self.process.communicate


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return a kernel folder without kernels."""
    monkeypatch.setattr(kernels, "_folder", tmp_path / "kernels")
    (tmp_path / "kernels").mkdir()
    return tmp_path / "kernels"


MODULE_OF_ONE = "epipole.tasks.algorithms.geometry.attitude"


def keep(function="one"):
    folder = folder_of(MODULE_OF_ONE)
    folder.mkdir(exist_ok=True)
    (folder / f"attitude.{function}-{len(list(folder.iterdir()))}.py311.nbi").touch()


@pytest.fixture
def started(monkeypatch):
    """Return the list of processes that were started."""
    started = []

    def start(*arguments, **options):
        started.append(Helper(*arguments, **options))
        return started[-1]

    monkeypatch.setattr(kernel_compiler.os, "cpu_count", lambda: 2)
    monkeypatch.setattr(kernel_compiler, "Popen", start)
    return started


def test_the_second_process_ends_with_the_first_also_where_that_fails(started):
    def work():
        with second_process():
            assert started[0].process.poll() is None
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        work()
    assert started[0].process.poll() is not None


def test_the_second_process_ends_when_the_one_that_started_it_is_gone():
    code = f"from {MODULE} import _end_with_parent; _end_with_parent(); exit(9)"
    helper = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE)
    helper.communicate(timeout=60)
    assert helper.returncode == 0


def test_with_one_processor_there_is_no_second_process(started, monkeypatch):
    monkeypatch.setattr(kernel_compiler.os, "cpu_count", lambda: 1)
    with second_process():
        pass
    assert not started


def test_a_process_that_cannot_be_started_does_not_stop_the_first(monkeypatch):
    def refuse(*arguments, **options):
        raise OSError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(kernel_compiler.os, "cpu_count", lambda: 2)
    monkeypatch.setattr(kernel_compiler, "Popen", refuse)
    with second_process():
        pass


class Kernel:
    """What the list calls a kernel."""

    def __init__(self, compiled):
        self.compile = compiled.append


@pytest.fixture
def compiled(monkeypatch):
    """Have three kernels in the list, one of them unknown; return the types that were compiled."""
    one, two = f"{MODULE_OF_ONE}:one", f"{MODULE_OF_ONE}:two"
    listed = [(one, ["int64"]), ("no.such:kernel", ["int64"]), (two, ["float64"])]
    compiled = []
    there = {one: Kernel(compiled), two: Kernel(compiled)}
    monkeypatch.setattr(kernel_list, "read_kernels", lambda: listed)
    monkeypatch.setattr(kernel_list, "kernel", lambda name: there[name])
    return compiled


@pytest.mark.parametrize("backwards", [False, True])
def test_a_kernel_that_cannot_be_compiled_is_left_to_the_run(backwards, compiled):
    compile_kernels(backwards)
    order = ["int64", "float64"]
    assert [str(*types) for types in compiled] == (order[::-1] if backwards else order)


def test_a_wheel_gets_the_kernels_of_this_code(compiled, started, folder, tmp_path):
    keep()
    (folder / "tasks.a-0123").mkdir()  # of another version
    compile_into(tmp_path / "wheel")
    assert len(compiled) == 2
    (only,) = (tmp_path / "wheel").iterdir()
    assert (only / "attitude.one-0.py311.nbi").exists()
    assert only.name == folder_of(MODULE_OF_ONE).name


def test_the_share_that_is_compiled_counts_functions(compiled, folder):
    assert compiled_share() == 0.0
    keep("one")
    keep("one")
    assert compiled_share() == 1 / 3
    keep("two")
    assert compiled_share() == 2 / 3


def test_what_is_compiled_is_counted_from_the_files_that_appear(folder, monkeypatch):
    monkeypatch.setattr(kernel_compiler, "LOOKED_EVERY_S", 0.01)

    def counted(total: int) -> tuple[int, int]:
        counts = []
        with report_compiling(lambda *count: counts.append(count), total):
            keep()
            while not counts:
                time.sleep(0.01)
        return counts[-1]

    assert counted(300) == (1, 300)
    assert counted(0) == (1, 0)  # nobody knows how many there will be


def test_files_are_counted_while_another_run_makes_and_removes_some(folder):
    keep()
    with busy(folder):
        for _ in range(20_000):
            assert kernel_compiler._count() == 1


def test_nothing_is_reported_where_nothing_is_compiled(folder, monkeypatch):
    monkeypatch.setattr(kernel_compiler, "LOOKED_EVERY_S", 0.01)
    with report_compiling(lambda *_: pytest.fail("nothing was compiled")):
        time.sleep(0.05)
