"""Which failures of a task are worth another try: those of storage that may pass by themselves."""

import errno
import sys
from collections.abc import Iterator
from typing import Any

from prefect import Task
from prefect.client.schemas.objects import State, TaskRun

RETRIES = 3
DELAYS_S = [2.0, 10.0, 30.0]

# What a second try finds just as it was.
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
    """Tell whether a task failed because its storage did; what is wrong with a log stays wrong."""
    error = state.data if isinstance(state.data, BaseException) else _error_of(state)
    return any(_may_pass(cause) for cause in _causes(error))


def _error_of(state: State[Any]) -> BaseException | None:
    found = state.result(raise_on_failure=False)
    return found if isinstance(found, BaseException) else None


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error and what it was raised from."""
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
