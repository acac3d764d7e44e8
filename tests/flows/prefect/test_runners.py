"""The same night on threads and on Dask, on one worker or more, and when a worker is killed."""

import os
import signal
import threading
import time

import pytest
from prefect.task_runners import ThreadPoolTaskRunner
from scenes.dataset_tables import contents

from epipole.flows.nightly import nightly
from epipole.flows.prefect.runners import check_scheduler, runner_asked, task_runner
from epipole.io.work.folder import work_root
from epipole.schemas.errors import EpipoleError
from epipole.schemas.options import Runner

pytestmark = pytest.mark.long


def test_threads_are_the_default_one_a_cpu(monkeypatch):
    for name in ("EPIPOLE_RUNNER", "EPIPOLE_WORKERS", "EPIPOLE_SCHEDULER"):
        monkeypatch.delenv(name, raising=False)
    runner = runner_asked()
    assert isinstance(runner, ThreadPoolTaskRunner)
    assert runner._max_workers == os.cpu_count()


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"EPIPOLE_RUNNER": "spark"}, "EPIPOLE_RUNNER=spark: give one of threads, dask"),
        ({"EPIPOLE_WORKERS": "many"}, "EPIPOLE_WORKERS=many: give a number of tasks"),
        ({"EPIPOLE_SCHEDULER": "tcp://a:1"}, "scheduler tcp://a:1: only Dask has"),
    ],
)
def test_invalid_environment_variables_are_named(monkeypatch, asked, said):
    for name, value in asked.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(EpipoleError, match=said):
        runner_asked()


def test_a_running_dask_gives_the_same_bytes(prefect, night_log, night_dataset, tmp_path):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None
    ) as cluster:
        runner = task_runner(Runner.dask, scheduler=cluster.scheduler_address)
        nightly.with_options(task_runner=runner)([str(night_log)], str(tmp_path / "out"))
    assert contents(tmp_path / "out") == contents(night_dataset)


def test_a_killed_dask_worker_is_replaced_and_the_night_is_the_same(
    prefect, night_log, night_dataset, tmp_path
):
    distributed = pytest.importorskip("distributed")
    out = tmp_path / "out"
    killed = []
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None
    ) as cluster:

        def kill_one() -> None:
            while not list(work_root(str(out)).glob("work-*/identify/*/*")):
                time.sleep(0.01)
            killed.append(next(iter(cluster.workers.values())).pid)
            os.kill(killed[0], signal.SIGKILL)

        killer = threading.Thread(target=kill_one, daemon=True)
        killer.start()
        runner = task_runner(Runner.dask, scheduler=cluster.scheduler_address)
        nightly.with_options(task_runner=runner)([str(night_log)], str(out))
    assert killed
    assert contents(out) == contents(night_dataset)


@pytest.mark.parametrize(
    ("address", "why"),
    [
        ("tcp://127.0.0.1:1", r"does not answer \("),
        ("nowhere", r"does not answer \(missing port"),
        ("pigeon://a:1", r"does not answer \(unknown address scheme"),
    ],
)
def test_a_scheduler_that_does_not_answer_is_said_soon(address, why):
    pytest.importorskip("distributed")
    started_s = time.monotonic()
    with pytest.raises(EpipoleError, match=f"^scheduler {address}: {why}"):
        check_scheduler(address)
    assert time.monotonic() - started_s < 10


def test_only_a_scheduler_is_a_scheduler():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address=None
    ) as cluster:
        check_scheduler(cluster.scheduler_address)
        with pytest.raises(EpipoleError, match="is a Worker; start one"):
            check_scheduler(cluster.workers[0].worker_address)
