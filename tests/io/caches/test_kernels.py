"""Compiled kernels are kept apart for other code."""

import os
import shutil
import time

import numba
import pytest

from epipole.io.caches.kernels import KEPT, use_kernel_cache


@pytest.fixture
def code(tmp_path, monkeypatch):
    monkeypatch.setenv("EPIPOLE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    folder = tmp_path / "code" / "inner"
    folder.mkdir(parents=True)
    (folder / "kernel.py").write_text("a = 1\n")
    return tmp_path / "code"


def kept():
    return os.environ["NUMBA_CACHE_DIR"]


def test_the_same_code_has_the_same_folder_and_other_code_another(code):
    use_kernel_cache([code])
    first = kept()
    assert first == numba.config.CACHE_DIR
    os.environ["NUMBA_CACHE_DIR"] = ""
    use_kernel_cache([code])
    assert kept() == first
    (code / "inner" / "kernel.py").write_text("a = 2\n")
    os.environ["NUMBA_CACHE_DIR"] = ""
    use_kernel_cache([code])
    assert kept() != first


def test_the_same_code_elsewhere_has_a_folder_of_its_own(code, tmp_path):
    use_kernel_cache([code])
    first = kept()
    shutil.copytree(code, tmp_path / "other_environment")
    os.environ["NUMBA_CACHE_DIR"] = ""
    use_kernel_cache([tmp_path / "other_environment"])
    assert kept() != first


def test_a_users_own_folder_wins(code, monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "mine"))
    use_kernel_cache([code])
    assert kept() == str(tmp_path / "mine")
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.setenv("EPIPOLE_CACHE", "off")
    use_kernel_cache([code])
    assert kept() == ""


def test_folders_of_code_that_is_long_gone_are_removed(code, tmp_path):
    old = time.time() - 86400
    for k in range(KEPT + 3):
        folder = tmp_path / "cache" / "kernels" / f"old{k}"
        folder.mkdir(parents=True)
        os.utime(folder, (old + k, old + k))
    use_kernel_cache([code])
    left = {p.name for p in (tmp_path / "cache" / "kernels").iterdir()}
    assert len(left) == KEPT
    assert os.path.basename(kept()) in left
    assert "old0" not in left
