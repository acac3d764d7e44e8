"""The embedded Prefect server: a process that ends with its run, however the run ends.

Prefect can start such a server itself. That one outlives a run that is killed and holds its
output; it waits two minutes for a database that it cannot write; and several that start at once
spoil each other's new database.
"""

import atexit
import contextlib
import logging
import re
import socket
import sqlite3
import threading
import time
from pathlib import Path
from typing import IO, NamedTuple

from prefect.settings import get_current_settings
from sqlalchemy.engine import URL, make_url

from epipole.flows.prefect.server_process import HOST, Launched, launch
from epipole.io.caches.private_folders import private_folder
from epipole.schemas.errors import EpipoleError

LOGGER = logging.getLogger(__name__)

MAX_RESTARTS = 3
_LAST_LINE = re.compile(r"^[\w.]+(?:Error|Exception)\b.*", re.MULTILINE)


class Served(NamedTuple):
    """Where the API is served, and the secret that it asks for."""

    url: str
    secret: str


def start_server(early: Launched | None = None) -> Served:
    """Start the server. It stops when this process ends.

    `early` is a process that was launched before Prefect was imported; it is used if it can be.

    Raises
    ------
    EpipoleError
        Where its database cannot be written, or it does not start.
    """
    with contextlib.ExitStack() as not_needed:
        if early is not None:
            not_needed.callback(early.stop)
        home = _writable_home()
        if early is not None and home == get_current_settings().home:
            not_needed.pop_all()
            launched = early
        else:
            launched = launch(_environment(home))
    try:
        launched.serve()
        _wait_until_ready(launched, home)
    except BaseException:
        launched.stop()
        raise
    server = _Server(launched, home)
    atexit.register(server.stop)
    threading.Thread(target=server.keep_alive, daemon=True, name="Prefect's server").start()
    url = f"http://{HOST}:{launched.listener.getsockname()[1]}/api"
    return Served(url, launched.secret)


class _Server:
    """The server of a run; a process that ends before the run is started again.

    Meanwhile requests wait at its socket, which this process holds.
    """

    def __init__(self, launched: Launched, home: Path) -> None:
        self._launched, self._home = launched, home
        self._stopping = threading.Event()

    def keep_alive(self) -> None:
        """Start the server again when it ends, a few times."""
        for _ in range(MAX_RESTARTS):
            self._launched.process.wait()
            if self._stopping.is_set():
                return
            LOGGER.warning("Prefect's server has ended before the run; it is started again")
            self._launched = launch(_environment(self._home), self._launched)
            self._launched.serve()
        self._launched.process.wait()
        self._launched.listener.close()  # a request fails at once instead of waiting

    def stop(self) -> None:
        """Stop the server: the run has ended."""
        self._stopping.set()
        self._launched.stop()


def _environment(home: Path) -> dict[str, str]:
    settings = get_current_settings().to_environment_variables(exclude_unset=True)
    return {**settings, "PREFECT_HOME": str(home)}


def _wait_until_ready(server: Launched, home: Path) -> None:
    address = server.listener.getsockname()
    limit_s = get_current_settings().server.ephemeral.startup_timeout_seconds
    end_s = time.monotonic() + limit_s
    while time.monotonic() < end_s:
        with contextlib.suppress(OSError), socket.create_connection(address, timeout=1):
            return  # it listens when its database is ready
        if server.process.poll() is not None:
            raise EpipoleError(
                f"Prefect's server did not start ({_reason(server.output)}); its database lies in "
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
