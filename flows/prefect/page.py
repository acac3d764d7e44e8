"""What Prefect's page shows of a run beside its tasks: lines of log, progress, a summary."""

import contextlib
import functools
import logging
from collections.abc import Callable, Iterator
from typing import ParamSpec

from prefect.context import FlowRunContext, TaskRunContext
from prefect.logging.handlers import APILogHandler

from epipole.flows.night.summary import Summary
from epipole.flows.prefect.artifacts import ProgressBar, show_summary
from epipole.flows.prefect.progress import ROOT, STEPS

P = ParamSpec("P")


def shown_on_page(flow: Callable[P, Summary]) -> Callable[P, Summary]:
    """Return the flow's function so that Prefect's page shows how it goes and what it found."""

    @functools.wraps(flow)
    def shown(*args: P.args, **kwargs: P.kwargs) -> Summary:
        bar = ProgressBar()
        with _added(ROOT, _RunLog(logging.INFO)), _added(STEPS, bar):
            try:
                summary = flow(*args, **kwargs)
            except BaseException:
                bar.finish("failed: the log says why")
                raise
            bar.finish("done")
            show_summary(summary)
            return summary

    return shown


class _RunLog(APILogHandler):
    """Sends lines of log to the run, or the task's run, that they are written in."""

    def emit(self, record: logging.LogRecord) -> None:
        if TaskRunContext.get() or FlowRunContext.get():  # a library's own thread has neither
            super().emit(record)


@contextlib.contextmanager
def _added(logger: logging.Logger, handler: logging.Handler) -> Iterator[None]:
    """Lend a handler to a logger; a user who sent these lines to Prefect has them once."""
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
