"""What Prefect's page shows of a run: artifacts, tags and logs; and what its caller gets.

A page that cannot be written is a warning, never an error.
"""

import base64
import contextlib
import functools
import logging
import time
from collections.abc import Callable, Iterator, Mapping
from contextvars import ContextVar
from typing import Any, ParamSpec, cast
from uuid import UUID

import httpx
from prefect import Flow
from prefect.artifacts import (
    create_markdown_artifact,
    create_progress_artifact,
    create_table_artifact,
    update_progress_artifact,
)
from prefect.client.schemas.objects import State
from prefect.context import FlowRunContext, TaskRunContext
from prefect.events import emit_event
from prefect.exceptions import PrefectException
from prefect.logging.handlers import APILogHandler
from prefect.runtime import deployment
from prefect.states import Completed, Failed

from epipole.flows.night.progress import COMPILE, ROOT, STEPS, with_safe_text
from epipole.flows.night.summary import Summary, many
from epipole.io.datasets.dataset import report_location
from epipole.schemas.errors import EpipoleError, NoFramesError
from epipole.schemas.rejects import Reason
from epipole.schemas.text import as_line, as_markdown_text
from epipole.tasks.report.night_facts import ReportExtract

# Artifacts: progress and results.

LOGGER = logging.getLogger(__name__)

NEEDS_LOOK = "epipole.night.needs-look"  # an event
LONGEST_ID = 100
MAX_SENSORS = 50  # that the table of gaps names
UPDATED_EVERY_S = 3.0
_PAGE_ERRORS = (httpx.HTTPError, PrefectException, OSError, RuntimeError)


@contextlib.contextmanager
def _as_warning(what: str) -> Iterator[None]:
    try:
        yield
    except _PAGE_ERRORS as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        LOGGER.warning("%s could not be shown on Prefect's page: %s", what, reason)


class ProgressBar(logging.Handler):
    """A progress artifact that follows the steps of a run; see `epipole.flows.night.progress`."""

    def __init__(self) -> None:
        super().__init__()
        self._id: UUID | None = None
        self._next_s = 0.0
        self._percent = 0.0
        with _as_warning("progress"):
            self._id = cast(UUID, create_progress_artifact(0.0, "progress", "start"))

    def emit(self, record: logging.LogRecord) -> None:
        """Show a step, at most one every `UPDATED_EVERY_S`."""
        counts = vars(record)
        if self._id is None or time.monotonic() < self._next_s or counts["stage"] == COMPILE:
            return
        self._show(counts["percent"], f"{counts['stage']}: {counts['done']} of {counts['total']}")

    def finish(self, how: str) -> None:
        """Show how the run ended."""
        if self._id is not None:
            self._show(100.0, how)

    def _show(self, percent: float, description: str) -> None:
        self._percent = max(self._percent, percent)  # a stage may run twice
        artifact, self._id = self._id, None  # after an error it is not updated again
        with _as_warning("progress"):
            if artifact is not None:
                update_progress_artifact(artifact, self._percent, description)
            self._id = artifact
            self._next_s = time.monotonic() + UPDATED_EVERY_S


def show_summary(summary: Summary) -> None:
    """Show the results of a run: its counts and where its nights are, and a table of sensors."""
    nights = ", ".join(summary.nights)
    with _as_warning("the summary"):
        create_markdown_artifact(as_markdown(summary), "night", f"Night {nights}")
        rows = [
            sensor.as_row() | {"sensor": as_line(sensor.sensor_id, LONGEST_ID)}
            for sensor in summary.by_sensor
        ]
        create_table_artifact(rows, "sensors", f"Sensors of {nights}")


def as_markdown(summary: Summary) -> str:
    """Return the summary as a page of Markdown."""
    counts = {
        "logs": summary.logs,
        "frames": summary.frames,
        "identified by stars": summary.identified,
        "stars": summary.stars,
        "detections": summary.detections,
        "tracklets": summary.tracklets,
        "objects": summary.objects,
        "epochs": summary.epochs,
        "positions": summary.positions,
    } | {
        f"{of} {status}": count
        for of, counts in (
            ("objects", summary.doubtful()),
            ("objects", summary.names),
            ("tracklets", summary.tracklet_names),
        )
        for status, count in counts.items()
    }
    lines = [f"# Night {', '.join(summary.nights)}", "", *_table("what", counts), ""]
    if summary.unchanged:
        lines += ["Nothing has changed since it was made, so it was not made again.", ""]
    if summary.extracts:
        lines += [f"Report: {as_markdown_text(path)}" for path in report_paths(summary)] + [""]
    # No link: browsers open neither files nor buckets from a page.
    lines += ["Tables:", "", *(f"- {as_markdown_text(path)}" for path in _table_paths(summary))]
    for heading, sentences in (
        ("Needs a look:", summary.needs_look()),
        ("Nights before:", summary.earlier),
        ("Mistakes in the logs:", summary.mistakes),
        ("Sensors at fault:", summary.faults),
    ):
        if sentences:
            lines += ["", heading, "", *(f"- {as_markdown_text(each)}" for each in sentences)]
    if summary.residuals:
        lines += ["", "Known objects, observed minus predicted:", ""]
        lines += [f"- {as_markdown_text(residual)}" for residual in summary.residuals]
    if summary.rejects:
        lines += ["", f"Left out: {many(sum(summary.rejects.values()), 'thing')}", ""]
        lines += _left_out(summary.rejects)
    for extract in summary.extracts:
        lines += _extract(extract)
    return "\n".join(lines) + "\n"


def _left_out(rejects: Mapping[str, int]) -> list[str]:
    rows = [
        f"| {reason} | {count:,} | {Reason(reason).sentence} |" for reason, count in rejects.items()
    ]
    return ["| reason | count | meaning |", "|---|---:|---|", *rows]


def _extract(extract: ReportExtract) -> list[str]:
    """Return a night's pictures, as data in their addresses, and its gaps by sensor."""
    lines = ["", f"## Report of {extract.night}"]
    for picture in extract.pictures:
        data = base64.b64encode(picture.png).decode()
        lines += ["", f"![{as_markdown_text(picture.alt)}](data:image/png;base64,{data})"]
    if extract.lost_s:
        lines += ["", "| sensor | gaps | seconds without frames |", "|---|---:|---:|"]
        for sensor, lost_s in list(extract.lost_s.items())[:MAX_SENSORS]:
            count = sum(gap.sensor_id == sensor for gap in extract.gaps)
            name = as_markdown_text(sensor, LONGEST_ID)
            lines.append(f"| {name} | {count:,} | {lost_s:,.0f} |")
    return lines


def _table_paths(summary: Summary) -> list[str]:
    return [f"{summary.dataset.rstrip('/')}/night={night}" for night in summary.nights]


def report_paths(summary: Summary) -> list[str]:
    """Return where the reports of the nights lie, which have extracts."""
    return [report_location(summary.dataset, extract.night) for extract in summary.extracts]


def _table(heading: str, counts: dict[str, int]) -> list[str]:
    rows = [f"| {key} | {count:,} |" for key, count in counts.items()]
    return [f"| {heading} | count |", "|---|---:|", *rows]


# The rest of the page, and the result of the flow.

P = ParamSpec("P")

# How the flow of this context has ended: what it returned or raised.
_ENDED: ContextVar[list[Summary | BaseException]] = ContextVar("ended")


def shown_on_page(flow: Callable[P, Summary]) -> Callable[P, State[Summary]]:
    """Return the flow's function, with its log lines, progress and summary on Prefect's page."""

    @functools.wraps(flow)
    def shown(*args: P.args, **kwargs: P.kwargs) -> State[Summary]:
        bar = ProgressBar()
        with _added(ROOT, _RunLog(logging.INFO)), _added(STEPS, bar), _errors_in_one_line():
            try:
                summary = flow(*args, **kwargs)
            except NoFramesError as error:  # nothing is wrong with the run
                _ended(error)
                bar.finish("no frames")
                return Completed(message=f"no frames: {error}", data=error)
            except EpipoleError as error:  # raised, it would be a traceback in the run's log
                _ended(error)
                bar.finish("failed; see the log")
                return Failed(message=str(error), data=error)
            except BaseException as error:
                _ended(error)
                bar.finish("failed; see the log")
                raise
            _ended(summary)
            bar.finish("done")
            show_summary(summary)
            # The page, and --watch, show the message.
            message = "; report: ".join([summary.sentence(), *report_paths(summary)[-1:]])
            return Completed(message=message, data=summary)

    return shown


def tell(dataset: str, night: str, message: str) -> None:
    """Emit the event that automations act on: a night needs a look. Only in a deployment."""
    if deployment.id is None:
        return
    with _as_warning("what needs a look"):
        emit_event(
            event=NEEDS_LOOK,
            resource={
                "prefect.resource.id": f"epipole.night.{night}",
                "prefect.resource.name": f"night {night}",
                "epipole.dataset": dataset,
                "epipole.message": message,
                "epipole.report": report_location(dataset, night),
            },
        )


def _ended(how: Summary | BaseException) -> None:
    """Tell `run_here`; a function, as Dask pickles the flow with the variables that it names."""
    _ENDED.get([]).append(how)


def run_here(flow: Flow[P, Any], *args: P.args, **kwargs: P.kwargs) -> Summary:
    """Run a flow that is `shown_on_page`, and return its summary as this process made it.

    Prefect's function takes the result out of the last state, and the server may answer with a
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


@contextlib.contextmanager
def _errors_in_one_line() -> Iterator[None]:
    """Leave the tracebacks of errors that a user can put right out of Prefect's lines."""

    def shorten(record: logging.LogRecord) -> bool:
        if record.exc_info and isinstance(record.exc_info[1], EpipoleError):
            record.exc_info = None
        return True

    loggers = [logging.getLogger(name) for name in ("prefect.flow_runs", "prefect.task_runs")]
    # For good: in a deployment Prefect's engine writes its last lines after the flow.
    for logger in (loggers[0], logging.getLogger("prefect.engine")):
        logger.addFilter(_is_no_epipole_error)
    for logger in loggers:
        logger.addFilter(shorten)
    try:
        yield
    finally:
        for logger in loggers:
            logger.removeFilter(shorten)


def _is_no_epipole_error(record: logging.LogRecord) -> bool:
    """Return whether a line is not about an error that the run's state has said already."""
    is_last = "exited with unexpected exception" in str(record.msg)
    error = record.exc_info[1] if record.exc_info else None
    return not (is_last and isinstance(error, EpipoleError))


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
