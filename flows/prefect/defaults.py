"""Settings that make an embedded Prefect quiet and quick.

The command line starts Prefect's API inside the run. Its server also runs schedules, automations
and telemetry, which a single run does not need. They compete for the SQLite file ("database is
locked"), so they are off. The user's settings, profile or server take precedence.
"""

import contextlib
import logging
from collections.abc import Iterator

import httpx
from prefect.client.orchestration import get_client
from prefect.logging.configuration import setup_logging
from prefect.settings import (
    PREFECT_API_AUTH_STRING,
    PREFECT_API_URL,
    PREFECT_CLIENT_MAX_RETRIES,
    get_current_settings,
    temporary_settings,
)

from epipole.flows.prefect.embedded_server import start_server
from epipole.flows.prefect.server_process import DEFAULTS, Launched
from epipole.io.paths import line_of
from epipole.schemas.errors import EpipoleError
from epipole.schemas.text import without_secrets

ANSWERS_WITHIN_S = 5.0

# Their errors are also raised to the caller, who prints them.
_RUN_LOGGERS = ("prefect.flow_runs", "prefect.task_runs")


@contextlib.contextmanager
def embedded_prefect(early: Launched | None = None) -> Iterator[None]:
    """Run flows on an embedded API, unless the user's Prefect has an API set.

    `early` is a process of the server that was launched before Prefect was imported.

    Raises
    ------
    EpipoleError
        Where the user's server does not answer, or the embedded one cannot start.
    """
    with contextlib.ExitStack() as stack:
        url = get_current_settings().api.url
        if url is None:
            stack.enter_context(temporary_settings(set_defaults=DEFAULTS))
            served = start_server(early)
            # Prefect hands these settings to workers in other processes.
            known = {PREFECT_API_URL: served.url, PREFECT_API_AUTH_STRING: served.secret}
            stack.enter_context(temporary_settings(known))
        else:
            if early is not None:
                early.stop()
            _check_server(url)
        yield


@contextlib.contextmanager
def lost_server_as_line() -> Iterator[None]:
    """Turn the errors of a server that ends during a run into one line.

    Raises
    ------
    EpipoleError
        Where Prefect's client has given up.
    """
    try:
        yield
    except httpx.HTTPError as error:
        server = f"Prefect's server {without_secrets(get_current_settings().api.url or '')}"
        if isinstance(error, httpx.HTTPStatusError) and error.response.status_code == 401:
            raise EpipoleError(
                f"{server} asks for a secret; set PREFECT_API_AUTH_STRING to it "
                "(prefect.env of `epipole deploy-files` has it)"
            ) from error
        raise EpipoleError(
            f"{server} was lost during the run "
            f"({line_of(error)}); the dataset has all nights of the run or none: run again"
        ) from error


def _check_server(url: str) -> None:
    """Raise unless the user's server answers. Otherwise Prefect ends the run with a traceback."""
    with (
        temporary_settings({PREFECT_CLIENT_MAX_RETRIES: 0}),
        get_client(httpx_settings={"timeout": ANSWERS_WITHIN_S}, sync_client=True) as client,
    ):
        error = client.api_healthcheck()
    if error is not None:
        raise EpipoleError(
            f"Prefect's server {without_secrets(url)} does not answer ({line_of(error)}); "
            "start it, or unset PREFECT_API_URL to run without it"
        ) from error


def quiet_console() -> None:
    """Print only warnings and errors of Prefect on the terminal. Its API still gets all lines.

    This is not undone: the last lines come when the server stops, at the end of the process.
    """
    setup_logging()
    for handler in _all_handlers():
        # A filter, because Prefect resets the levels when a flow starts.
        if isinstance(handler, logging.StreamHandler) and _is_of_prefect(handler):
            handler.addFilter(_is_worth_showing)


def _is_of_prefect(handler: logging.Handler) -> bool:
    return type(handler).__module__.startswith("prefect.")


def _is_worth_showing(record: logging.LogRecord) -> bool:
    if record.levelno <= logging.root.manager.disable:
        return False  # after a signal: the loggers of Prefect do not look
    return record.levelno == logging.WARNING or (
        record.levelno > logging.WARNING and record.name not in _RUN_LOGGERS
    )


def _all_handlers() -> list[logging.Handler]:
    loggers = [logging.root, *logging.root.manager.loggerDict.values()]
    return [h for logger in loggers if isinstance(logger, logging.Logger) for h in logger.handlers]
