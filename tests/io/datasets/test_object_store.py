"""A dataset in a bucket, of a real S3 server: never half a night, whoever is killed when."""

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest
from scenes.dataset_tables import NEXT_NIGHT, NIGHT, OVER_MIDNIGHT, TIMES, night_tables
from scenes.published import publish as publish_once
from scenes.twice import twice

from epipole.flows.command_line.run_nightly import Nights, RunOptions
from epipole.flows.evaluate import evaluate
from epipole.flows.night.recorded_nights import published_nights
from epipole.flows.nightly import nightly
from epipole.io.datasets import dataset, object_store
from epipole.io.datasets.dataset import lock_nights
from epipole.io.datasets.lock_record import LockRecord
from epipole.io.datasets.night_tables import count_rows, read_columns
from epipole.io.datasets.object_store import store_nights
from epipole.schemas.errors import DatasetError
from epipole.schemas.settings import Settings
from epipole.schemas.tables import TABLES

WHOLE_NIGHT = (
    "sources",
    "nights",
    "calibrations",
    "identifications",
    "objects",
    "sensor_errors",
    "checks",
)  # tables that are not of an instant
pytestmark = pytest.mark.long

publish = twice(publish_once)  # not where the first time is what is tested
check_folder, nights_in = twice(dataset.check_folder), twice(dataset.nights_in)
read_table = twice(dataset.read_table)


@pytest.fixture
def out(s3, request):
    """Return the URL of a dataset that is not there yet."""
    return f"s3://nights/{abs(hash(request.node.name))}/ds"


def files(s3, out):
    return {path: s3.info(path)["ETag"] for path in s3.find(out)}


def counts(out, night=NIGHT):
    """Return the rows of each table by the count of a reader."""
    return {name: read_table(out, name, night).num_rows for name in TABLES}


def test_a_night_in_a_bucket_is_what_it_is_in_a_folder(s3, out, tmp_path):
    assert nights_in(out) == []
    publish(out, night_tables(OVER_MIDNIGHT), [NIGHT, NEXT_NIGHT])
    publish(tmp_path / "here", night_tables(OVER_MIDNIGHT), [NIGHT, NEXT_NIGHT])
    assert nights_in(out) == nights_in(tmp_path / "here") == [NIGHT, NEXT_NIGHT]
    for name in TABLES:
        for night in (NIGHT, NEXT_NIGHT):
            assert read_table(out, name, night).equals(read_table(tmp_path / "here", name, night))
    assert all("/night=" in path for path in s3.find(out))  # no staging is left


def test_polars_reads_a_dataset_in_a_bucket(s3, out):
    publish(out, night_tables(OVER_MIDNIGHT), [NIGHT, NEXT_NIGHT])
    scan = pl.scan_parquet(f"{out}/night=*/positions/*.parquet", hive_partitioning=True)
    for _ in range(2):
        assert scan.group_by("night").len().sort("night").collect()["len"].to_list() == [10, 10]


def test_publishing_again_replaces_a_night_whole(s3, out):
    publish(out, night_tables(OVER_MIDNIGHT), [NIGHT, NEXT_NIGHT])
    before = files(s3, out)
    s3.pipe_file(f"{out}/night={NIGHT}/frames/part-1.parquet", b"of an older version")
    publish_once(out, night_tables(TIMES[:5]), [NIGHT])
    assert read_table(out, "frames", NIGHT).num_rows == 5
    after = files(s3, out)
    assert after.keys() == before.keys()
    assert {p for p in after if after[p] == before[p]} >= {p for p in before if NEXT_NIGHT in p}


def test_a_run_without_a_recorded_log_is_refused(s3, out):
    publish(out, night_tables(TIMES, ("a", "b")), [NIGHT])
    before = files(s3, out)
    with pytest.raises(DatasetError, match=r"was also made from b\.mcap"):
        publish(out, night_tables(TIMES, ("a",)), [NIGHT])
    assert files(s3, out) == before
    publish(out, night_tables(TIMES, ("a",)), [NIGHT], replace=True)


def test_a_folder_of_other_files_or_without_a_bucket_is_refused(s3, out):
    s3.pipe_file(f"{out}/holiday.jpg", b"")
    with pytest.raises(DatasetError, match="holds other files and no dataset"):
        check_folder(out)
    with (
        pytest.raises(DatasetError, match="there is no bucket no-such-bucket; create it"),
        lock_nights("s3://no-such-bucket/ds", [NIGHT]),
    ):
        pytest.fail("no bucket")


def test_a_reader_meets_whole_tables_at_every_instant(s3, out):
    publish(out, night_tables(TIMES[:10]), [NIGHT])
    seen, ended = [], threading.Event()

    def look():
        while not ended.is_set():
            path = f"{out}/night=*/positions/*.parquet"
            with contextlib.suppress(pl.exceptions.ComputeError):  # replaced while it was read
                seen.append(("glob", len(pl.scan_parquet(path, hive_partitioning=True).collect())))
            seen.append(("read", dataset.read_table(out, "positions", NIGHT).num_rows))

    reader = threading.Thread(target=look)
    reader.start()
    try:
        for n in (12, 14, 16):
            publish(out, night_tables(TIMES[:n]), [NIGHT])
    finally:
        ended.set()
        reader.join()
    for kind in ("glob", "read"):
        rows = [n for of, n in seen if of == kind]
        assert set(rows) <= {10, 12, 14, 16}
        assert rows == sorted(rows)
    assert len(seen) > 4


# Publishes and is killed after the given number of writes to the store.
KILLED = """
import os, signal, sys
import fsspec.asyn
from scenes.dataset_tables import NEXT_NIGHT, NIGHT, OVER_MIDNIGHT, night_tables
from scenes.published import publish
from epipole.io.datasets.object_store import store_nights

out, limit = sys.argv[1], int(sys.argv[2])
storage = store_nights(out)._storage
n = 0

def counted(work):
    def do(*args, **more):
        global n
        n += 1
        if n > limit:
            os.kill(os.getpid(), signal.SIGKILL)
        return work(*args, **more)
    return do

for name in ("put_file", "pipe_file", "cp_file", "rm_file", "rm"):
    setattr(storage, name, counted(getattr(storage, name)))
publish(out, night_tables(OVER_MIDNIGHT, seed=5), [NIGHT, NEXT_NIGHT])
print(n)
"""


def publish_and_be_killed(out, limit):
    paths = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-c", KILLED, out, str(limit)]
    return subprocess.run(
        command, env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True
    )


@pytest.mark.parametrize("share", [0.1, 0.48, 0.53, 0.8, 0.99])
def test_a_publisher_killed_at_any_write_has_published_both_nights_or_none(s3, out, share):
    n_writes = 2 + 2 * len(TABLES) + 1 + 2 * len(TABLES) + 2
    publish(out, night_tables(OVER_MIDNIGHT[:8]), [NIGHT])
    killed = publish_and_be_killed(out, int(share * n_writes))
    assert killed.returncode == -9, killed.stderr
    store_nights(out)._storage.invalidate_cache()
    old = {NIGHT: 8, NEXT_NIGHT: 0}
    new = {NIGHT: 10, NEXT_NIGHT: 10}
    found = {night: counts(out, night)["frames"] for night in old}
    assert found in (old, new)
    for night in old:  # of every table, as our own readers see it
        rows = counts(out, night)
        assert {n for name, n in rows.items() if name not in WHOLE_NIGHT} == {found[night]}
    publish_once(out, night_tables(OVER_MIDNIGHT), [NIGHT])
    assert counts(out, NIGHT)["frames"] == 10
    assert counts(out, NEXT_NIGHT)["frames"] == found[NEXT_NIGHT]
    assert [p for p in s3.find(out) if "/.staging/" in p] == []
    if found == new:  # what was committed was finished, for those who read by a glob
        assert len([p for p in s3.find(out) if NEXT_NIGHT in p]) == len(TABLES)


@pytest.mark.parametrize("share", [0.02, 0.3, 0.5, 0.7, 0.95])
def test_a_store_that_refuses_a_write_ends_in_one_line_and_no_half_night(
    s3, out, share, monkeypatch
):
    publish(out, night_tables(OVER_MIDNIGHT[:8]), [NIGHT])
    storage = store_nights(out)._storage
    limit, done = int(share * (4 * len(TABLES) + 5)), []

    def refusing(work):
        def do(*arguments, **named):
            done.append(1)
            if len(done) > limit:
                raise PermissionError("the store is read-only now")
            return work(*arguments, **named)

        return do

    with monkeypatch.context() as patched:
        for name in ("put_file", "pipe_file", "cp_file"):
            patched.setattr(storage, name, refusing(getattr(storage, name)))
        with pytest.raises(DatasetError, match="read-only now") as caught:
            publish_once(out, night_tables(OVER_MIDNIGHT, seed=5), [NIGHT, NEXT_NIGHT])
    assert "\n" not in str(caught.value)
    storage.invalidate_cache()
    found = {night: counts(out, night)["frames"] for night in (NIGHT, NEXT_NIGHT)}
    assert found in ({NIGHT: 8, NEXT_NIGHT: 0}, {NIGHT: 10, NEXT_NIGHT: 10})
    publish_once(out, night_tables(OVER_MIDNIGHT), [NIGHT])
    assert counts(out, NIGHT)["frames"] == 10
    assert [p for p in s3.find(out) if "/.staging/" in p] == []


@pytest.mark.parametrize("can_remove", [True, False])
def test_a_commit_that_is_written_though_the_store_says_not_leaves_no_broken_night(
    s3, out, can_remove, monkeypatch
):
    publish_once(out, night_tables(TIMES[:8]), [NIGHT])
    storage = store_nights(out)._storage
    pipe_file, rm_file = storage.pipe_file, storage.rm_file

    def lose_answer(path, *arguments, **named):
        pipe_file(path, *arguments, **named)
        if "/commit-" in path:
            raise ConnectionResetError("no answer came")

    def refuse(path):
        if not can_remove and "/commit-" in path:
            raise ConnectionResetError("no answer came")
        rm_file(path)

    with monkeypatch.context() as patched:
        patched.setattr(storage, "pipe_file", lose_answer)
        patched.setattr(storage, "rm_file", refuse)
        with pytest.raises(DatasetError, match="no answer came"):
            publish_once(out, night_tables(TIMES), [NIGHT])
    found = read_table(out, "frames", NIGHT).num_rows
    assert found == (8 if can_remove else len(TIMES))
    assert counts(out)["positions"] == found
    publish_once(out, night_tables(TIMES), [NEXT_NIGHT])
    assert read_table(out, "frames", NIGHT).num_rows == found
    assert [p for p in s3.find(out) if "/.staging/" in p] == []


@pytest.fixture
def no_copies(s3, out, monkeypatch):
    """Return a context in which the store refuses to copy: a night is committed, not in place."""

    def refuse(*_):
        raise PermissionError("Access Denied")

    @contextlib.contextmanager
    def refused():
        with monkeypatch.context() as patched:
            patched.setattr(store_nights(out)._storage, "cp_file", refuse)
            yield

    return refused


def publish_folder(out, folder):
    """Publish the night of another dataset, as the run that made it does."""
    sources = dataset.read_table(folder, "sources", NIGHT)
    staged = {NIGHT: folder / f"night={NIGHT}"}
    dataset.publish_folders(out, staged, sources, replace=True)


@pytest.mark.parametrize("there_before", [False, True])
def test_the_same_run_again_finishes_what_the_store_refused_to_copy(
    s3, out, no_copies, there_before, prefect, night_log, night_dataset
):
    if there_before:
        publish_once(out, night_tables(TIMES), [NIGHT])
        s3.pipe_file(f"{out}/night={NIGHT}/frames/part-1.parquet", b"of an older version")
    with no_copies():
        with pytest.raises(DatasetError, match=r"Access Denied.*; run again to finish this"):
            publish_folder(out, night_dataset)
        with pytest.raises(DatasetError, match="Access Denied"):
            nightly([str(night_log)], out)
    assert nightly([str(night_log)], out).unchanged
    new = {f"{name}/part-0.parquet" for name in TABLES}
    found = {path.partition(f"night={NIGHT}/")[2] for path in s3.find(out) if "/night=" in path}
    assert found == new
    for name in new:
        there = (night_dataset / f"night={NIGHT}" / name).read_bytes()
        assert s3.cat_file(f"{out}/night={NIGHT}/{name}") == there
    assert [path for path in s3.find(out) if "/.staging/" in path] == []


def test_a_run_of_stale_nights_finishes_them_before_it_judges_them(
    s3, out, no_copies, night_log, night_dataset
):
    with no_copies(), pytest.raises(DatasetError, match="run again to finish this"):
        publish_folder(out, night_dataset)
    assert list(Nights([str(night_log)], out, RunOptions()).stale()) == []
    assert [path for path in s3.find(out) if "/.staging/" in path] == []


def test_a_night_that_another_run_has_locked_is_not_finished_for_it(s3, out, no_copies):
    with no_copies(), pytest.raises(DatasetError, match="run again to finish this"):
        publish_once(out, night_tables(TIMES), [NIGHT])
    other = object_store.StoreLocks(s3, store_nights(out)._root, out)
    with other.lock([NIGHT]):
        dataset.finish_publication(out)
        assert s3.find(f"{out}/night={NIGHT}") == []
    dataset.finish_publication(out)
    assert [path for path in s3.find(out) if "/.staging/" in path] == []
    assert read_table(out, "frames", NIGHT).num_rows == len(TIMES)


def test_a_table_that_is_missing_in_a_store_is_an_error_of_one_line(s3, out):
    where = f"{out}/night={NIGHT}"
    for read in (count_rows, lambda *table: read_columns(*table, ["time"])):
        with pytest.raises(DatasetError, match=f"{where}/frames: cannot be read") as caught:
            read(where, "frames")
        assert "\n" not in str(caught.value)


def test_what_another_run_has_finished_or_cleared_meanwhile_stops_nothing(s3, out, monkeypatch):
    store = store_nights(out)
    with monkeypatch.context() as patched:
        patched.setattr(store, "_finish", lambda commit: None)
        publish_once(out, night_tables(TIMES), [NIGHT])
    s3.pipe_file(f"{out}/.staging/run-{'0' * 32}/night={NIGHT}/frames/part-0.parquet", b"")
    staging = f"{store._root}/.staging"
    commits, listed = store._commits(), list(store._ls(staging))
    store.recover()  # as another run does, after this one has listed what is there
    assert s3.find(staging) == []
    find_commits, ls, alive = store._commits, store._ls, store.locks.alive

    def alive_later():
        commits.clear()
        return alive()

    monkeypatch.setattr(store, "_commits", lambda: commits.copy() or find_commits())
    monkeypatch.setattr(store, "_ls", lambda where: iter(listed) if where == staging else ls(where))
    monkeypatch.setattr(store.locks, "alive", alive_later)
    publish_once(out, night_tables(TIMES[:5]), [NEXT_NIGHT])
    assert nights_in(out) == [NIGHT, NEXT_NIGHT]


def test_a_second_run_of_a_night_is_refused_and_names_the_first(s3, out):
    with lock_nights(out, [NIGHT, NEXT_NIGHT]):
        other = LockRecord(["2019-04-05"], "far", 7, "2026-01-01T00:00:00Z", "", "t")
        s3.pipe_file(f"{out}/.staging/claim-night=2019-04-05.json", other.text().encode())
        with (
            pytest.raises(DatasetError, match=r"2019-04-05: process 7 on far has worked on it"),
            lock_nights(out, ["2019-04-05"]),
        ):
            pytest.fail("two runs of one night")
        with (
            pytest.raises(DatasetError, match=rf"process {os.getpid()} on"),
            lock_nights(out, [NEXT_NIGHT]),
        ):
            pytest.fail("two runs of one night")
    with lock_nights(out, [NIGHT]):
        pass


def test_a_lock_that_is_not_renewed_is_taken_over_and_its_run_cannot_publish(s3, out, monkeypatch):
    monkeypatch.setattr(object_store, "LEASE_S", 0.5)
    with lock_nights(out, [NIGHT]) as work:
        assert work.is_dir()
        time.sleep(1.1)
        other = object_store.StoreLocks(s3, store_nights(out)._root, out)
        with (
            other.lock([NIGHT]),
            pytest.raises(DatasetError, match="another run has taken it over"),
        ):
            publish(out, night_tables(TIMES), [NIGHT])
    assert nights_in(out) == []


def test_a_lock_is_renewed_while_its_run_works(s3, out, monkeypatch):
    monkeypatch.setattr(object_store, "RENEWED_EVERY_S", 0.2)
    monkeypatch.setattr(object_store, "LEASE_S", 3.0)
    with lock_nights(out, [NIGHT]):
        time.sleep(4.0)
        other = object_store.StoreLocks(s3, store_nights(out)._root, out)
        with pytest.raises(DatasetError, match="has worked on"), other.lock([NIGHT]):
            pytest.fail("it was taken over")


def test_a_committed_night_is_read_before_its_files_are_in_place(s3, out, monkeypatch):
    store = store_nights(out)
    monkeypatch.setattr(store, "_finish", lambda commit: None)
    publish_once(out, night_tables(TIMES), [NIGHT])
    monkeypatch.undo()
    assert nights_in(out) == [NIGHT]
    assert read_table(out, "positions", NIGHT).num_rows == len(TIMES)
    (commit,) = [p for p in s3.find(out) if "commit-" in p]
    assert list(json.loads(s3.cat_file(commit))["files"]) == [NIGHT]


def test_a_dataset_may_be_named_by_a_file_url(tmp_path):
    publish(f"file://{tmp_path}/a%20b", night_tables(TIMES), [NIGHT])
    assert nights_in(tmp_path / "a b") == [NIGHT]
    assert read_table(f"file://{tmp_path}/a%20b", "frames", NIGHT).num_rows == len(TIMES)


def test_a_run_reads_from_a_bucket_and_publishes_to_one(s3, out, prefect, night_log, night_dataset):
    s3.put_file(str(night_log), "logs/run/night.mcap")
    made = nightly(["s3://logs/run/night.mcap"], out)
    before = files(s3, out)
    again = nightly(["s3://logs/run/night.mcap"], out)  # reads what the first one has published
    assert again.unchanged
    assert replace(again, unchanged=False, extracts=made.extracts) == made
    assert files(s3, out) == before
    nightly(["s3://logs/run/night.mcap"], out, again=True)
    for name in sorted(set(TABLES) - {"sources", "nights"}):  # these tell the log's name
        assert read_table(out, name, NIGHT).equals(read_table(night_dataset, name, NIGHT)), name
    for _ in range(2):
        assert [night.stale for night in published_nights(out, Settings(), None)] == [[]]
    assert evaluate(out, night_log).as_dict() == evaluate(night_dataset, night_log).as_dict()
    others = [path for path in s3.find(out) if "/night=" not in path]
    beside = [f"reports/{NIGHT}.html", f"runs/{NIGHT}.parquet", "runs/last.prom"]
    assert sorted(path.rpartition("/ds/")[2] for path in others) == beside


def test_a_store_that_is_not_there_is_an_error_of_one_line(s3, out, monkeypatch):
    import s3fs

    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    s3fs.S3FileSystem.clear_instance_cache()
    with pytest.raises(DatasetError, match="cannot be read") as caught:
        check_folder(out)
    assert "\n" not in str(caught.value)


def test_a_missing_bucket_is_named_by_readers_too(s3):
    for read in (nights_in, lambda where: read_table(where, "frames", NIGHT)):
        with pytest.raises(DatasetError, match="there is no bucket no-such-bucket"):
            read("s3://no-such-bucket/ds")


@pytest.mark.parametrize(
    ("name", "says"),
    [
        (f"claim-night={NIGHT}.json", "is not the lock of a run; remove it"),
        ("commit-stray.json", "is not a commit of a run; remove it"),
    ],
)
def test_a_stray_file_among_the_locks_is_named(name, says, s3, out):
    publish(out, night_tables(TIMES), [NIGHT])
    s3.pipe_file(f"{out}/.staging/{name}", b"[]")
    with pytest.raises(DatasetError, match=f"{name}: {says}"):
        publish(out, night_tables(TIMES), [NIGHT])
