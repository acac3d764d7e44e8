"""The process of the embedded Prefect server.

It takes seconds to import Prefect's server. So the process can be launched before the run has
imported Prefect itself. It waits for the command to serve: only then is it known whether it is
needed.
This module imports nothing but the standard library when the run imports it.
"""

import gc
import os
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping
from typing import IO, NamedTuple, NoReturn

HOST = "127.0.0.1"
STOPS_WITHIN_S = 5.0
# With these Prefect's application knows that it is embedded.
_EMBEDDED = {
    "PREFECT_UI_ENABLED": "0",
    "PREFECT__SERVER_EPHEMERAL": "1",
    "PREFECT__SERVER_FINAL": "1",
}
_SERVE = b"serve\n"
SECRET_VARIABLE = "PREFECT_SERVER_API_AUTH_STRING"  # of the server; a client has another one

# Services that only a permanent server needs.
_SERVICES = (
    "cancellation_cleanup",
    "cleanup_reconciler",
    "event_logger",
    "event_persister",
    "foreman",
    "late_runs",
    "pause_expirations",
    "repossessor",
    "scheduler",
    "task_run_recorder",
    "triggers",
)

# Of Prefect's settings, where the user has not set them.
DEFAULTS = {
    **{f"server.services.{name}.enabled": False for name in _SERVICES},
    "server.analytics_enabled": False,
    # The default of 20 s is too short on a busy machine.
    "server.ephemeral.startup_timeout_seconds": 120,
}


class Launched(NamedTuple):
    """A process that has been launched, the socket that it serves, and what it has written.

    `secret` is what a client has to show: anybody on this machine can reach the socket.
    """

    process: subprocess.Popen[bytes]
    listener: socket.socket
    output: IO[bytes]
    secret: str

    def serve(self) -> None:
        """Let it start to serve."""
        assert self.process.stdin is not None  # `launch` opens it
        try:
            self.process.stdin.write(_SERVE)
            self.process.stdin.flush()
        except BrokenPipeError:
            pass  # it has ended; who waits for it sees that

    def stop(self) -> None:
        """Stop it, and wait until it has ended."""
        self.process.terminate()
        try:
            self.process.wait(STOPS_WITHIN_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def new_secret() -> str:
    """Return a user and a password for a server: 256 bits, and a public end.

    A server of Prefect's that gets a message of its protocol twice writes the message's last 25
    characters to its log, as pydantic shows them: those of the password.
    """
    return f"epipole:{secrets.token_urlsafe(32)}{'-' * 25}"


def launch(environment: Mapping[str, str], before: Launched | None = None) -> Launched:
    """Launch the process; it ends when this process does, however that ends.

    Parameters
    ----------
    environment
        Variables besides those of this process.
    before
        A process that has ended, whose socket and secret this one takes over; None: new ones.
    """
    if before is None:
        listener = socket.socket()
        listener.bind((HOST, 0))  # from now on no other server can get this port
        secret = new_secret()
    else:
        listener, secret = before.listener, before.secret
    output = tempfile.TemporaryFile()  # noqa: SIM115  open as long as the process
    process = subprocess.Popen(
        [sys.executable, "-m", __name__, str(listener.fileno())],
        stdin=subprocess.PIPE,  # closed when this process ends
        stdout=output,
        stderr=output,
        # The environment of a process is its user's alone to read; a command line is everybody's.
        env={**os.environ, **environment, **_EMBEDDED, SECRET_VARIABLE: secret},
        pass_fds=[listener.fileno()],
        start_new_session=True,  # Ctrl-C must not stop it: it records how the run ended
    )
    return Launched(process, listener, output, secret)


def main() -> None:
    """Serve Prefect's API on the socket that the run has opened, once the run says so."""
    gc.disable()  # importing libraries leaves no garbage
    from prefect.settings import temporary_settings

    with temporary_settings(set_defaults=DEFAULTS):
        from epipole.flows.prefect.one_at_a_time import serve_one_at_a_time

        if sys.stdin.buffer.readline() != _SERVE:  # the run has ended
            return
        gc.freeze()
        gc.enable()
        threading.Thread(target=_end_with_run, daemon=True).start()
        serve_one_at_a_time(socket.socket(fileno=int(sys.argv[1])))


def _end_with_run() -> NoReturn:
    sys.stdin.buffer.read()  # returns when the run has ended and its end of the pipe is closed
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(STOPS_WITHIN_S)
    os._exit(0)


if __name__ == "__main__":
    main()
