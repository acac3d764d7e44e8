"""A Prefect server and worker for a test: real processes, on a free port."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx

POOL = "nights"
EPIPOLE = [sys.executable, "-c", "from epipole.flows.command_line.main import main; main()"]
# A worker asks for runs every second (default: every ten), and so does a run that waits for a free
# slot (default: every thirty).
QUICK = {
    "PREFECT_SERVER_CONCURRENCY_MAXIMUM_CONCURRENCY_SLOT_WAIT_SECONDS": "1",
    "PREFECT_WORKER_QUERY_SECONDS": "1",
}
QUIET = {
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_SERVER_UI_SHOW_PROMOTIONAL_CONTENT": "false",
}


class Prefect:
    """Prefect's command line and API with one server, all in one folder."""

    def __init__(self, folder: Path, **settings: str) -> None:
        self.folder = folder
        self.home = folder / "prefect"
        self.port = _free_port()
        self.url = f"http://127.0.0.1:{self.port}/api"
        kept = {name: value for name, value in os.environ.items() if "PREFECT" not in name}
        own = {"PREFECT_HOME": str(self.home), "PREFECT_API_URL": self.url, "NO_COLOR": "1"}
        self.environment = kept | QUICK | QUIET | settings | own
        secret = settings.get("PREFECT_API_AUTH_STRING", "").partition(":")
        self._client = httpx.Client(
            base_url=self.url, timeout=30, auth=(secret[0], secret[2]) if secret[0] else None
        )

    def command(self, *arguments: str, timeout: float = 120) -> subprocess.CompletedProcess[str]:
        """Run a command of Prefect to its end."""
        return subprocess.run(
            [sys.executable, "-m", "prefect", *arguments], cwd=self.folder, env=self.environment,
            capture_output=True, text=True, timeout=timeout, stdin=subprocess.DEVNULL,
        )  # fmt: skip

    def start(self, name: str, *arguments: str) -> subprocess.Popen[bytes]:
        """Start a command in the background, in its own session."""
        with (self.folder / f"{name}.txt").open("ab") as output:
            return subprocess.Popen(
                [sys.executable, "-m", "prefect", *arguments], cwd=self.folder,
                env=self.environment, stdout=output, stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL, start_new_session=True,
            )  # fmt: skip

    def start_server(self) -> subprocess.Popen[bytes]:
        """Start the server."""
        return self.start("server", "server", "start", "--port", str(self.port))

    def start_worker(self) -> subprocess.Popen[bytes]:
        """Start a worker of the pool."""
        return self.start("worker", "worker", "start", "--pool", POOL)

    def get(self, path: str) -> Any:
        """Return the API's answer to GET."""
        return _answer(lambda: self._client.get(f"/{path}"))

    def post(self, path: str, asked: dict[str, Any]) -> Any:
        """Return the API's answer to POST."""
        return _answer(lambda: self._client.post(f"/{path}", json=asked))

    def find(self, what: str, **asked: Any) -> list[dict[str, Any]]:
        """Return all flow runs, task runs, logs or artifacts that match a filter."""
        found: list[dict[str, Any]] = []
        while rows := self.post(f"{what}/filter", asked | {"offset": len(found)}):
            found += rows
        return found

    def run(self, run_id: str) -> dict[str, Any]:
        """Return a flow run."""
        (run,) = self.find("flow_runs", flow_runs={"id": {"any_": [run_id]}})
        return run

    def flow_processes(self, worker: subprocess.Popen[bytes]) -> list[int]:
        """Return the processes of the flow runs that a worker started."""
        return [pid for pid in self._processes() if _parent(pid) == worker.pid]

    def orphans(self) -> list[int]:
        """Return the processes of flow runs whose worker has gone."""
        own = self._processes()
        return [pid for pid in own if _parent(pid) == 1 and "prefect.engine" in _arguments(pid)]

    def kill_all(self) -> None:
        """Kill every process of this server and its workers, orphans too."""
        for pid in self._processes():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def _processes(self) -> list[int]:
        """Return the processes with this Prefect's home in their environment."""
        mark = f"PREFECT_HOME={self.home}\0".encode()
        found = []
        for entry in Path("/proc").iterdir():
            with contextlib.suppress(OSError):
                if entry.name.isdigit() and mark in (entry / "environ").read_bytes():
                    found.append(int(entry.name))
        return found


@contextlib.contextmanager
def serving(folder: Path, **settings: str) -> Iterator[Prefect]:
    """Run a server. At the end all its processes are killed, whatever happened."""
    prefect = Prefect(folder, **settings)
    try:
        prefect.start_server()
        wait_for(lambda: _answers(prefect.url), "the server to start")
        yield prefect
    finally:
        prefect.kill_all()


def deploy_files(folder: Path, logs: Path, dataset: Path) -> dict[str, str]:
    """Write the files of a deployment, two lines changed; return the settings of prefect.env."""
    subprocess.run(
        [*EPIPOLE, "deploy-files", "--out", str(folder)], check=True, capture_output=True
    )
    text = (folder / "prefect.yaml").read_text()
    for name, place in (("/data/logs", logs), ("/data/dataset", dataset)):
        assert text.count(f" {name} ") + text.count(f" {name}\n") == 1
        text = text.replace(f" {name}", f" {place}")
    (folder / "prefect.yaml").write_text(text)
    lines = (folder / "prefect.env").read_text().splitlines()
    return dict(line.split("=", 1) for line in lines if not line.startswith("#"))


def wait_for(what: Callable[[], Any], why: str, seconds: float = 120) -> Any:
    """Wait until `what` returns something true, and return it; fail after `seconds`."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        value = what()
        if value:
            return value
        time.sleep(0.1)
    raise AssertionError(f"waited {seconds:.0f} s for {why}")


def _answer(ask: Callable[[], httpx.Response], seconds: float = 60) -> Any:
    """Return the content of an answer. A server whose database is busy says 503: come again."""
    end = time.monotonic() + seconds
    while (answer := ask()).status_code == httpx.codes.SERVICE_UNAVAILABLE:
        if time.monotonic() > end:
            break
        time.sleep(0.5)
    return answer.raise_for_status().json()


def _answers(url: str) -> bool:
    with contextlib.suppress(httpx.HTTPError):
        return httpx.get(f"{url}/health", timeout=5).is_success
    return False


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _parent(pid: int) -> int:
    with contextlib.suppress(OSError):
        stat = Path(f"/proc/{pid}/stat").read_text()
        return int(stat.rpartition(")")[2].split()[1])
    return -1


def _arguments(pid: int) -> str:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    return ""
