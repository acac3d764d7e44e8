"""Prefect's API served by this process; servers of one home start one after the other."""

import contextlib
import fcntl
import socket
from collections.abc import Iterator

import prefect.server.api.server  # noqa: F401  the application, imported before it is needed
import uvicorn
from prefect.settings import get_current_settings

_STARTING = "epipole-starting.lock"  # in Prefect's home


def serve_one_at_a_time(listener: socket.socket) -> None:
    """Serve until a signal comes."""
    config = uvicorn.Config(
        "prefect.server.api.server:create_app", factory=True, log_level="error", lifespan="on"
    )
    _OneAtATime(config).run(sockets=[listener])


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
