"""The embedded server: it ends with its run, and where it cannot start, one line says why."""

import os
import signal
import socket
import sqlite3
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from urllib.parse import urlsplit

import pytest

pytestmark = pytest.mark.long

RUN = """
import sys, time
from epipole.flows.command_line.process import prepare_environment
prepare_environment()
from epipole.flows.prefect.defaults import embedded_prefect
from epipole.schemas.errors import EpipoleError
from prefect.settings import get_current_settings
try:
    with embedded_prefect():
        print(get_current_settings().api.url, flush=True)
        if sys.argv[1:]:
            time.sleep(60)
except EpipoleError as error:
    sys.exit(f"error: {error}")
"""
SOON_S = 60  # of a busy machine; without the check, two minutes


def started(home: Path | None, *arguments: str, **environment: str) -> subprocess.Popen[str]:
    kept = {name: value for name, value in os.environ.items() if "PREFECT" not in name}
    if home is not None:
        kept["PREFECT_HOME"] = str(home)
    return subprocess.Popen(
        [sys.executable, "-c", RUN, *arguments], env=kept | environment,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def said(home: Path | None, **environment: str) -> list[str]:
    run = started(home, **environment)
    out, _ = run.communicate(timeout=120)
    return out.splitlines()


def port_is_open(url: str) -> bool:
    try:
        socket.create_connection((urlsplit(url).hostname, urlsplit(url).port), 1).close()
    except OSError:
        return False
    return True


def test_the_server_of_a_killed_run_ends_and_lets_go_of_its_output(tmp_path):
    run = started(tmp_path, "wait")
    url = run.stdout.readline().strip()
    assert port_is_open(url)
    run.send_signal(signal.SIGKILL)
    killed_s = time.monotonic()
    assert run.stdout.read() == ""  # returns when nobody holds the other end of the pipe
    assert time.monotonic() - killed_s < 1
    while port_is_open(url):
        assert time.monotonic() - killed_s < SOON_S
        time.sleep(0.1)


def server_of(run: subprocess.Popen[str]) -> int:
    """Return the process of a run's server."""
    children = Path(f"/proc/{run.pid}/task").glob("*/children")
    pids = [pid for file in children for pid in file.read_text().split()]
    (pid,) = [p for p in pids if b"server_process" in Path(f"/proc/{p}/cmdline").read_bytes()]
    return int(pid)


def test_a_server_that_is_killed_is_started_again_and_one_line_says_so(tmp_path):
    run = started(tmp_path, "wait")
    url = run.stdout.readline().strip()
    first = server_of(run)
    os.kill(first, signal.SIGKILL)
    says = run.stdout.readline()
    assert says == "Prefect's server has ended before the run; it is started again\n"
    answer = urllib.request.urlopen(f"{url}/health", timeout=120)  # it waits at the socket
    assert answer.status == 200
    assert server_of(run) != first
    run.kill()
    assert run.stdout.read() == ""


def a_file_in_its_place(home: Path) -> None:
    home.write_text("not a folder")


def a_folder_as_the_database(home: Path) -> None:
    (home / "prefect.db").mkdir(parents=True)


def a_damaged_database(home: Path) -> None:
    home.mkdir()
    (home / "prefect.db").write_bytes(b"no database" * 1000)


@pytest.mark.parametrize(
    "spoil", [a_file_in_its_place, a_folder_as_the_database, a_damaged_database]
)
def test_a_database_that_cannot_be_written_is_one_line_soon(spoil, tmp_path):
    home = tmp_path / "home"
    spoil(home)
    started_s = time.monotonic()
    lines = said(home)
    assert time.monotonic() - started_s < SOON_S
    assert len(lines) == 1
    assert lines[0].startswith(f"error: Prefect's database in {home} cannot be written (")


def test_a_database_of_another_version_is_one_line(tmp_path):
    with sqlite3.connect(tmp_path / "prefect.db") as database:
        database.execute("create table alembic_version (version_num text)")
        database.execute("insert into alembic_version values ('of the future')")
    (line,) = said(tmp_path)
    assert line.startswith("error: Prefect's server did not start (")
    assert "of the future" in line
    assert str(tmp_path) in line


def test_without_a_writable_home_the_database_is_temporary_and_a_line_says_so(tmp_path):
    (tmp_path / "home").write_text("not a folder")
    says, url = said(None, HOME=str(tmp_path / "home"))
    assert says.startswith(f"{tmp_path}/home/.prefect cannot be written (Not a directory): ")
    assert url.startswith("http://127.0.0.1:")
    assert not Path(says.split("database is in ")[1].split(" for this run")[0]).exists()


def test_servers_that_start_at_once_on_a_new_home_all_start(tmp_path):
    runs = [started(tmp_path / "new") for _ in range(3)]
    said = [run.communicate(timeout=180)[0].splitlines() for run in runs]
    assert [len(lines) for lines in said] == [1, 1, 1]
    assert len({url for (url,) in said if url.startswith("http://127.0.0.1:")}) == 3


@pytest.mark.parametrize("url", ["http://me:secret@127.0.0.1:1/api", "ftp://127.0.0.1:1/api"])
def test_a_server_that_is_down_is_one_line_soon(url, tmp_path):
    started_s = time.monotonic()
    (line,) = said(tmp_path, PREFECT_API_URL=url)
    assert time.monotonic() - started_s < SOON_S
    assert line.startswith(f"error: Prefect's server {url.replace('me:secret@', '')} does not ")
    assert "secret" not in line
