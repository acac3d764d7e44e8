"""The embedded Prefect server: a process that ends with its run, however the run ends.

Prefect can start such a server itself. That one outlives a run that is killed and holds its
output; it waits two minutes for a database that it cannot write; and several that start at once
spoil each other's new database.
"""

import atexit
import contextlib
import fcntl
import logging
import os
import re
import signal
import socket
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import uvicorn
from prefect.settings import get_current_settings
from sqlalchemy.engine import URL, make_url

from epipole.io.caches.private_folders import private_folder
from epipole.schemas.errors import EpipoleError

LOGGER = logging.getLogger(__name__)

HOST = "127.0.0.1"
STOPS_WITHIN_S = 5.0
MOST_RESTARTS = 3
# With these Prefect's application knows that it is embedded.
_EMBEDDED = {
    "PREFECT_UI_ENABLED": "0",
    "PREFECT__SERVER_EPHEMERAL": "1",
    "PREFECT__SERVER_FINAL": "1",
}
_STARTING = "epipole-starting.lock"  # in Prefect's home
_LAST_LINE = re.compile(r"^[\w.]+(?:Error|Exception)\b.*", re.MULTILINE)


def start_server() -> str:
    """Start the server, and return the address of its API. It stops when this process ends.

    Raises
    ------
    EpipoleError
        Where its database cannot be written, or it does not start.
    """
    home = _writable_home()
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(socket.socket())
        listener.bind((HOST, 0))  # held from now on: no other server can get this port
        output = stack.enter_context(tempfile.TemporaryFile())
        server = _Server(listener, output, home)
        atexit.register(server.stop)
        address = listener.getsockname()
        _wait_until_ready(server.process, address, output, home)
        stack.pop_all()  # held until the run ends, for a server that has to be started again
        threading.Thread(target=server.keep_alive, daemon=True, name="Prefect's server").start()
    return f"http://{HOST}:{address[1]}/api"


class _Server:
    """The process of the server; one that ends before the run is started again.

    Meanwhile requests wait at its socket, which this process holds.
    """

    def __init__(self, listener: socket.socket, output: IO[bytes], home: Path) -> None:
        self._listener, self._output, self._home = listener, output, home
        self._stopping = threading.Event()
        self.process = _launch(listener, output, home)

    def keep_alive(self) -> None:
        """Start the server again when it ends, a few times."""
        for _ in range(MOST_RESTARTS):
            self.process.wait()
            if self._stopping.is_set():
                return
            LOGGER.warning("Prefect's server has ended before the run; it is started again")
            self.process = _launch(self._listener, self._output, self._home)
        self.process.wait()
        self._listener.close()  # a request fails at once instead of waiting

    def stop(self) -> None:
        """Stop the server: the run has ended."""
        self._stopping.set()
        self.process.terminate()
        try:
            self.process.wait(STOPS_WITHIN_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def _launch(listener: socket.socket, output: IO[bytes], home: Path) -> subprocess.Popen[bytes]:
    settings = get_current_settings().to_environment_variables(exclude_unset=True)
    return subprocess.Popen(
        [sys.executable, "-m", __name__, str(listener.fileno())],
        stdin=subprocess.PIPE,  # closed when this process ends
        stdout=output,
        stderr=output,
        env={**os.environ, **settings, **_EMBEDDED, "PREFECT_HOME": str(home)},
        pass_fds=[listener.fileno()],
        start_new_session=True,  # Ctrl-C must not stop it: it records how the run ended
    )


def _wait_until_ready(
    server: subprocess.Popen[bytes], address: tuple[str, int], output: IO[bytes], home: Path
) -> None:
    limit_s = get_current_settings().server.ephemeral.startup_timeout_seconds
    end_s = time.monotonic() + limit_s
    while time.monotonic() < end_s:
        with contextlib.suppress(OSError), socket.create_connection(address, timeout=1):
            return  # it listens when its database is ready
        if server.poll() is not None:
            raise EpipoleError(
                f"Prefect's server did not start ({_reason(output)}); its database lies in "
                f"{home}: repair or remove it, or set PREFECT_HOME to another folder"
            )
        time.sleep(0.05)
    raise EpipoleError(
        f"Prefect's server did not start within {limit_s} s; run again when the machine is less "
        "busy, or set PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS"
    )


def _reason(output: IO[bytes]) -> str:
    """Return the last error in the server's output."""
    output.seek(0)
    text = output.read().decode(errors="replace").strip()
    errors = _LAST_LINE.findall(text) or text.splitlines() or ["no output"]
    return str(errors[-1])


def _writable_home() -> Path:
    """Return Prefect's home; a private temporary folder where the user's home is not writable.

    A home or database that the user has named is not replaced.

    Raises
    ------
    EpipoleError
        Where Prefect's database cannot be written.
    """
    settings = get_current_settings()
    url = settings.server.database.connection_url
    assert url is not None  # Prefect's settings set it
    try:
        with contextlib.suppress(FileExistsError):
            settings.home.mkdir(mode=0o700, parents=True)
        _try_database(make_url(url.get_secret_value()))
    except (OSError, sqlite3.Error) as error:
        reason = getattr(error, "strerror", None) or str(error)
        named = settings.model_fields_set & {"home"} or (
            "connection_url" in settings.server.database.model_fields_set
        )
        if named:
            raise EpipoleError(
                f"Prefect's database in {settings.home} cannot be written ({reason}); set "
                "PREFECT_HOME to a folder that can be written"
            ) from error
        home = private_folder("prefect")
        LOGGER.warning(
            "%s cannot be written (%s): Prefect's database is in %s for this run; "
            "set PREFECT_HOME to keep it",
            settings.home,
            reason,
            home,
        )
        return home
    return settings.home


def _try_database(url: URL) -> None:
    """Raise unless a database file can be written. Other databases are left to the server."""
    if url.get_backend_name() != "sqlite" or url.database in (None, "", ":memory:"):
        return
    with contextlib.closing(sqlite3.connect(url.database, timeout=0, isolation_level=None)) as file:
        try:
            file.execute("BEGIN IMMEDIATE")
            file.execute("ROLLBACK")
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode != sqlite3.SQLITE_BUSY:  # another run writes to it
                raise


class _OneAtATime(uvicorn.Server):
    """Starts while no other embedded server does: the first one makes the database."""

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        with _alone():
            await super().startup(sockets)


@contextlib.contextmanager
def _alone() -> Iterator[None]:
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):  # a home that cannot be written: no file database in it
            lock = stack.enter_context((get_current_settings().home / _STARTING).open("w"))
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _end_with_run() -> None:
    sys.stdin.buffer.read()  # returns when the run has ended and its end of the pipe is closed
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(STOPS_WITHIN_S)
    os._exit(0)


def main() -> None:
    """Serve Prefect's API on the socket that the run has opened."""
    threading.Thread(target=_end_with_run, daemon=True).start()
    config = uvicorn.Config(
        "prefect.server.api.server:create_app", factory=True, log_level="error", lifespan="on"
    )
    _OneAtATime(config).run(sockets=[socket.socket(fileno=int(sys.argv[1]))])


if __name__ == "__main__":
    main()
