"""Kernels: one decorator declares how all of them are compiled."""

import re
from pathlib import Path

from epipole.io.logs.kernels import kernel as of_logs
from epipole.tasks.algorithms.kernels import kernel

ROOT = Path(__file__).parents[3]


def test_kernels_of_the_log_reader_are_compiled_like_all_others():
    @kernel
    def one(x):
        return x

    @of_logs
    def other(x):
        return x

    assert one.targetoptions == other.targetoptions


def test_no_module_compiles_kernels_its_own_way():
    compiling = [
        str(path.relative_to(ROOT))
        for folder in ("schemas", "io", "tasks", "flows")
        for path in (ROOT / folder).rglob("*.py")
        if re.search(r"\b(njit|vectorize|guvectorize|cfunc)\b", path.read_text())
    ]
    assert sorted(compiling) == ["io/logs/kernels.py", "tasks/algorithms/kernels.py"]
