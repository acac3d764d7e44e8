"""Progress of a run: what its stages report to a terminal and to Prefect's page.

Stages log what they did. Their progress goes to a separate logger, `STEPS`, which moves the bars
and prints nothing. So the stages do not depend on terminals or pages.
"""

import copy
import itertools
import logging
from collections.abc import Sequence
from typing import Any, Protocol, TypeVar

from epipole.schemas.stages import Stage
from epipole.schemas.text import as_line

T = TypeVar("T")

ROOT = logging.getLogger("epipole")
STEPS = logging.getLogger("epipole.steps")
STEPS.propagate = False
STEPS.setLevel(logging.INFO)
COMPILE = "compile"  # not a stage: runs beside the first ones

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
    _send(stage.value, (done, total), part, min(100.0, _BEFORE[stage] + share))


def prepare(what: str) -> None:
    """Report what is done before the first stage, such as the start of Prefect."""
    _send(what, (0, 0), (0, 1), 0.0)


def compile_step(done: int, total: int) -> None:
    """Report how many kernels are compiled, beside whatever stage runs."""
    _send(COMPILE, (done, total), (0, 1), 0.0)


def _send(what: str, count: tuple[int, int], part: tuple[int, int], percent: float) -> None:
    done, total = count
    counts = {"stage": what, "done": done, "total": total, "part": part, "percent": percent}
    shown = f"{done} of {total}" if total else str(done)  # how many there will be may be unknown
    STEPS.info("%s: %s", what, shown, extra=counts)


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


def flat(lists: Sequence[Sequence[T]]) -> list[T]:
    """Return the results of a stage's tasks, each a list, as one list."""
    return list(itertools.chain.from_iterable(lists))


def with_safe_text(record: logging.LogRecord) -> logging.LogRecord:
    """Return the record with its message as one line that can be shown."""
    safe = copy.copy(record)
    safe.msg, safe.args = as_line(record.getMessage()), None
    return safe
