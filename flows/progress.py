"""How far a run is: lines of log everywhere, a moving bar on a terminal.

Stages say what they did as log records; a record that carries a stage's name and counts
moves the bar. So a flow knows nothing of terminals.
"""

import contextlib
import logging
import sys
from collections.abc import Iterator, Sequence
from typing import Any

from prefect.futures import PrefectFuture
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

ROOT = logging.getLogger("epipole")
LOGGER = logging.getLogger(__name__)


def step(stage: str, done: int, total: int) -> None:
    """Say that so many of a stage's tasks are done."""
    LOGGER.debug(
        "%s: %d of %d", stage, done, total, extra={"stage": stage, "done": done, "total": total}
    )


def results(stage: str, futures: Sequence[PrefectFuture[Any]]) -> list[Any]:
    """Return what the tasks of a stage return, in the order they were submitted.

    The order does not depend on which ends first, so neither does what is made of it.
    """
    found = []
    step(stage, 0, len(futures))
    for future in futures:
        found.append(future.result())
        step(stage, len(found), len(futures))
    return found


@contextlib.contextmanager
def shown(quiet: bool, verbose: bool) -> Iterator[None]:
    """Show how a run goes on standard error: a bar on a terminal, plain lines elsewhere."""
    if quiet:
        ROOT.addHandler(logging.NullHandler())  # or Python prints warnings by itself
        ROOT.propagate = False
        yield
        return
    level = ROOT.level
    with contextlib.ExitStack() as stack:
        if sys.stderr.isatty():
            handler: logging.Handler = StageDisplay(stack)
            ROOT.setLevel(logging.DEBUG)
        else:
            handler = logging.StreamHandler()
            handler.setFormatter(logging.Formatter("%(asctime)s %(message)s", "%H:%M:%S"))
            ROOT.setLevel(logging.INFO)
        if not verbose:
            handler.addFilter(_is_of_the_flow)
        ROOT.addHandler(handler)
        stack.callback(ROOT.removeHandler, handler)
        stack.callback(ROOT.setLevel, level)
        yield


def _is_of_the_flow(record: logging.LogRecord) -> bool:
    """Tell a stage's line from those of its tasks, of which a night has thousands."""
    return record.levelno >= logging.WARNING or record.name.startswith("epipole.flows.")


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
            if record.levelno >= logging.INFO:
                self._bar.console.print(record.getMessage(), highlight=False, markup=False)
            return
        if stage != self._stage:
            self._bar.remove_task(self._task)
            self._stage, self._task = stage, self._bar.add_task(stage)
        counts = vars(record)
        self._bar.update(self._task, completed=counts["done"], total=counts["total"])
