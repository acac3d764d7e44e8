"""Reads and writes that are done two times in a row, in one process.

The second one meets what the first has left: open connections, listings, cached clients.
"""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from epipole.schemas.errors import EpipoleError

P = ParamSpec("P")
R = TypeVar("R")


def twice(work: Callable[P, R]) -> Callable[P, R]:
    """Return a function that does the work two times, and asserts that both ended alike."""

    @functools.wraps(work)
    def both(*args: P.args, **named: P.kwargs) -> R:
        ended = []
        for _ in range(2):
            try:
                ended.append((work(*args, **named), None))
            except EpipoleError as error:
                ended.append((None, error))
        (value, error), (again, other) = ended
        assert (type(other), str(other)) == (type(error), str(error))
        if error is not None:
            raise error
        assert again == value
        return value

    return both
