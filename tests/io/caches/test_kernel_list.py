"""The list of kernels is that of a few runs; `.ci/generate` writes it again."""

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

ROOT = Path(__file__).parents[3]
EXAMPLE = ROOT / "examples" / "four_sensor_geo.mcap"
ELEMENTS = ROOT / "io" / "simulation" / "built_in" / "real_leo.tle"
# Scenes that use what the example does not: attitudes from scratch; many sensors, known objects;
# stars among many satellites.
SCENES = {
    "wide": ("six_sensor_wide", "--seconds", "2"),
    "passing": ("constellation", "--satellites", "10", "--near", "--seconds", "40"),
    "crowd": ("night", "--sensors", "2", "--objects", "60", "--seconds", "12"),
}

_HEAD = """\
# The kernels that some short runs call from Python, in the order of their first call, with the
# types of their arguments. Written by `python tests/io/caches/test_kernel_list.py`.
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
import epipole.tasks
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
example, wide, crowd, passing, elements, called = sys.argv[1:]
try:
    for k, arguments in enumerate(([example], [wide], [crowd], [passing, "--known", elements])):
        sys.argv = ["epipole", "run", *arguments, "--out", f"{called}.{k}", "--quiet"]
        try:
            main()
        except SystemExit as ended:
            if ended.code:
                raise
finally:
    with open(called, "wb") as file:
        pickle.dump((asked, missed), file)
"""
SIMULATE = "from epipole.flows.command_line.main import main; main()"


def kernels_of_runs(folder):
    """Return what runs of the example and the scenes ask numba for, and what it had to compile.

    The first is {(name, types): whether Python calls it}. A kernel that was compiled for another
    one is not asked for again.
    """
    logs = {name: Path(folder) / name for name in SCENES}
    for name, scene in SCENES.items():
        command = [sys.executable, "-c", SIMULATE, "simulate", *scene, "--out", logs[name]]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    called = Path(folder) / "called"
    files = [EXAMPLE, *(logs[name] for name in ("wide", "crowd", "passing")), ELEMENTS, called]
    subprocess.run([sys.executable, "-c", RUN, *files], check=True, cwd=folder)
    return pickle.loads(called.read_bytes())


@pytest.fixture(scope="module")
def after_compiling(tmp_path_factory):
    compile_all = "from epipole.io.caches.kernel_compiler import compile_kernels; compile_kernels()"
    subprocess.run([sys.executable, "-c", compile_all], check=True)
    return kernels_of_runs(tmp_path_factory.mktemp("run"))


@pytest.fixture
def asked(after_compiling):
    return after_compiling[0]


def test_a_run_has_nothing_to_compile_once_the_list_is_compiled(after_compiling):
    assert not after_compiling[1]


def test_the_runs_call_what_the_list_says_and_nothing_else(asked):
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
        kernels_of_runs(folder)  # compiles: what is loaded below is asked for one by one
    with tempfile.TemporaryDirectory() as folder:
        asked, _ = kernels_of_runs(folder)
    KERNELS.write_text(kernels_text(key for key, from_python in asked.items() if from_python))
