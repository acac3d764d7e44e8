"""Tasks of a stage: their name is the stage, the name of a run is the stage and its work."""

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

from prefect import task
from prefect.cache_policies import NO_CACHE

from epipole.schemas.stages import Stage
from epipole.tasks.common.memory import give_back_memory
from epipole.tasks.common.retries import DELAYS_S, RETRIES, storage_failed

F = TypeVar("F", bound=Callable[..., Any])


def stage_task(stage: Stage, works_on: str, *, retried: bool = False) -> Callable[[F], Any]:
    """Return the decorator of a stage's task.

    Parameters
    ----------
    works_on
        What a run works on, by the task's parameters, such as ``{sensor} {span}``.
    retried
        Whether the task is tried again after a failure of storage.

    Notes
    -----
    Prefect caches no result: to hash the inputs would cost more than most tasks, and finished
    parts lie in the work folder. Nor does it keep results, whatever storage a server names: who
    can write there would have his pickles read.
    """
    options: dict[str, Any] = {"cache_policy": NO_CACHE, "persist_result": False}
    if retried:
        options |= {
            "retries": RETRIES,
            "retry_delay_seconds": DELAYS_S,
            "retry_condition_fn": storage_failed,
        }

    def decorated(function: F) -> Any:
        return task(name=stage.value, task_run_name=f"{stage} {works_on}".strip(), **options)(
            _giving_back(function)
        )

    return decorated


def _giving_back(function: F) -> Callable[..., Any]:
    """Return the function; what it no longer needs goes back to the system when it ends."""

    @wraps(function)
    def called(*arguments: Any, **named: Any) -> Any:
        try:
            return function(*arguments, **named)
        finally:
            give_back_memory()

    return called
