"""A line of a command that has to compile first: once after an install, or for a rare method."""

import sys
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec

P = ParamSpec("P")


def tells_compiling(command: Callable[P, None]) -> Callable[P, None]:
    """Return a command that says on standard error when it compiles."""

    @wraps(command)
    def called(*args: P.args, **kwargs: P.kwargs) -> None:
        from epipole.io.caches.kernel_warm_up import compiling_told

        said: list[int] = []

        def say(new: int, _: int) -> None:
            if not said:
                said.append(new)
                print("compiling; only the first time", file=sys.stderr, flush=True)

        with compiling_told(say):
            command(*args, **kwargs)

    return called
