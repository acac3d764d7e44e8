"""Whole runs of `epipole run` in a process of their own, for the benchmarks of nights."""

import itertools
import json
import re
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

COMMAND = [sys.executable, "-c", "from epipole.flows.command_line.main import main; main()"]

# How the line of log that ends each stage begins.
STAGES = {
    "find": "found ",
    "read": "read ",
    "identify": "identified ",
    "track": "followed ",
    "solve": "solved ",
    "check": "clocks of ",
    "name": "named ",
    "publish": "published ",
}


class WholeRun(NamedTuple):
    """A run: what was measured as each stage ended, its summary, CPU [s] and memory [MiB]."""

    at: dict[str, float]
    summary: dict[str, Any]
    cpu_s: float
    mib: float

    def stages(self) -> dict[str, float]:
        """Return what was measured in each stage."""
        names = list(self.at)
        return {b: self.at[b] - self.at[a] for a, b in itertools.pairwise(names)}


def whole_run(
    log: Path, out: Path, stages: Mapping[str, str], measure: Callable[[int], float]
) -> WholeRun:
    """Run a log once.

    Parameters
    ----------
    stages
        Those of `STAGES` that are told apart.
    measure
        What is measured at these lines, such as the time, by the id of the process.
    """
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [*COMMAND, "run", str(log), "--out", str(out), "--json"]
    # Not a pipe: the summary of hundreds of sensors is more than a pipe holds.
    with tempfile.TemporaryFile("w+") as written:
        process = subprocess.Popen(command, stdout=written, stderr=subprocess.PIPE, text=True)
        assert process.stderr is not None
        at = {"start": measure(process.pid)}
        for line in process.stderr:
            text = re.sub(r"^\d\d:\d\d:\d\d ", "", line)
            at |= {name: measure(process.pid) for name, word in stages.items()
                   if text.startswith(word)}  # fmt: skip
        assert process.wait() == 0
        written.seek(0)
        summary = json.load(written)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return WholeRun(at, summary, cpu_s, after.ru_maxrss / 1024)
