"""What a run shows on standard error: bars on a terminal, plain lines elsewhere."""

import contextlib
import logging
import sys
import time
from collections.abc import Iterator

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from epipole.flows.night.progress import COMPILE, ROOT, STEPS, with_safe_text
from epipole.schemas.text import as_line

LINE_EVERY_S = 30.0  # progress, where there is no terminal


@contextlib.contextmanager
def shown(quiet: bool, verbose: bool) -> Iterator[None]:
    """Show the progress of a run on standard error."""
    if quiet:
        ROOT.addHandler(logging.NullHandler())  # without any handler Python prints warnings
        ROOT.propagate = False
        yield
        return
    level = ROOT.level
    with contextlib.ExitStack() as stack:
        handler: logging.Handler
        if sys.stderr.isatty():
            handler = StageDisplay(stack)
        else:
            handler = PlainLines()
            handler.setFormatter(_OneLine("%(asctime)s %(message)s", "%H:%M:%S"))
        STEPS.addHandler(handler)
        stack.callback(STEPS.removeHandler, handler)
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


class PlainLines(logging.StreamHandler):  # type: ignore[type-arg]
    """The lines of the stages; where a stage is long, now and then a line of its progress."""

    def __init__(self) -> None:
        super().__init__()
        self._written_s = time.monotonic()

    def emit(self, record: logging.LogRecord) -> None:
        """Write a line; a step of the progress only if nothing was written for a while."""
        now_s = time.monotonic()
        counts = vars(record)
        if record.name == STEPS.name:
            if now_s - self._written_s < LINE_EVERY_S or not counts["done"]:
                return
            if counts["stage"] != COMPILE and counts["done"] == counts["total"]:
                return  # the line of the stage follows
        self._written_s = now_s
        super().emit(record)


class StageDisplay(logging.Handler):
    """A bar for the stage that runs, below the lines of the stages that have ended.

    While kernels are compiled, they have their bar.
    """

    def __init__(self, stack: contextlib.ExitStack) -> None:
        super().__init__()
        self._bars = stack.enter_context(
            Progress(
                TextColumn("{task.description:<14}"),
                BarColumn(bar_width=None),
                MofNCompleteColumn(),
                TimeElapsedColumn(),
                TextColumn("left"),
                TimeRemainingColumn(),
                console=Console(stderr=True),
                transient=True,
                expand=True,
            )
        )
        self._stage: str | None = None
        self._task = self._bars.add_task("start", total=None)
        self._compile: TaskID | None = None

    def emit(self, record: logging.LogRecord) -> None:
        """Move a bar, or print a line above the bars."""
        stage: str | None = getattr(record, "stage", None)
        if stage is None:
            self._bars.console.print(as_line(record.getMessage()), highlight=False, markup=False)
            return
        counts = vars(record)
        done, total = counts["done"], counts["total"]
        if stage == COMPILE:
            self._show_compiling(done, total)
            return
        part, parts = counts["part"]
        shown = stage if parts == 1 else f"{stage} {part + 1}/{parts}"
        if shown != self._stage:
            self._bars.remove_task(self._task)
            self._stage, self._task = shown, self._bars.add_task(shown, total=total or None)
        self._bars.update(self._task, completed=done, total=total or None)

    def _show_compiling(self, done: int, total: int) -> None:
        """Show the bar of compiling; it goes when all is compiled that the run is known to need."""
        if done >= total > 0:
            if self._compile is not None:
                self._bars.remove_task(self._compile)
            self._compile = None
            return
        if self._compile is None:
            self._compile = self._bars.add_task(COMPILE, total=total or None)
        self._bars.update(self._compile, completed=done)
