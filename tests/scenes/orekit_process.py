"""Orekit in a process of its own, because Java takes over a process's signals."""

import io
import os
import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import polars as pl

TESTS = Path(__file__).parents[1]
EXAMPLE = TESTS.parent / "examples" / "orekit_orbits.py"


def printed_by(scene: str, *arguments: object) -> pl.DataFrame:
    """Return the table that a module of this folder prints as JSON, run in a new process."""
    command = [sys.executable, "-m", f"scenes.{scene}", *map(str, arguments)]
    searched = os.pathsep.join([str(TESTS), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    environment = os.environ | {"PYTHONPATH": searched}
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, env=environment)
    return pl.read_json(io.BytesIO(done.stdout), infer_schema_length=None)


def started_example() -> SimpleNamespace:
    """Return the names of examples/orekit_orbits.py, with Java started and Orekit's data given."""
    example = SimpleNamespace(**runpy.run_path(str(EXAMPLE)))
    example.give_data()
    return example
