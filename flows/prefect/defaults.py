"""Settings that make an embedded Prefect quiet and quick.

The command line starts Prefect's API inside the run. Its server also runs schedules, automations
and telemetry, which a single run does not need. They compete for the SQLite file ("database is
locked"), so they are off. A user's own settings, profile or server take precedence.
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

_DEFAULTS = {
    **{f"server.services.{name}.enabled": False for name in _SERVICES},
    "server.analytics_enabled": False,
    # The default of 20 s is too short on a busy machine.
    "server.ephemeral.startup_timeout_seconds": 120,
}

# Their errors are also raised to the caller, who prints them.
_RUN_LOGGERS = ("prefect.flow_runs", "prefect.task_runs")


@contextlib.contextmanager
def embedded_prefect() -> Iterator[None]:
    """Run flows on an embedded API, unless the user's Prefect has an API set."""
    with contextlib.ExitStack() as stack:
        if get_current_settings().api.url is None:
            stack.enter_context(temporary_settings(set_defaults=_DEFAULTS))
            _start_server()
            # Without it, a worker in another process would start a second API.
            url = SubprocessASGIServer().api_url
            stack.enter_context(temporary_settings({PREFECT_API_URL: url}))
        yield


def _start_server() -> None:
    """Start the embedded server so that Ctrl-C does not stop it.

    The server also gets the signal, but it must record how the run ended. Signals that are
    blocked in a thread stay blocked in the processes that the thread starts.
    """

    def start() -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        get_client(sync_client=True)

    with ThreadPoolExecutor(1) as pool:
        pool.submit(contextvars.copy_context().run, start).result()


def quiet_console() -> None:
    """Print only warnings and errors of Prefect on the terminal. Its API still gets all lines.

    This is not undone: the last lines come when the server stops, at the end of the process.
    """
    setup_logging()
    for handler in _all_handlers():
        # A filter, because Prefect resets the levels when a flow starts.
        if isinstance(handler, PrefectConsoleHandler):
            handler.addFilter(_is_worth_showing)


def _is_worth_showing(record: logging.LogRecord) -> bool:
    return record.levelno == logging.WARNING or (
        record.levelno > logging.WARNING and record.name not in _RUN_LOGGERS
    )


def _all_handlers() -> list[logging.Handler]:
    loggers = [logging.root, *logging.root.manager.loggerDict.values()]
    return [h for logger in loggers if isinstance(logger, logging.Logger) for h in logger.handlers]
