"""What an embedded Prefect needs in order to be quiet and quick.

The command line starts Prefect's API inside the run. Most of what its server does besides
(schedules, automations, telemetry) has nothing to do there, and competes for its SQLite
file: "database is locked". A user's own settings, profile or server win over all of this.
"""

import contextlib
import contextvars
import logging
import signal
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

from prefect.client.orchestration import get_client
from prefect.logging.configuration import setup_logging
from prefect.logging.handlers import PrefectConsoleHandler
from prefect.server.api.server import SubprocessASGIServer
from prefect.settings import PREFECT_API_URL, get_current_settings, temporary_settings

# Services of a server that runs on; a run here and now waits for none of them.
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

_DEFAULTS = {
    **{f"server.services.{name}.enabled": False for name in _SERVICES},
    "server.analytics_enabled": False,
    # The default of 20 s is too short on a busy machine.
    "server.ephemeral.startup_timeout_seconds": 120,
}

# Their errors end in the exception that the caller gets, and shows.
_RUN_LOGGERS = ("prefect.flow_runs", "prefect.task_runs")


@contextlib.contextmanager
def embedded_prefect() -> Iterator[None]:
    """Run flows inside on an embedded API, unless the user's Prefect has an API set."""
    with contextlib.ExitStack() as stack:
        if get_current_settings().api.url is None:
            stack.enter_context(temporary_settings(set_defaults=_DEFAULTS))
            _start_server()
            # Or a worker in another process would start an API of its own.
            url = SubprocessASGIServer().api_url
            stack.enter_context(temporary_settings({PREFECT_API_URL: url}))
        yield


def _start_server() -> None:
    """Start the embedded server so that Ctrl-C, which reaches it too, does not stop it.

    It has to outlive the run to be told how it ended. The signals a thread has blocked stay
    blocked in the processes it starts.
    """

    def start() -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        get_client(sync_client=True)

    with ThreadPoolExecutor(1) as pool:
        pool.submit(contextvars.copy_context().run, start).result()


def quiet_console() -> None:
    """Keep Prefect's lines off the terminal, but for warnings; its API still gets them.

    It holds for the process: the last lines come when the server stops, at its exit.
    """
    setup_logging()
    for handler in _all_handlers():
        # A filter, because Prefect sets the levels again when a flow starts.
        if isinstance(handler, PrefectConsoleHandler):
            handler.addFilter(_is_worth_showing)


def _is_worth_showing(record: logging.LogRecord) -> bool:
    return record.levelno == logging.WARNING or (
        record.levelno > logging.WARNING and record.name not in _RUN_LOGGERS
    )


def _all_handlers() -> list[logging.Handler]:
    loggers = [logging.root, *logging.root.manager.loggerDict.values()]
    return [h for logger in loggers if isinstance(logger, logging.Logger) for h in logger.handlers]
