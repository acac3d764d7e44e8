"""Progress of a run: log lines, and a progress bar on a terminal and on Prefect's page.

Stages log what they did. Their progress goes to a separate logger, `STEPS`, which moves the bars
and prints nothing. So the stages do not depend on terminals or pages.
"""

import contextlib
import copy
import itertools
import logging
import sys
from collections.abc import Iterator, Sequence
from typing import Any, Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from epipole.schemas.stages import Stage
from epipole.schemas.text.shown import as_line

ROOT = logging.getLogger("epipole")
STEPS = logging.getLogger("epipole.steps")
STEPS.propagate = False
STEPS.setLevel(logging.INFO)

# The share of each stage in the run time of a night (%), measured on half an hour of four sensors
# at 5 Hz.
_SHARES = {
    Stage.READ: 4,
    Stage.IDENTIFY: 55,
    Stage.CALIBRATE: 3,
    Stage.TRACK: 16,
    Stage.SOLVE: 15,
    Stage.CHECK: 0,
    Stage.NAME: 1,
    Stage.PUBLISH: 6,
}
_BEFORE = dict(zip(Stage, itertools.accumulate((_SHARES[s] for s in Stage), initial=0)))  # noqa: B905


def step(stage: Stage, done: int, total: int, part: tuple[int, int] = (0, 1)) -> None:
    """Report how many tasks are done: of a stage, or of one of its parts, such as (1, 4)."""
    share = _SHARES[stage] * (part[0] + (done / total if total else 0.0)) / part[1]
    _send(stage.value, done, total, min(100.0, _BEFORE[stage] + share))


def prepare(what: str) -> None:
    """Report what is done before the first stage, such as compiling."""
    _send(what, 0, 1, 0.0)


def _send(what: str, done: int, total: int, percent: float) -> None:
    counts = {"stage": what, "done": done, "total": total, "percent": percent}
    STEPS.info("%s: %d of %d", what, done, total, extra=counts)


class Future(Protocol):
    """What a task returns that was submitted: Prefect's future."""

    def result(self) -> Any:
        """Wait for the task, and return its result."""


def results(stage: Stage, futures: Sequence[Future], part: tuple[int, int] = (0, 1)) -> list[Any]:
    """Return the results of a stage's tasks, or of a part's, in the order of submission.

    So the rows of a night do not depend on which task ends first.
    """
    returned = []
    step(stage, 0, len(futures), part)
    for future in futures:
        returned.append(future.result())
        step(stage, len(returned), len(futures), part)
    return returned


@contextlib.contextmanager
def shown(quiet: bool, verbose: bool) -> Iterator[None]:
    """Show the progress of a run on standard error: a bar on a terminal, plain lines elsewhere."""
    if quiet:
        ROOT.addHandler(logging.NullHandler())  # without any handler Python prints warnings
        ROOT.propagate = False
        yield
        return
    level = ROOT.level
    with contextlib.ExitStack() as stack:
        if sys.stderr.isatty():
            handler: logging.Handler = StageDisplay(stack)
            STEPS.addHandler(handler)
            stack.callback(STEPS.removeHandler, handler)
        else:
            handler = logging.StreamHandler()
            handler.setFormatter(_OneLine("%(asctime)s %(message)s", "%H:%M:%S"))
        ROOT.setLevel(logging.INFO)
        propagates, ROOT.propagate = ROOT.propagate, False  # or Prefect's console shows them again
        stack.callback(setattr, ROOT, "propagate", propagates)
        if not verbose:
            handler.addFilter(_is_of_the_flow)
            handler.addFilter(_Once())
        ROOT.addHandler(handler)
        stack.callback(ROOT.removeHandler, handler)
        stack.callback(ROOT.setLevel, level)
        yield


def _is_of_the_flow(record: logging.LogRecord) -> bool:
    """Return whether to show a record: progress, warnings, and lines of stages but not of their
    many tasks."""
    of_the_flow = record.name.startswith(("epipole.flows.", STEPS.name))
    return of_the_flow or record.levelno >= logging.WARNING


class _Once(logging.Filter):
    """Lets each warning pass once; a night that is solved again would give it again."""

    def __init__(self) -> None:
        super().__init__()
        self._said: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        if record.levelno < logging.WARNING:
            return True
        message = record.getMessage()
        is_new = message not in self._said
        self._said.add(message)
        return is_new


class _OneLine(logging.Formatter):
    """Escapes what a log or a file name brings into a message."""

    def format(self, record: logging.LogRecord) -> str:
        return super().format(with_safe_text(record))


def with_safe_text(record: logging.LogRecord) -> logging.LogRecord:
    """Return the record with its message as one line that can be shown."""
    safe = copy.copy(record)
    safe.msg, safe.args = as_line(record.getMessage()), None
    return safe


class StageDisplay(logging.Handler):
    """One bar for the stage that runs, below the lines of the stages that have ended."""

    def __init__(self, stack: contextlib.ExitStack) -> None:
        super().__init__()
        self._bar = stack.enter_context(
            Progress(
                TextColumn("{task.description:<20}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeElapsedColumn(),
                console=Console(stderr=True),
                transient=True,
            )
        )
        self._stage: str | None = None
        self._task = self._bar.add_task("start", total=None)

    def emit(self, record: logging.LogRecord) -> None:
        """Move the bar, or print a line above it."""
        stage: str | None = getattr(record, "stage", None)
        if stage is None:
            self._bar.console.print(as_line(record.getMessage()), highlight=False, markup=False)
            return
        if stage != self._stage:
            self._bar.remove_task(self._task)
            self._stage, self._task = stage, self._bar.add_task(stage)
        counts = vars(record)
        self._bar.update(self._task, completed=counts["done"], total=counts["total"])
