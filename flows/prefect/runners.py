"""Where the tasks of a run are worked on: threads of one machine, or Dask."""

import logging
import os
from typing import Any

from prefect.task_runners import TaskRunner, ThreadPoolTaskRunner

from epipole.schemas.errors import EpipoleError
from epipole.schemas.runner import Runner


def task_runner(
    runner: Runner, workers: int | None = None, scheduler: str | None = None
) -> TaskRunner[Any]:
    """Return what a flow hands its tasks to.

    Parameters
    ----------
    workers
        Tasks at once; none: one a CPU.
    scheduler
        With Dask, the address of a running one, whose workers share the dataset's storage with
        this process and have epipole installed; none: processes of this machine.

    Raises
    ------
    EpipoleError
        Dask is not installed, or a scheduler is named for threads.
    """
    count = workers or os.cpu_count() or 1
    if runner == Runner.threads:
        if scheduler is not None:
            raise EpipoleError(f"scheduler {scheduler}: threads have none; choose --runner dask")
        return ThreadPoolTaskRunner(max_workers=count)
    try:
        from prefect_dask.task_runners import DaskTaskRunner
    except ImportError as error:
        raise EpipoleError(
            "runner dask: Dask is not installed; python -m pip install 'epipole[dask]'"
        ) from error
    if scheduler is not None:
        return DaskTaskRunner(address=scheduler)
    # It says so of every worker that ends with the run.
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
    """Return the task runner that the environment asks for: what a deployment's job sets.

    EPIPOLE_RUNNER ("threads", "dask"), EPIPOLE_WORKERS and EPIPOLE_SCHEDULER.

    Raises
    ------
    EpipoleError
        Where they make no sense.
    """
    asked = os.environ.get("EPIPOLE_RUNNER", Runner.threads)
    workers = os.environ.get("EPIPOLE_WORKERS")
    if asked not in list(Runner):
        raise EpipoleError(f"EPIPOLE_RUNNER={asked}: give one of {', '.join(Runner)}")
    if workers is not None and not (workers.isdecimal() and int(workers)):
        raise EpipoleError(f"EPIPOLE_WORKERS={workers}: give how many tasks may run at once")
    return task_runner(
        Runner(asked), int(workers) if workers else None, os.environ.get("EPIPOLE_SCHEDULER")
    )
