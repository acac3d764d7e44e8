"""What Prefect's page shows of a run besides its tasks: log lines, progress, a summary."""

import contextlib
import functools
import logging
from collections.abc import Callable, Iterator
from typing import ParamSpec

from prefect.client.schemas.objects import State
from prefect.context import FlowRunContext, TaskRunContext
from prefect.logging.handlers import APILogHandler
from prefect.states import Completed

from epipole.flows.night.progress import ROOT, STEPS, with_safe_text
from epipole.flows.night.summary import Summary
from epipole.flows.prefect.artifacts import ProgressBar, show_summary

P = ParamSpec("P")


def shown_on_page(flow: Callable[P, Summary]) -> Callable[P, State[Summary]]:
    """Return the flow's function, with its log lines, progress and summary on Prefect's page."""

    @functools.wraps(flow)
    def shown(*args: P.args, **kwargs: P.kwargs) -> State[Summary]:
        bar = ProgressBar()
        with _added(ROOT, _RunLog(logging.INFO)), _added(STEPS, bar):
            try:
                summary = flow(*args, **kwargs)
            except BaseException:
                bar.finish("failed; see the log")
                raise
            bar.finish("done")
            show_summary(summary)
            # The flow's caller gets the summary; the page, and --watch, show the message.
            return Completed(message=summary.sentence(), data=summary)

    return shown


class _RunLog(APILogHandler):
    """Sends log lines to the flow run or task run in which they are written."""

    def emit(self, record: logging.LogRecord) -> None:
        if TaskRunContext.get() or FlowRunContext.get():  # neither in a thread of a library
            super().emit(with_safe_text(record))


@contextlib.contextmanager
def _added(logger: logging.Logger, handler: logging.Handler) -> Iterator[None]:
    """Add a handler to a logger, unless the user's logging already sends its lines to Prefect."""
    if any(type(other) is APILogHandler for other in logger.handlers):
        yield
        return
    level = logger.level
    logger.setLevel(min(logger.getEffectiveLevel(), handler.level or logging.DEBUG))
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)
