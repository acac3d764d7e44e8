"""Which failures of a task are tried again: those of storage that may be temporary."""

import errno
import sys
from collections.abc import Iterator
from typing import Any

from prefect import Task
from prefect.client.schemas.objects import State, TaskRun

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
