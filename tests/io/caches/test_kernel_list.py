"""The list of kernels is that of a run; `.ci/generate` writes it again."""

import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from numba import types

from epipole.io.caches.kernel_list import KERNELS, Signature, kernel, read_kernels, signature

pytestmark = pytest.mark.long

EXAMPLE = Path(__file__).parents[3] / "examples" / "four_sensor_geo.mcap"

_HEAD = """\
# The kernels that a run of the example calls from Python, in the order of their first call,
# with the types of their arguments. Written by `python tests/io/caches/test_kernel_list.py`.
"""


def kernels_text(called: Iterable[tuple[str, Signature]]) -> str:
    """Return the list of kernels ("module:name") with their arguments' types, as TOML."""
    blocks = []
    for name, arguments in called:
        lines = "".join(f"    {_quoted(_text(argument))},\n" for argument in arguments)
        blocks.append(f'"{name}" = [\n{lines}]\n')
    return "\n".join([_HEAD, *blocks])


def _text(argument: Any) -> str:
    if isinstance(argument, types.Array):
        if not argument.mutable:
            return f"Array({argument.dtype}, {argument.ndim}, {argument.layout!r}, readonly=True)"
        last = "::1" if argument.layout == "C" else ":"
        return f"{argument.dtype}[{', '.join([':'] * (argument.ndim - 1) + [last])}]"
    inside = getattr(argument, "types", ())
    fields = ", ".join(_text(one) for one in inside)
    if isinstance(argument, types.BaseNamedTuple):
        made = argument.instance_class  # type: ignore[attr-defined]
        return f"named('{made.__module__}:{made.__name__}', {fields})"
    if isinstance(argument, types.BaseTuple):
        return f"Tuple(({fields},))"
    return str(argument)


def _quoted(text: str) -> str:
    return f'"{text}"'


# What numba is asked for: by Python, or by another kernel that it compiles.
RUN = """
import pickle, sys, threading
from numba.core.dispatcher import Dispatcher

asked, missed, within, compile = {}, set(), threading.local(), Dispatcher.compile

def recorded(self, types):
    depth = getattr(within, "depth", 0)
    name = f"{self.py_func.__module__}:{self.py_func.__name__}"
    if name.startswith("epipole."):
        asked.setdefault((name, tuple(types)), depth == 0)
    within.depth = depth + 1
    try:
        return compile(self, types)
    finally:
        within.depth = depth
        if name.startswith("epipole.") and self.stats.cache_misses[tuple(types)]:
            missed.add(name)

Dispatcher.compile = recorded
from epipole.flows.command_line.main import main
log, out = sys.argv[1:]
sys.argv = ["epipole", "run", log, "--out", out, "--quiet", "--again"]
try:
    main()
finally:
    with open(out + ".kernels", "wb") as file:
        pickle.dump((asked, missed), file)
"""


def kernels_of_a_run(folder):
    """Return what a run of the example asks numba for, and what it then had to compile.

    The first is {(name, types): whether Python calls it}. A kernel that was compiled for another
    one is not asked for again.
    """
    out = Path(folder) / "out"
    subprocess.run([sys.executable, "-c", RUN, EXAMPLE, out], check=True, cwd=folder)
    return pickle.loads(out.with_suffix(".kernels").read_bytes())


@pytest.fixture(scope="module")
def after_compiling(tmp_path_factory):
    compile_all = "from epipole.io.caches.kernel_warm_up import compile_kernels; compile_kernels()"
    subprocess.run([sys.executable, "-c", compile_all], check=True)
    return kernels_of_a_run(tmp_path_factory.mktemp("run"))


@pytest.fixture
def asked(after_compiling):
    return after_compiling[0]


def test_a_run_of_the_example_has_nothing_to_compile_once_the_list_is_compiled(after_compiling):
    assert not after_compiling[1]


def test_a_run_of_the_example_calls_what_the_list_says_and_nothing_else(asked):
    listed = {(name, signature(arguments)) for name, arguments in read_kernels()}
    hint = "`.ci/generate` writes the list again"
    assert not {key for key, from_python in asked.items() if from_python} - listed, hint
    assert not listed - set(asked), hint


def test_what_is_written_reads_the_same(asked, tmp_path):
    written = tmp_path / "kernels.toml"
    called = [key for key, from_python in asked.items() if from_python]
    written.write_text(kernels_text(called))
    assert [(name, signature(given)) for name, given in read_kernels(written)] == called


def test_every_kernel_of_the_list_is_one_that_keeps_what_it_compiles():
    for name, _ in read_kernels():
        assert kernel(name)._cache.cache_path, name


if __name__ == "__main__":
    os.environ.setdefault("PREFECT_HOME", tempfile.mkdtemp())
    KERNELS.write_text(_HEAD)  # a run asks for all that is listed, also for what no longer exists
    with tempfile.TemporaryDirectory() as folder:
        kernels_of_a_run(folder)  # compiles: what is loaded below is asked for one by one
        asked, _ = kernels_of_a_run(folder)
    KERNELS.write_text(kernels_text(key for key, from_python in asked.items() if from_python))
