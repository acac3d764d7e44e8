"""The decorator of the stages' tasks: names, retries, and memory that goes back to the system."""

import contextlib
import ctypes
import errno
import resource
import sys
from collections.abc import Callable, Iterator
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar

import pyarrow as pa
from prefect import Task, task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State, TaskRun

from epipole.schemas.stages import Stage

# Memory.


# By which the process may grow before it returns what it has freed [bytes]. With 128 staring
# sensors, returning it after each task took 5 % of the CPU: the system clears each page that is
# asked for again. Twice this bound needed 40 MiB more.
MAX_GROWTH_BYTES = 32 << 20
_PAGE = resource.getpagesize()
_after_bytes = 0  # memory of the process after the last time


def give_back_memory() -> None:
    """Return freed memory to the system, if the process has grown.

    Allocators keep it for later. The tasks of a night would add up: each keeps what the largest
    one needed.
    """
    global _after_bytes
    before = _resident_bytes()
    if before is not None and before - _after_bytes < MAX_GROWTH_BYTES:
        return
    pa.default_memory_pool().release_unused()
    if sys.platform == "linux":
        with contextlib.suppress(AttributeError):  # a C library other than glibc
            ctypes.CDLL(None).malloc_trim(0)
    _after_bytes = _resident_bytes() or 0


def _resident_bytes() -> int | None:
    """Return the memory of this process; None where the system does not say."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * _PAGE
    except OSError:
        return None


# Retries: after failures of storage that may be temporary.

RETRIES = 3
DELAYS_S = [2.0, 10.0, 30.0]

# Errors that a second try would meet again.
_LASTING = (
    FileNotFoundError,
    FileExistsError,
    IsADirectoryError,
    NotADirectoryError,
    PermissionError,
)
_LASTING_CODES = {
    errno.EDQUOT, errno.EFBIG, errno.EINVAL, errno.ELOOP, errno.ENAMETOOLONG, errno.ENOSPC,
    errno.EROFS,
}  # fmt: skip


def storage_failed(_task: Task[..., Any], _run: TaskRun, state: State[Any]) -> bool:
    """Return whether a task failed because of its storage, and not of a bad log or a bug."""
    error = state.data if isinstance(state.data, BaseException) else _error_of(state)
    return any(_may_pass(cause) for cause in _causes(error))


def _error_of(state: State[Any]) -> BaseException | None:
    result = state.result(raise_on_failure=False)
    return result if isinstance(result, BaseException) else None


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error, then the errors that caused it."""
    while error is not None:
        yield error
        error = error.__cause__


def _may_pass(error: BaseException) -> bool:
    if isinstance(error, OSError):  # time-outs and broken connections too
        return not isinstance(error, _LASTING) and error.errno not in _LASTING_CODES
    client = sys.modules.get("botocore.exceptions")
    if client is None:
        return False
    if isinstance(error, client.ClientError):
        code = error.response.get("ResponseMetadata", {}).get("HTTPStatusCode", 0)
        return code == 429 or code >= 500
    return isinstance(error, client.HTTPClientError | client.ConnectionError)


# The decorator: a task is named by its stage, a task run by the stage and its work.

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
