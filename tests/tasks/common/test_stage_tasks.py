"""Tasks of a stage: named by it, their runs by what they work on, tried again only if asked."""

import errno
import sys

import botocore.exceptions as s3
import numpy as np
import pytest
from prefect import flow
from prefect.states import Failed

from epipole.io.logs.reader import read_log_pieces
from epipole.io.work.parts import read_part
from epipole.io.work.work_layout import ReadFolder
from epipole.schemas.errors import DatasetError, LogError
from epipole.schemas.stages import Stage
from epipole.tasks.common import stage_tasks
from epipole.tasks.common.batches import Batch
from epipole.tasks.common.stage_tasks import DELAYS_S, RETRIES, stage_task, storage_failed
from epipole.tasks.read import read_logs as module
from epipole.tasks.read.read_logs import LogToRead, read_logs


@pytest.mark.parametrize("stage", Stage)
def test_a_task_has_the_name_of_its_stage(stage):
    @stage_task(stage, "{sensor} {span}")
    def work(sensor, span):
        return sensor, span

    assert work.name == stage.value
    assert work.task_run_name == f"{stage} {{sensor}} {{span}}"
    assert work.fn(1, 2) == (1, 2)


@pytest.mark.skipif(sys.platform != "linux", reason="asks Linux for the memory")
def test_a_process_that_has_grown_gives_back_what_it_has_freed():
    stage_tasks.give_back_memory()
    before = stage_tasks._resident_bytes()
    rows = [np.ones(8_000) for _ in range(3_000)]
    last = rows[-1]  # behind the others: without being asked, the allocator keeps what is free
    del rows
    grown = stage_tasks._resident_bytes() - before
    assert grown > 2 * stage_tasks.MAX_GROWTH_BYTES
    stage_tasks.give_back_memory()
    assert stage_tasks._resident_bytes() - before < grown / 4
    assert last.all()


def test_only_tasks_that_ask_for_it_are_tried_again():
    once = stage_task(Stage.TRACK, "x")(lambda: None)
    again = stage_task(Stage.READ, "x", retried=True)(lambda: None)
    assert (once.retries, once.retry_condition_fn) == (0, None)
    assert (again.retries, again.retry_delay_seconds) == (RETRIES, DELAYS_S)
    assert again.retry_condition_fn is storage_failed


def wrapped(cause: Exception | None, kind: type[Exception] = LogError) -> Exception:
    """Return an error as our code raises it from another one."""
    error = kind("night.mcap: cannot be read")
    error.__cause__ = cause
    return error


def answer(status: int) -> Exception:
    response = {"Error": {"Code": "X"}, "ResponseMetadata": {"HTTPStatusCode": status}}
    return s3.ClientError(response, "GetObject")


@pytest.mark.parametrize(
    "error",
    [
        wrapped(OSError(errno.EIO, "input/output error")),
        wrapped(OSError(errno.ESTALE, "stale file handle"), DatasetError),
        wrapped(TimeoutError()),
        ConnectionResetError(),
        wrapped(s3.EndpointConnectionError(endpoint_url="s3")),
        wrapped(s3.ReadTimeoutError(endpoint_url="s3")),
        wrapped(answer(503)),
        wrapped(answer(429)),
    ],
)
def test_temporary_failures_of_storage_are_tried_again(error):
    assert storage_failed(None, None, Failed(data=error))


@pytest.mark.parametrize(
    "error",
    [
        wrapped(None),  # no MCAP, no frames, no calibration
        wrapped(ValueError("bad chunk")),
        wrapped(FileNotFoundError(errno.ENOENT, "no such file")),
        wrapped(PermissionError(errno.EACCES, "not allowed"), DatasetError),
        wrapped(OSError(errno.ENOSPC, "disk full"), DatasetError),
        wrapped(OSError(errno.EROFS, "read-only"), DatasetError),
        wrapped(answer(403)),
        wrapped(s3.NoCredentialsError()),
        ZeroDivisionError(),
    ],
)
def test_lasting_errors_are_not_tried_again(error):
    assert not storage_failed(None, None, Failed(data=error))


@pytest.mark.parametrize(
    ("error", "reads"), [(wrapped(OSError(errno.EIO, "x")), 2), (wrapped(None), 1)]
)
def test_a_log_is_read_again_only_after_a_fault_of_the_storage(
    error, reads, prefect, night_log, tmp_path, monkeypatch
):
    asked = []

    def faulty(path, **_):
        asked.append(path)
        for piece in read_log_pieces(path):
            yield piece
            if len(asked) == 1:
                raise error

    monkeypatch.setattr(module, "read_log_pieces", faulty)

    @flow
    def reading():
        batch = Batch([LogToRead(0, str(night_log))])
        return read_logs.with_options(retry_delay_seconds=0)(ReadFolder(tmp_path), batch)[0]

    if reads == 1:
        with pytest.raises(LogError):
            reading()
    else:
        pieces = [ReadFolder(tmp_path).piece(0, k) for k in range(reading().n_pieces)]
        assert sum(read_part(piece, "exposures").num_rows for piece in pieces) == 240
    assert len(asked) == reads
