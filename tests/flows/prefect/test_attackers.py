"""Attackers with an account of this machine: what a run gives them, and what it takes from them.

They know what everybody can look up: which ports a run listens at, the command lines of all
processes, how Prefect's API works. They can read no file of the run's user.
"""

import asyncio
import base64
import contextlib
import json
import os
import pickle
import socket
import ssl
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import websockets
from prefect.states import Completed, Failed
from scenes.dataset_tables import contents
from scenes.killed_runs import without_report
from scenes.prefect_server import EPIPOLE, serving

from epipole.flows.prefect.artifacts import run_here, shown_on_page
from epipole.flows.prefect.runners import check_scheduler, task_runner
from epipole.schemas.errors import EpipoleError
from epipole.schemas.options import Runner

# What a run of which the server says something else has made all the same.
OBJECTS = 9
MADE = f"objects     {OBJECTS} in"


class Payload:
    """Writes a file where it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[str, str]]:
        return open, (str(self.mark), "w")


class Attacker(threading.Thread):
    """Sets every run that it sees to a state whose result is a file of its own."""

    def __init__(self, folder: Path, state: str, ports: Callable[[], set[int]]) -> None:
        super().__init__(daemon=True)
        self.ports = ports
        folder.mkdir()
        self.mark = folder / "was-here"
        self.result = folder / "result"
        self.state = state
        self.answers: list[int] = []
        self.done = 0
        self.ending = threading.Event()
        record = {"metadata": self._metadata(), "result": self._pickled()}
        self.result.write_text(json.dumps(record))

    def _metadata(self) -> dict[str, Any]:
        return {
            "storage_key": str(self.result), "serializer": {"type": "pickle"},
            "prefect_version": "3.9.1",
        }  # fmt: skip

    def _pickled(self) -> str:
        return base64.encodebytes(pickle.dumps(Payload(self.mark))).decode()

    def works(self) -> bool:
        """Return whether who reads the result, as Prefect does, runs the attacker's code."""
        from prefect.client.schemas.objects import State

        state = State.model_validate(
            {"type": "COMPLETED", "name": "Completed", "data": self._metadata()}
        )
        state.result(raise_on_failure=False).close()
        worked = self.mark.exists()
        self.mark.unlink()
        return worked

    def run(self) -> None:
        while not self.ending.wait(0.02):
            for url in map("http://127.0.0.1:{}/api".format, self.ports()):
                self._attack(url)

    def _attack(self, url: str) -> None:
        try:
            found = httpx.post(f"{url}/flow_runs/filter", json={}, timeout=5)
            self.answers.append(found.status_code)
            for run in found.json() if found.is_success else []:
                if run["state_type"] not in ("RUNNING", "PENDING"):
                    continue
                state = {"type": self.state, "name": "Done", "data": self._metadata()}
                asked = {"state": state, "force": True}
                path = f"flow_runs/{run['id']}/set_state"
                self.done += httpx.post(f"{url}/{path}", json=asked, timeout=5).is_success
        except (httpx.HTTPError, ValueError):
            pass  # not a server of Prefect's


def ports_of_children() -> set[int]:
    """Return the ports at which the processes listen that this one has started, and theirs."""
    sockets = {link for pid in descendants(os.getpid()) for link in open_files(pid)}
    fields = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    listening = [f for f in fields if f[3] == "0A" and f"socket:[{f[9]}]" in sockets]
    return {int(f[1].rpartition(":")[2], 16) for f in listening}


def descendants(pid: int) -> Iterator[int]:
    for file in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(OSError):  # it has ended
            for child in map(int, file.read_text().split()):
                yield child
                yield from descendants(child)


def open_files(pid: int) -> list[str]:
    with contextlib.suppress(OSError):
        return [str(link.readlink()) for link in Path(f"/proc/{pid}/fd").iterdir()]
    return []


def environment(**settings: str) -> dict[str, str]:
    kept = {name: value for name, value in os.environ.items() if "PREFECT" not in name}
    return kept | settings


@pytest.fixture
def attackers(tmp_path) -> Iterator[Callable[..., Attacker]]:
    started: list[Attacker] = []

    def start(state: str, ports: Callable[[], set[int]]) -> Attacker:
        started.append(Attacker(tmp_path / "attacker", state, ports))
        assert started[-1].works()
        started[-1].start()
        return started[-1]

    yield start
    for attacker in started:
        attacker.ending.set()
        attacker.join()


def run(log: Path, out: Path, **settings: str) -> subprocess.CompletedProcess[str]:
    plain = without_report(out.parent)
    return subprocess.run(
        [*EPIPOLE, "run", str(log), "--out", str(out), "--settings", str(plain)],
        env=environment(**settings), capture_output=True, text=True, timeout=600,
        stdin=subprocess.DEVNULL,
    )  # fmt: skip


@pytest.mark.long
def test_an_account_of_this_machine_gets_nothing_of_the_embedded_server(
    night_log, tmp_path, attackers
):
    attacker = attackers("COMPLETED", ports_of_children)
    ran = run(night_log, tmp_path / "out", PREFECT_HOME=str(tmp_path / "home"))
    assert ran.returncode == 0, ran.stderr
    assert MADE in ran.stdout
    assert 401 in attacker.answers  # it has found the server, and the server said no
    assert 200 not in attacker.answers
    assert not attacker.mark.exists()


@pytest.mark.long
def test_a_run_does_not_take_its_result_from_the_server(
    night_log, night_dataset, tmp_path, attackers
):
    with serving(tmp_path) as prefect:  # a server of the user's own, which asks nobody
        attacker = attackers("COMPLETED", lambda: {prefect.port})
        ran = run(night_log, tmp_path / "out", PREFECT_API_URL=prefect.url)
    assert attacker.done
    assert not attacker.mark.exists()
    if MADE not in ran.stdout:  # the attacker was there before the run began
        assert "did not begin" in ran.stderr
        assert ran.returncode == 1
        return
    assert ran.returncode == 0, ran.stderr
    assert contents(tmp_path / "out") == contents(night_dataset)


@pytest.mark.long
def test_a_storage_of_results_that_the_server_names_is_not_used(night_log, tmp_path):
    storage = tmp_path / "storage"
    storage.mkdir()
    with serving(tmp_path) as prefect:
        kind = prefect.get("block_types/slug/local-file-system")["id"]
        wanted = {"block_schemas": {"block_type_id": {"any_": [kind]}}}
        (schema,) = prefect.post("block_schemas/filter", wanted)
        block = {
            "name": "results", "data": {"basepath": str(storage)}, "block_type_id": kind,
            "block_schema_id": schema["id"],
        }  # fmt: skip
        made = prefect.post("block_documents/", block)
        asked = {"default_result_storage_block_id": made["id"]}
        httpx.put(f"{prefect.url}/admin/storage", json=asked).raise_for_status()
        ran = run(night_log, tmp_path / "out", PREFECT_API_URL=prefect.url)
    assert ran.returncode == 0, ran.stderr
    assert MADE in ran.stdout
    assert not list(storage.iterdir())


WAITS = """
import os, sys, time
from epipole.flows.command_line.process import prepare_environment
prepare_environment()
from epipole.flows.prefect.defaults import embedded_prefect
from prefect.client.orchestration import get_client
from prefect.settings import get_current_settings
with embedded_prefect(), get_client(sync_client=True) as client:
    assert client.request("POST", "/flow_runs/filter", json={}).is_success
    api = get_current_settings().api
    print(api.url, api.auth_string.get_secret_value(), flush=True)
    sys.stdin.read()
"""


@pytest.fixture(scope="module")
def waiting(tmp_path_factory) -> Iterator[tuple[str, str, Path, subprocess.Popen[str]]]:
    """Return the address, secret, home and process of a run with an embedded server."""
    home = tmp_path_factory.mktemp("home")
    process = subprocess.Popen(
        [sys.executable, "-c", WAITS], env=environment(PREFECT_HOME=str(home)), text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    with process:
        url, secret = process.stdout.readline().split()
        yield url, secret, home, process
        process.stdin.close()


@pytest.mark.long
@pytest.mark.parametrize("told", [None, ("epipole", ""), ("admin", "pass"), ("epipole", "x" * 43)])
def test_the_embedded_server_answers_only_who_has_its_secret(waiting, told):
    url, secret, *_ = waiting
    for path in ("flow_runs/filter", "block_documents/filter", "work_pools/filter"):
        assert httpx.post(f"{url}/{path}", json={}, auth=told).status_code == 401
    assert httpx.get(f"{url}/admin/settings", auth=told).status_code == 401
    user, password = secret.split(":")
    assert httpx.post(f"{url}/flow_runs/filter", json={}, auth=(user, password)).is_success


@pytest.mark.long
@pytest.mark.parametrize(
    "path", ["events/in", "events/out", "logs/out", "task_runs/subscriptions/scheduled"]
)
@pytest.mark.parametrize("greeting", [None, {"type": "auth", "token": "wrong"}])
def test_the_embedded_servers_sockets_close_to_who_has_not(waiting, path, greeting):
    url = waiting[0].replace("http", "ws")

    async def ask() -> None:
        protocols = ["prefect"] if greeting else None
        async with websockets.connect(f"{url}/{path}", subprotocols=protocols) as socket:
            await socket.send(json.dumps(greeting or {"type": "filter", "filter": {}}))
            await asyncio.wait_for(socket.recv(), 10)

    with pytest.raises((websockets.ConnectionClosed, websockets.InvalidHandshake)):
        asyncio.run(ask())


@pytest.mark.long
def test_the_secret_stands_in_no_command_line_and_no_file(waiting):
    _, secret, home, process = waiting
    password = secret.split(":")[1].encode()
    assert len(password.rstrip(b"-")) >= 40  # 43 make 256 bits
    lines = b""
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            lines += entry.read_bytes()
        except OSError:  # it has ended
            continue
    assert b"server_process" in lines
    assert password not in lines
    files = [file for file in home.rglob("*") if file.is_file()]
    assert any(file.name == "prefect.db" for file in files)
    assert not [file for file in files if password in file.read_bytes()]
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    assert {Path(f"/proc/{pid}/environ").stat().st_mode & 0o077 for pid in children} == {0}


@pytest.mark.long
def test_the_processes_of_dask_let_nobody_in_without_their_key():
    pytest.importorskip("distributed")
    with task_runner(Runner.dask, workers=1) as runner:
        assert runner.client.submit(sum, [1, 2]).result() == 3
        addresses = [runner.client.cluster.scheduler_address]
        addresses += [worker.worker_address for worker in runner.client.cluster.workers.values()]
        for address in addresses:
            assert address.startswith("tls://127.0.0.1:")
            with pytest.raises(EpipoleError, match="does not answer"):
                check_scheduler(address.replace("tls", "tcp"))
            with pytest.raises(ssl.SSLError, match="CERTIFICATE_REQUIRED"):
                greeting_of_tls(int(address.rpartition(":")[2]))


def greeting_of_tls(port: int) -> bytes:
    """Return what a server says first to a client that encrypts, but has no key."""
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    with (
        socket.create_connection(("127.0.0.1", port), timeout=10) as plain,
        context.wrap_socket(plain) as encrypted,
    ):
        return encrypted.recv(1)


def test_a_run_that_the_server_ends_before_it_begins_is_one_line():
    def flow(*, return_state: bool) -> object:
        return Completed(message="so says\nthe server")

    with pytest.raises(EpipoleError, match=r"did not begin: .* Completed \(so says\\nthe server\)"):
        run_here(flow)


def test_what_the_flow_raised_counts_and_not_what_the_server_says():
    def failing() -> None:
        raise ValueError("mine")

    def flow(*, return_state: bool) -> object:
        with pytest.raises(ValueError, match="mine"):
            shown_on_page(failing)()
        return Failed(message="another's")

    with pytest.raises(ValueError, match="mine"):
        run_here(flow)
