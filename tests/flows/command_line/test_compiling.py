"""A command that has to compile says so, once, and keeps what it has compiled."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[3]
COMMAND = "from epipole.flows.command_line.main import main; main()"


def info(cache: Path) -> tuple[str, str]:
    kept = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    ran = subprocess.run(
        [sys.executable, "-c", COMMAND, "info", str(ROOT / "examples" / "four_sensor_geo.mcap")],
        env=kept | {"EPIPOLE_CACHE": str(cache)}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return ran.stdout, ran.stderr


def test_the_first_use_says_that_it_compiles_and_keeps_the_kernels_in_the_cache(tmp_path):
    before = set(ROOT.rglob("*.nbi"))
    first, says = info(tmp_path / "cache")
    assert says == "compiling; only the first time\n"
    assert list((tmp_path / "cache").rglob("*.nbi"))
    assert set(ROOT.rglob("*.nbi")) == before  # none beside the code
    assert info(tmp_path / "cache") == (first, "")
