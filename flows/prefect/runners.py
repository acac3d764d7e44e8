"""What runs the tasks of a run: threads of this process, or Dask."""

import asyncio
import logging
import os
from typing import Any

from prefect.task_runners import TaskRunner, ThreadPoolTaskRunner

from epipole.io.paths import line_of
from epipole.schemas.errors import EpipoleError
from epipole.schemas.options import Runner

ANSWERS_WITHIN_S = 5.0


def task_runner(
    runner: Runner, workers: int | None = None, scheduler: str | None = None
) -> TaskRunner[Any]:
    """Return the task runner of a flow.

    Parameters
    ----------
    workers
        Tasks at the same time; default: one per CPU.
    scheduler
        Address of a running Dask scheduler. Its workers need epipole and access to the dataset's
        storage. Default: Dask processes on this machine.

    Raises
    ------
    EpipoleError
        Where Dask is not installed, or a scheduler is given for threads.
    """
    count = workers or os.cpu_count() or 1
    if runner == Runner.threads:
        if scheduler is not None:
            raise EpipoleError(
                f"scheduler {scheduler}: only Dask has a scheduler; choose --runner dask"
            )
        return ThreadPoolTaskRunner(max_workers=count)
    try:
        from prefect_dask.task_runners import DaskTaskRunner
    except ImportError as error:
        raise EpipoleError(
            "runner dask: Dask is not installed; python -m pip install 'epipole[dask]'"
        ) from error
    if scheduler is not None:
        return DaskTaskRunner(address=scheduler)
    # It logs a warning for every worker that ends with the run.
    logging.getLogger("distributed.nanny").setLevel(logging.ERROR)
    quiet = {"PREFECT_LOGGING_HANDLERS_CONSOLE_LEVEL": "WARNING"}
    return DaskTaskRunner(
        cluster_kwargs={
            "n_workers": count,
            "threads_per_worker": 1,
            "dashboard_address": None,
            "env": quiet,
            # Its sockets take code from whoever connects: only holders of a key may.
            "security": True,
        }
    )


def check_scheduler(address: str) -> None:
    """Raise unless a Dask scheduler answers. Prefect waits longer, and ends with a traceback.

    Raises
    ------
    EpipoleError
        Where nothing answers, or something else does.
    """
    try:
        kind = asyncio.run(asyncio.wait_for(_kind_of(address), ANSWERS_WITHIN_S))
    # MemoryError: bytes of something else, read as the length of an answer.
    except (OSError, ValueError, MemoryError) as error:
        raise _no_scheduler(address, f"does not answer ({line_of(error)})") from error
    if kind != "Scheduler":
        raise _no_scheduler(address, f"is a {kind}")


async def _kind_of(address: str) -> str:
    """Return what a Dask process is: a Scheduler or a Worker."""
    from distributed import Security
    from distributed.core import rpc

    arguments = Security().get_connection_args("client")
    async with rpc(address, timeout=ANSWERS_WITHIN_S, connection_args=arguments) as process:
        identity: dict[str, str] = await process.identity()
    return identity["type"]


def _no_scheduler(address: str, why: str) -> EpipoleError:
    return EpipoleError(
        f"scheduler {address}: {why}; start one (dask scheduler), or leave --scheduler out"
    )


def runner_asked() -> TaskRunner[Any]:
    """Return the task runner that the environment variables name; a deployment sets them.

    EPIPOLE_RUNNER ("threads", "dask"), EPIPOLE_WORKERS and EPIPOLE_SCHEDULER.

    Raises
    ------
    EpipoleError
        Where a value is invalid.
    """
    name = os.environ.get("EPIPOLE_RUNNER", Runner.threads)
    workers = os.environ.get("EPIPOLE_WORKERS")
    if name not in list(Runner):
        raise EpipoleError(f"EPIPOLE_RUNNER={name}: give one of {', '.join(Runner)}")
    if workers is not None and not (workers.isdecimal() and int(workers)):
        raise EpipoleError(f"EPIPOLE_WORKERS={workers}: give a number of tasks, 1 or more")
    return task_runner(
        Runner(name), int(workers) if workers else None, os.environ.get("EPIPOLE_SCHEDULER")
    )
