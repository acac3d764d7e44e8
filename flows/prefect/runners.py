"""What runs the tasks of a run: threads of this process, or Dask."""

import logging
import os
from typing import Any

from prefect.task_runners import TaskRunner, ThreadPoolTaskRunner

from epipole.schemas.errors import EpipoleError
from epipole.schemas.runner import Runner


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
        }
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
