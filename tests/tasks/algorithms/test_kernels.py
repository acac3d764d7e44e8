"""Kernels: one decorator declares how all of them are compiled."""

import errno
import re
from pathlib import Path

import numpy as np
import pytest
from numba.core.errors import NumbaError

from epipole.io.logs.mcap.record_scan import kernel as of_logs
from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel

ROOT = Path(__file__).parents[3]


def test_kernels_of_the_log_reader_are_compiled_like_all_others():
    @kernel
    def one(x):
        return x

    @of_logs
    def other(x):
        return x

    assert one.targetoptions == other.targetoptions


def test_a_borrowing_kernel_makes_and_returns_no_array():
    @borrowing_kernel
    def makes():
        return np.empty(3)[0]

    @borrowing_kernel
    def returns(x):
        return x[1:]

    with pytest.raises(NumbaError):
        makes()
    with pytest.raises(NumbaError):
        returns(np.zeros(3))


def test_a_borrowing_kernel_may_call_a_kernel_that_makes_arrays():
    @kernel
    def total(x):
        return np.ones(len(x)).sum() + x.sum()

    @borrowing_kernel
    def of_rest(x):
        return total(x[1:])

    assert of_rest(np.ones(3)) == 4.0


def test_no_module_compiles_kernels_its_own_way():
    compiling = [
        str(path.relative_to(ROOT))
        for folder in ("schemas", "io", "tasks", "flows")
        for path in (ROOT / folder).rglob("*.py")
        if re.search(r"\b(njit|vectorize|guvectorize|cfunc)\b", path.read_text())
    ]
    assert sorted(compiling) == ["io/logs/mcap/record_scan.py", "tasks/algorithms/kernels.py"]


def test_a_kernel_that_cannot_be_kept_is_used_and_said_once(monkeypatch, caplog):
    def full(*_):
        raise OSError(errno.ENOSPC, "no space in this test")

    made = [kernel(lambda x, k=k: x + k) for k in range(2)]
    for each in made:
        monkeypatch.setattr(each._cache._cache_file, "save", full)
    assert [each(1.0) for each in made] == [1.0, 2.0]  # and no traceback
    said = [r.getMessage() for r in caplog.records if "cannot be kept" in r.getMessage()]
    assert len(said) == 1
    assert "no space in this test" in said[0]
