"""The process of a command: how it stops, what it says first, and its environment."""

import contextlib
import logging
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from functools import wraps
from pathlib import Path
from types import FrameType
from typing import NoReturn, ParamSpec

from epipole.io.caches.private_folders import private_folder

# Ctrl-C and SIGTERM.

# What a command says that ends by a signal. SIGTERM comes from schedulers.
_SAYS = {signal.SIGINT: "interrupted", signal.SIGTERM: "stopped"}
_PATIENCE_S = 20.0  # for clearing up; the next run removes what is left
_SOON_S = 0.02

_stopped_by: list[signal.Signals] = []
_has_said = threading.Event()


def stop_by_signals() -> None:
    """Let both signals end the command. Further signals change nothing: they often come twice."""
    for by in _SAYS:
        signal.signal(by, _stop)


def is_stopping() -> bool:
    """Return whether a signal has come. Its exception may have been replaced by another one."""
    return bool(_stopped_by)


@contextlib.contextmanager
def stopped_in_one_line() -> Iterator[None]:
    """Turn any exception after a signal into one line and the shell's exit code.

    A library may replace the signal's exception by another one, as pydantic does where it
    serialises.
    """
    try:
        yield
    except BaseException:
        if _stopped_by:
            _say()
            sys.exit(_exit_code())
        raise


def _stop(by: int, frame: FrameType | None) -> None:
    if _stopped_by:
        return
    if _imports(frame):  # an exception would leave the import locked for ever
        threading.Timer(_SOON_S, os.kill, (os.getpid(), by)).start()
        return
    _stopped_by.append(signal.Signals(by))
    watch = threading.Timer(_PATIENCE_S, _end)
    watch.daemon = True
    watch.start()
    logging.disable()  # from here on, libraries could only report that they are being stopped
    raise KeyboardInterrupt


def _imports(frame: FrameType | None) -> bool:
    """Return whether the main thread is inside an import, or in code that an import runs."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def _end() -> NoReturn:
    """End the process where it waits for something that does not come."""
    _say()
    os._exit(_exit_code())


def _say() -> None:
    if not _has_said.is_set():
        _has_said.set()
        print(f"epipole: {_SAYS[_stopped_by[0]]}", file=sys.stderr, flush=True)


def _exit_code() -> int:
    return 128 + _stopped_by[0]


# The line that says that kernels are compiled first.

P = ParamSpec("P")


def tells_compiling(command: Callable[P, None]) -> Callable[P, None]:
    """Return a command that says on standard error when it compiles."""

    @wraps(command)
    def called(*args: P.args, **kwargs: P.kwargs) -> None:
        from epipole.io.caches.kernel_compiler import report_compiling

        said: list[int] = []

        def say(new: int, _: int) -> None:
            if not said:
                said.append(new)
                print("compiling; only the first time", file=sys.stderr, flush=True)

        with report_compiling(say):
            command(*args, **kwargs)

    return called


# The environment: Prefect reads it when it is imported.


def prepare_environment() -> None:
    """Switch off what Prefect reports about its users, and give a home to a user without one.

    DO_NOT_TRACK covers Prefect's client, and `epipole.flows.prefect.defaults` its server. Where
    the user has set DO_NOT_TRACK, it stays as it is.
    """
    os.environ.setdefault("DO_NOT_TRACK", "1")
    # Where Prefect's home cannot be made, the embedded server says so.
    warnings.filterwarnings("ignore", "Failed to create the Prefect home")
    try:
        Path.home()
    except RuntimeError:  # the user of a container need not be known to it
        os.environ["HOME"] = str(private_folder("home"))
