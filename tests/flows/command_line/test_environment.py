"""A run on a terminal asks no host, and says nothing of Prefect; a user may have no home."""

import os
import pty
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

# Python runs this first in every process: the run's, its server's, its helper's.
LOOK_UPS = """
import socket
real = socket.getaddrinfo
def getaddrinfo(host, *arguments, **named):
    with open({path!r}, "a") as file:
        print(host, file=file)
    return real(host, *arguments, **named)
socket.getaddrinfo = getaddrinfo
"""


@pytest.fixture
def looked_up(tmp_path) -> Path:
    """Return a file; `on_terminal` writes the names of all hosts that are looked up to it."""
    (tmp_path / "site").mkdir()
    path = tmp_path / "looked_up"
    (tmp_path / "site" / "sitecustomize.py").write_text(LOOK_UPS.format(path=str(path)))
    return path


def on_terminal(command: list[str], site: Path, home: Path) -> str:
    """Return what a command prints on a terminal."""
    kept = {
        k: v
        for k, v in os.environ.items()
        if "PREFECT" not in k and k not in ("CI", "DO_NOT_TRACK")
    }
    ours, theirs = pty.openpty()
    run = subprocess.Popen(
        command, stdin=theirs, stdout=theirs, stderr=theirs,
        env=kept | {"PYTHONPATH": str(site), "PREFECT_HOME": str(home)},
    )  # fmt: skip
    os.close(theirs)
    said = b""
    try:
        while piece := os.read(ours, 4096):
            said += piece
    except OSError:  # the terminal has no other end any more
        pass
    finally:
        os.close(ours)
    assert run.wait(60) == 0, said.decode()
    return said.decode()


def test_a_run_on_a_terminal_asks_no_host_and_shows_no_notice(looked_up, night_log, tmp_path):
    epipole = str(Path(sys.executable).with_name("epipole"))
    command = [epipole, "run", str(night_log), "--out", str(tmp_path / "out")]
    said = on_terminal(command, tmp_path / "site", tmp_path / "home")
    assert "published" in said
    assert "usage data" not in said
    hosts = set(looked_up.read_text().split()) if looked_up.exists() else set()
    assert hosts <= {"127.0.0.1", "localhost"}


@pytest.mark.parametrize(("set_by_user", "then"), [({}, "1"), ({"DO_NOT_TRACK": "0"}, "0")])
def test_what_the_user_has_set_stays(set_by_user, then):
    code = (
        "import os; from epipole.flows.command_line.process import prepare_environment; "
        "prepare_environment(); print(os.environ['DO_NOT_TRACK'])"
    )
    kept = {k: v for k, v in os.environ.items() if k != "DO_NOT_TRACK"} | set_by_user
    ran = subprocess.run([sys.executable, "-c", code], env=kept, capture_output=True, text=True)
    assert ran.stdout.strip() == then
