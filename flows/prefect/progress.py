"""How far a run is: lines of log everywhere, a moving bar on a terminal and on Prefect's page.

Stages say what they did as log records. How far they are they say as records of a logger of
its own, `STEPS`, which moves the bars and prints nothing. So a flow knows nothing of terminals
and pages.
"""

import contextlib
import itertools
import logging
import sys
from collections.abc import Iterator, Sequence
from typing import Any

from prefect.futures import PrefectFuture
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

ROOT = logging.getLogger("epipole")
STEPS = logging.getLogger("epipole.steps")
STEPS.propagate = False
STEPS.setLevel(logging.INFO)

# The stages in their order, with their shares in the time of a night (%), as measured on half
# an hour of four sensors at 5 Hz.
_SHARES = {
    "read logs": 4,
    "identify stars": 55,
    "calibrate sensors": 3,
    "build tracklets": 15,
    "join tracklets": 1,
    "solve objects": 15,
    "link objects": 1,
    "publish": 7,
}
_BEFORE = dict(zip(_SHARES, itertools.accumulate(_SHARES.values(), initial=0), strict=False))


def step(stage: str, done: int, total: int) -> None:
    """Say that so many of a stage's tasks are done."""
    share = _SHARES.get(stage, 0) * done / total if total else 0.0
    percent = min(100.0, _BEFORE.get(stage, 0) + share)
    counts = {"stage": stage, "done": done, "total": total, "percent": percent}
    STEPS.info("%s: %d of %d", stage, done, total, extra=counts)


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
            STEPS.addHandler(handler)
            stack.callback(STEPS.removeHandler, handler)
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
            self._bar.console.print(record.getMessage(), highlight=False, markup=False)
            return
        if stage != self._stage:
            self._bar.remove_task(self._task)
            self._stage, self._task = stage, self._bar.add_task(stage)
        counts = vars(record)
        self._bar.update(self._task, completed=counts["done"], total=counts["total"])
