"""Compiled kernels are kept apart for other code, and those of a wheel are used."""

import os
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest
from numba.core.caching import CompileResultCacheImpl
from numba.core.errors import NumbaWarning

from epipole.io.caches import kernel_locator, kernel_target, kernels
from epipole.io.caches.kernel_list import read_kernels
from epipole.io.caches.kernel_locator import KernelLocator
from epipole.io.caches.kernel_target import LEVEL_3, common_target
from epipole.io.caches.kernels import (
    HANDED_ON,
    KEPT,
    digest_of,
    folder_of,
    imported_by,
    kernel_folder,
    use_kernel_cache,
)

MODULE = "epipole.tasks.algorithms.geometry.attitude"


@pytest.fixture(autouse=True)
def nothing_handed_on(tmp_path, monkeypatch):
    monkeypatch.setenv("EPIPOLE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.setenv(HANDED_ON, "")
    monkeypatch.setattr(kernels, "_folder", None)
    monkeypatch.setattr(kernels, "COMPILED", tmp_path / "no_wheel")


@pytest.fixture
def code(tmp_path):
    """Return a package of three modules: one imports another, in two lines, the third none."""
    root = tmp_path / "epipole"
    (root / "tasks").mkdir(parents=True)
    (root / "tasks" / "a.py").write_text("from epipole.tasks.b import (\n    one,\n    two,\n)\n")
    (root / "tasks" / "b.py").write_text("def f():\n    from epipole.tasks import d\n")
    (root / "tasks" / "c.py").write_text("import numpy\n")
    (root / "tasks" / "d.py").write_text("x = 1\n")
    return root


def test_a_module_depends_on_what_it_imports_directly_or_not(code):
    names = {f"epipole.tasks.{name}" for name in "abd"}
    assert imported_by("epipole.tasks.a", code) == names
    assert imported_by("epipole.tasks.c", code) == {"epipole.tasks.c"}


def test_a_change_changes_the_digests_of_what_imports_the_module(code):
    def digests():
        for known in (kernels._source, kernels._imports, digest_of):
            known.cache_clear()
        return [digest_of(f"epipole.tasks.{name}", code) for name in "abcd"]

    before = digests()
    (code / "tasks" / "d.py").write_text("x = 2\n")
    after = digests()
    assert [a == b for a, b in zip(before, after, strict=True)] == [False, False, True, False]


def test_no_import_of_a_kernels_module_is_overlooked():
    grimp = pytest.importorskip("grimp", reason="grimp comes with import-linter, of the group dev")
    roots = [f"epipole.{folder}" for folder in ("schemas", "io", "tasks")]
    graph = grimp.build_graph(*roots, cache_dir=None)
    for module in {name.partition(":")[0] for name, _ in read_kernels()}:
        missing = graph.find_upstream_modules(module) - imported_by(module)
        assert {name for name in missing if not graph.find_children(name)} == set(), module


def test_the_folder_of_a_module_is_in_the_users_cache(tmp_path):
    use_kernel_cache()
    assert kernel_folder() == tmp_path / "cache" / "kernels"
    name = f"{MODULE.removeprefix('epipole.')}-{digest_of(MODULE)}"
    assert folder_of(MODULE) == kernel_folder() / name
    assert folder_of("scipy.special") is None


def test_a_started_process_uses_the_folder_of_the_one_that_started_it(tmp_path, monkeypatch):
    use_kernel_cache()
    folder = kernel_folder()
    monkeypatch.setenv("EPIPOLE_CACHE", str(tmp_path / "other"))
    use_kernel_cache()
    assert kernel_folder() == folder
    folder.rmdir()  # the one that started it is gone, and with it a temporary folder
    use_kernel_cache()
    assert kernel_folder() == tmp_path / "other" / "kernels"


SORTING = """
import numpy as np
from numba import njit

@njit(cache=True)
def sort(x):
    return np.{}(x)
"""
# With three functions before it, numba 0.68 gives the inner function of `np.argsort` the number
# that the one of `np.sort` has in another process.
BEFORE = "from numba import njit; [njit(lambda: 1)() for _ in range(3)]"


def test_kernels_of_two_processes_are_not_taken_for_each_other(tmp_path):
    for name in ("sort", "argsort"):
        (tmp_path / f"{name}_of.py").write_text(SORTING.format(name))
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kernels")}

    def sorted_by(*names, before=""):
        lines = ["import epipole.tasks, numpy as np", before]
        lines += [f"from {n}_of import sort; print(*sort(np.array([3.0, 1, 2])))" for n in names]
        command = [sys.executable, "-c", "\n".join(lines)]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True,
                              check=True, text=True)  # fmt: skip
        return done.stdout.splitlines()

    assert sorted_by("sort") == ["1.0 2.0 3.0"]
    assert sorted_by("argsort", before=BEFORE) == ["1 2 0"]
    assert sorted_by("sort", "argsort") == ["1.0 2.0 3.0", "1 2 0"]


def test_forked_processes_name_functions_apart():
    script = (
        "import multiprocessing as m, epipole.tasks\n"
        "from numba.core.bytecode import FunctionIdentity as identity\n"
        "number = lambda _: next(identity._unique_ids) >> 16\n"
        "def of(k): return number(k)\n"
        "with m.get_context('fork').Pool(1) as a, m.get_context('fork').Pool(1) as b:\n"
        "    print(number(0), *a.map(of, [0]), *b.map(of, [0]))\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True)
    assert len(set(done.stdout.split())) == 3


def test_a_users_own_folder_wins(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "mine"))
    use_kernel_cache()
    assert kernel_folder() is None
    assert folder_of(MODULE) is None


@pytest.fixture
def wheel(tmp_path, monkeypatch):
    """Return the kernels that the package came with."""
    compiled = tmp_path / "compiled"
    (compiled / "tasks.a-0123").mkdir(parents=True)
    (compiled / "tasks.a-0123" / "a.nbi").write_text("index")
    monkeypatch.setattr(kernels, "COMPILED", compiled)
    return compiled


@pytest.mark.parametrize("cache", ["on", "off"])
def test_the_kernels_of_a_wheel_are_copied_into_the_cache_once(cache, wheel, monkeypatch):
    if cache == "off":
        monkeypatch.setenv("EPIPOLE_CACHE", "off")
    use_kernel_cache()
    kept = kernel_folder() / "tasks.a-0123" / "a.nbi"
    assert kept.read_text() == "index"
    assert kept.parent.stat().st_mode & 0o777 == 0o700
    kept.write_text("more")
    os.environ[HANDED_ON] = ""
    use_kernel_cache()
    assert kept.read_text() == "more"
    assert "tasks.a-0123" in {path.name for path in kept.parents[1].iterdir()}
    assert not list(kept.parents[1].glob(".copy-*"))


def test_the_folders_that_were_not_used_for_longest_are_removed(tmp_path):
    old = time.time() - 86400
    for k in range(KEPT + 3):
        folder = tmp_path / "cache" / "kernels" / f"old{k}"
        folder.mkdir(parents=True)
        os.utime(folder, (old + k, old + k))
    (tmp_path / "cache").chmod(0o700)
    (tmp_path / "cache" / "kernels").chmod(0o700)
    use_kernel_cache()
    left = {p.name for p in kernel_folder().iterdir()}
    assert len(left) == KEPT
    assert not left & {"old0", "old1", "old2"}


def test_a_folder_that_is_used_is_not_old(tmp_path, monkeypatch):
    monkeypatch.setattr(kernel_locator, "_folder_of", lambda _: tmp_path)
    os.utime(tmp_path, (0, 0))
    located = KernelLocator.from_function(folder_of, __file__)
    assert located.get_cache_path() == str(tmp_path)
    assert tmp_path.stat().st_mtime > time.time() - 3600
    monkeypatch.setattr(kernel_locator, "_folder_of", lambda _: None)
    assert KernelLocator.from_function(folder_of, __file__) is None


def test_a_kernel_that_cannot_be_kept_is_a_warning(tmp_path):
    def compiled():
        """Stand for a kernel."""

    keeping = object.__new__(CompileResultCacheImpl)
    keeping._locator, keeping._lineno = KernelLocator(compiled, tmp_path), 1
    lifted = SimpleNamespace(
        lifted=[SimpleNamespace(can_cache=False)], fndesc=SimpleNamespace(qualname="compiled")
    )
    with pytest.warns(NumbaWarning, match="Cannot cache compiled function"):
        assert not keeping.check_cachable(lifted)


FLAGS = "flags\t\t: fpu abm avx avx2 bmi1 bmi2 f16c fma movbe\n"


@pytest.mark.parametrize(
    ("machine", "text", "target"),
    [
        ("x86_64", f"processor\t: 0\n{FLAGS}", LEVEL_3),
        ("x86_64", FLAGS.replace("avx2 ", ""), None),
        ("x86_64", "", None),
        ("aarch64", FLAGS, None),
    ],
)
def test_a_wheel_fits_x86_64_processors_of_level_3(machine, text, target, tmp_path, monkeypatch):
    (tmp_path / "cpuinfo").write_text(text)
    monkeypatch.delenv("NUMBA_CPU_NAME", raising=False)
    monkeypatch.setattr(kernel_target.platform, "machine", lambda: machine)
    monkeypatch.setattr(kernel_target, "CPUINFO", tmp_path / "cpuinfo")
    assert common_target() == target
    monkeypatch.setenv("NUMBA_CPU_NAME", "znver3")  # the user has chosen
    assert common_target() is None


def test_where_the_processor_is_not_described_it_is_no_known_one(tmp_path, monkeypatch):
    monkeypatch.setattr(kernel_target, "CPUINFO", tmp_path / "missing")
    assert common_target() is None
