"""Compiled kernels are kept apart for other code, and those of a wheel are used."""

import os
import shutil
import time

import pytest

from epipole.io.caches import kernel_target, kernels
from epipole.io.caches.kernel_locator import KernelLocator
from epipole.io.caches.kernel_target import LEVEL_3, common_target
from epipole.io.caches.kernels import (
    DIGEST,
    HANDED_ON,
    KEPT,
    digest_of,
    kernel_folder,
    use_kernel_cache,
)


@pytest.fixture(autouse=True)
def nothing_handed_on(tmp_path, monkeypatch):
    monkeypatch.setenv("EPIPOLE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.setenv(HANDED_ON, "")
    monkeypatch.setattr(kernels, "_folder", None)
    monkeypatch.setattr(kernels, "COMPILED", tmp_path / "no_wheel")
    kernels._fits.cache_clear()
    yield
    kernels._fits.cache_clear()


@pytest.fixture
def code(tmp_path):
    folder = tmp_path / "code" / "inner"
    folder.mkdir(parents=True)
    (folder / "kernel.py").write_text("a = 1\n")
    return tmp_path / "code"


def used(code):
    digest_of.cache_clear()
    os.environ[HANDED_ON] = ""
    use_kernel_cache([code])
    return kernel_folder()


def test_the_same_code_has_the_same_folder_wherever_it_lies_and_other_code_another(code, tmp_path):
    first = used(code)
    assert first.parent == tmp_path / "cache" / "kernels"
    assert used(code) == first
    assert used(shutil.copytree(code, tmp_path / "other_environment")) == first
    (code / "inner" / "kernel.py").write_text("a = 2\n")
    assert used(code) != first


def test_a_started_process_uses_the_folder_of_the_one_that_started_it(code, tmp_path, monkeypatch):
    folder = used(code)
    monkeypatch.setenv("EPIPOLE_CACHE", str(tmp_path / "other"))
    use_kernel_cache([code])
    assert kernel_folder() == folder
    (code / "inner" / "kernel.py").write_text("a = 2\n")  # another version of the code
    digest_of.cache_clear()
    use_kernel_cache([code])
    assert kernel_folder().parent == tmp_path / "other" / "kernels"


def test_a_users_own_folder_wins(code, monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "mine"))
    assert used(code) is None


@pytest.fixture
def wheel(code, tmp_path, monkeypatch):
    """Return the kernels that the package came with: of this code, by their digest."""
    compiled = tmp_path / "compiled"
    (compiled / "epipole.tasks").mkdir(parents=True)
    (compiled / "epipole.tasks" / "a.nbi").write_text("index")
    digest_of.cache_clear()
    (compiled / DIGEST).write_text(digest_of((code,)))
    monkeypatch.setattr(kernels, "COMPILED", compiled)
    return compiled


def test_the_kernels_of_a_wheel_are_copied_into_the_cache_once(code, wheel):
    kept = used(code) / "epipole.tasks" / "a.nbi"
    assert kept.read_text() == "index"
    assert kept.parents[1].stat().st_mode & 0o777 == 0o700
    kept.write_text("more")
    used(code)
    assert kept.read_text() == "more"
    assert [p.name for p in kept.parents[2].iterdir()] == [kept.parents[1].name]  # no copy is left


def test_without_a_cache_the_kernels_of_a_wheel_are_used_where_they_lie(code, wheel, monkeypatch):
    monkeypatch.setenv("EPIPOLE_CACHE", "off")
    assert used(code) == wheel


def test_the_kernels_of_other_code_are_not_used(code, wheel):
    (code / "inner" / "kernel.py").write_text("a = 2\n")
    assert list(used(code).iterdir()) == []


def test_folders_of_code_that_is_long_gone_are_removed(code, tmp_path):
    old = time.time() - 86400
    for k in range(KEPT + 3):
        folder = tmp_path / "cache" / "kernels" / f"old{k}"
        folder.mkdir(parents=True)
        os.utime(folder, (old + k, old + k))
    kept = used(code)
    left = {p.name for p in (tmp_path / "cache" / "kernels").iterdir()}
    assert len(left) == KEPT
    assert kept.name in left
    assert "old0" not in left


def test_only_kernels_of_this_package_are_located(tmp_path, monkeypatch):
    def of_another():
        pass

    of_another.__module__ = "scipy.special"
    assert KernelLocator.from_function(digest_of.__wrapped__, __file__) is None  # no folder yet
    monkeypatch.setattr(kernels, "_folder", tmp_path)
    assert KernelLocator.from_function(of_another, __file__) is None
    located = KernelLocator.from_function(digest_of.__wrapped__, __file__)
    assert located.get_cache_path() == str(tmp_path / "epipole.io.caches")


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
