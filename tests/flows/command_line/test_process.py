"""Signals come at any moment: into an import, into a library, twice, into a wait without end."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from epipole.io.caches.kernels import COMPILED, HANDED_ON, folder_of

START = """
import logging, os, signal, sys, time
from epipole.flows.command_line import process
process.stop_by_signals()
def signalled():
    os.kill(os.getpid(), signal.{by})
"""

LIBRARY = """
with process.stopped_in_one_line():
    try:
        signalled()
        time.sleep(60)
    except KeyboardInterrupt as error:
        raise ValueError("cannot be serialised") from error
"""

IMPORT = """
with process.stopped_in_one_line():
    import signalled_in
    print("imported")
    time.sleep(60)
"""

TWICE = """
with process.stopped_in_one_line():
    try:
        signalled()
        time.sleep(60)
    finally:
        signalled()
        logging.getLogger("prefect").error("was cancelled")
        time.sleep(0.1)
        print("cleared up")
"""

PREFECT = """
from epipole.flows.prefect.defaults import quiet_console
from prefect.logging import get_logger
quiet_console()
with process.stopped_in_one_line():
    try:
        signalled()
        time.sleep(60)
    finally:
        for name in ("prefect", "prefect._internal.concurrency", "prefect.server", "uvicorn"):
            logging.getLogger(name).error("was cancelled")
            get_logger(name).error("was cancelled")
"""

WAITS = """
process._PATIENCE_S = 0.2
with process.stopped_in_one_line():
    try:
        signalled()
        time.sleep(60)
    finally:
        time.sleep(60)
"""


def run(code, tmp_path, by="SIGINT"):
    """Return what a program wrote that signals itself, and its exit code."""
    ran = subprocess.run(
        [sys.executable, "-c", START.format(by=by) + code], cwd=tmp_path, timeout=50,
        capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(tmp_path)},
    )  # fmt: skip
    return ran.returncode, ran.stdout, ran.stderr


@pytest.mark.parametrize(("by", "says"), [("SIGINT", "interrupted"), ("SIGTERM", "stopped")])
def test_an_exception_that_a_library_made_of_the_signal_is_one_line(by, says, tmp_path):
    expected = 128 + signal.Signals[by], "", f"epipole: {says}\n"
    assert run(LIBRARY, tmp_path, by) == expected


def test_an_import_is_finished_first(tmp_path):
    module = "import __main__, time\n__main__.signalled()\ntime.sleep(0.2)\nprint('whole')\n"
    (tmp_path / "signalled_in.py").write_text(module)
    code, out, err = run(IMPORT, tmp_path)
    assert (code, err) == (130, "epipole: interrupted\n")
    assert out.startswith("whole\n")


def test_a_second_signal_does_not_disturb_the_clearing_up(tmp_path):
    assert run(TWICE, tmp_path) == (130, "cleared up\n", "epipole: interrupted\n")


def test_none_of_prefects_loggers_says_more(tmp_path):
    assert run(PREFECT, tmp_path) == (130, "", "epipole: interrupted\n")


def test_a_wait_that_does_not_end_is_ended(tmp_path):
    assert run(WAITS, tmp_path) == (130, "", "epipole: interrupted\n")


def test_an_error_without_a_signal_stays(tmp_path):
    code, _, err = run("with process.stopped_in_one_line(): 1 / 0", tmp_path)
    assert code == 1
    assert "ZeroDivisionError" in err


pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[3]
COMMAND = "from epipole.flows.command_line.main import main; main()"


def info(cache: Path) -> tuple[str, str]:
    kept = {name: value for name, value in os.environ.items() if name != HANDED_ON}
    ran = subprocess.run(
        [sys.executable, "-c", COMMAND, "info", str(ROOT / "examples" / "four_sensor_geo.mcap")],
        env=kept | {"EPIPOLE_CACHE": str(cache)}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return ran.stdout, ran.stderr


def came_with_kernels() -> bool:
    folder = folder_of("epipole.io.logs.mcap.record_scan")
    return folder is not None and (COMPILED / folder.name).exists()


def test_the_first_use_says_where_it_compiles_and_keeps_the_kernels_in_the_cache(tmp_path):
    before = set(ROOT.rglob("*.nbi"))
    first, says = info(tmp_path / "cache")
    assert says == ("" if came_with_kernels() else "compiling; only the first time\n")
    assert list((tmp_path / "cache").rglob("*.nbi"))
    assert set(ROOT.rglob("*.nbi")) == before  # none beside the code
    assert info(tmp_path / "cache") == (first, "")
