"""What Prefect's page shows of a run besides its tasks, and what the run's caller gets of it."""

import contextlib
import functools
import logging
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any, ParamSpec, cast

from prefect import Flow
from prefect.client.schemas.objects import State
from prefect.context import FlowRunContext, TaskRunContext
from prefect.logging.handlers import APILogHandler
from prefect.states import Completed

from epipole.flows.night.progress import ROOT, STEPS, with_safe_text
from epipole.flows.night.summary import Summary
from epipole.flows.prefect.artifacts import ProgressBar, show_summary
from epipole.schemas.errors import EpipoleError
from epipole.schemas.text.shown import as_line

P = ParamSpec("P")

# How the flow of this context has ended: what it returned or raised.
_ENDED: ContextVar[list[Summary | BaseException]] = ContextVar("ended")


def shown_on_page(flow: Callable[P, Summary]) -> Callable[P, State[Summary]]:
    """Return the flow's function, with its log lines, progress and summary on Prefect's page."""

    @functools.wraps(flow)
    def shown(*args: P.args, **kwargs: P.kwargs) -> State[Summary]:
        bar = ProgressBar()
        with _added(ROOT, _RunLog(logging.INFO)), _added(STEPS, bar):
            try:
                summary = flow(*args, **kwargs)
            except BaseException as error:
                _ended(error)
                bar.finish("failed; see the log")
                raise
            _ended(summary)
            bar.finish("done")
            show_summary(summary)
            # The page, and --watch, show the message.
            return Completed(message=summary.sentence(), data=summary)

    return shown


def _ended(how: Summary | BaseException) -> None:
    """Tell `run_here`; a function, as Dask pickles the flow with the variables that it names."""
    _ENDED.get([]).append(how)


def run_here(flow: Flow[P, Any], *args: P.args, **kwargs: P.kwargs) -> Summary:
    """Run a flow that is `shown_on_page`, and return its summary as this process made it.

    Prefect's own call takes the result out of the last state, and the server may answer with a
    state of someone else's, whose result is a pickle file: code that would run here.

    Raises
    ------
    EpipoleError
        Where the server lets the run not begin.
    """
    ended: list[Summary | BaseException] = []
    token = _ENDED.set(ended)
    try:
        state = cast(State[Any], flow(*args, return_state=True, **kwargs))
    finally:
        _ENDED.reset(token)
    if not ended:
        raise EpipoleError(
            f"the run did not begin: Prefect's server says {state.name} "
            f"({as_line(state.message or 'without a reason')}); see who else uses the server"
        )
    if isinstance(ended[-1], BaseException):
        raise ended[-1]
    return ended[-1]


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
