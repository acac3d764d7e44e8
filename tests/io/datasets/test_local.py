"""Nights that a run has locked: refused to others, free again however the run ends."""

import errno
import fcntl
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from scenes.dataset_tables import NEXT_NIGHT, NIGHT, OVER_MIDNIGHT, TIMES, contents, night_tables
from scenes.published import publish

from epipole.io.datasets import local as local_nights
from epipole.io.datasets.dataset import (
    lock_nights,
    locked_nights,
    nights_in,
    publish_folders,
    read_table,
)
from epipole.io.datasets.lock_record import LockRecord
from epipole.schemas.errors import DatasetError
from epipole.schemas.tables import TABLES

# Locks a night, leaves something in its folder, and waits to be killed.
LOCK = """
import sys
from epipole.io.datasets.dataset import lock_nights
with lock_nights(sys.argv[1], [sys.argv[2]]) as work:
    (work / "half").mkdir()
    print(work, flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def locking(tmp_path):
    """Return a process that has locked NIGHT, and its folder."""
    command = [sys.executable, "-c", LOCK, str(tmp_path / "out"), NIGHT]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=tmp_path
    ) as process:
        yield process, process.stdout.readline().strip()
        process.kill()


def test_a_second_run_of_a_night_is_refused_and_names_the_first(tmp_path):
    with lock_nights(tmp_path / "out", [NIGHT, NEXT_NIGHT]):
        with (
            pytest.raises(DatasetError, match=rf"night={NEXT_NIGHT}: process \d+ on .* since 20"),
            lock_nights(tmp_path / "out", [NEXT_NIGHT]),
        ):
            pytest.fail("two runs of one night")
        with lock_nights(tmp_path / "out", ["2019-04-09"]):
            pass
    with lock_nights(tmp_path / "out", [NIGHT]):
        pass
    assert not (tmp_path / "out").exists()


def test_who_looks_at_the_locks_as_a_run_begins_or_ends_sees_no_damaged_lock(tmp_path, monkeypatch):
    flock, seen = fcntl.flock, []

    def look(file, how):
        flock(file, how)
        if how == fcntl.LOCK_EX and str(getattr(file, "name", "")).endswith("claim"):
            seen.append(locked_nights(tmp_path / "out"))

    monkeypatch.setattr(fcntl, "flock", look)
    with lock_nights(tmp_path / "out", [NIGHT]) as work:
        assert seen == [{NIGHT}]
        assert locked_nights(tmp_path / "out") == {NIGHT}
        monkeypatch.setattr(local_nights, "_is_alive", lambda run: run.rename(f"{run}-gone"))
        assert locked_nights(tmp_path / "out") == set()
        monkeypatch.undo()
        Path(f"{work}-gone").rename(work)


def test_a_run_of_another_process_is_refused_until_it_is_killed(tmp_path, locking):
    process, work = locking
    with (
        pytest.raises(DatasetError, match=rf"process {process.pid} on"),
        lock_nights(tmp_path / "out", [NIGHT]),
    ):
        pytest.fail("two runs of one night")
    process.kill()
    process.wait()
    with lock_nights(tmp_path / "out", [NIGHT]) as staging:
        found = [p.name for p in staging.parent.glob("run-*")]
        assert found == [staging.name]  # that of the dead process is removed
        assert not staging.parent.joinpath(work).exists()


def test_what_a_living_run_has_staged_is_not_touched_by_others(tmp_path, locking):
    process, _ = locking
    publish(tmp_path / "out", night_tables(TIMES), [NIGHT])
    assert list((tmp_path / "out").glob(".staging/run-*/half"))
    process.communicate()
    assert [p.name for p in (tmp_path / "out").iterdir()] == [f"night={NIGHT}"]


def test_folders_are_put_in_place_while_their_nights_are_locked(tmp_path):
    publish(tmp_path / "other", night_tables(TIMES), [NIGHT])
    with lock_nights(tmp_path / "out", [NIGHT]) as work:
        (tmp_path / "other" / f"night={NIGHT}").rename(work / "made")
        publish_folders(tmp_path / "out", {NIGHT: work / "made"}, night_tables(TIMES)["sources"])
        assert read_table(tmp_path / "out", "frames", NIGHT).num_rows == len(TIMES)
    assert [p.name for p in (tmp_path / "out").iterdir()] == [f"night={NIGHT}"]


def test_a_folder_that_lacks_a_table_is_never_a_night(tmp_path):
    with lock_nights(tmp_path / "out", [NIGHT]) as work:
        for name in TABLES:
            (work / "made" / name).mkdir(parents=True)
        with pytest.raises(ValueError, match="not a whole night"):
            publish_folders(
                tmp_path / "out", {NIGHT: work / "made"}, night_tables(TIMES)["sources"]
            )
    assert not (tmp_path / "out").exists()


def test_an_error_in_a_run_leaves_nothing_behind(tmp_path):
    def run():
        with lock_nights(tmp_path / "out", [NIGHT]) as work:
            (work / "half").mkdir()
            raise RuntimeError

    with pytest.raises(RuntimeError):
        run()
    assert not (tmp_path / "out").exists()


# Publishes two nights and is killed before a move; the first move writes the commit.
KILLED = """
import os, pathlib, signal, sys
from scenes.dataset_tables import NEXT_NIGHT, NIGHT, OVER_MIDNIGHT, night_tables
from scenes.published import publish
from epipole.io.datasets import local

left = int(sys.argv[2])

def counted(work):
    def do(*args):
        global left
        if left == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        left -= 1
        return work(*args)
    return do

pathlib.Path.rename = counted(pathlib.Path.rename)
supported = sys.argv[3] == "exchange"
local.exchange = counted(local.exchange) if supported else lambda *_: False
publish(sys.argv[1], night_tables(OVER_MIDNIGHT, seed=9), [NIGHT, NEXT_NIGHT])
"""


@pytest.fixture(scope="module")
def old_and_new(tmp_path_factory):
    """Return two nights before and after they are published again."""
    both = []
    for seed in (0, 9):
        folder = tmp_path_factory.mktemp("made")
        publish(folder, night_tables(OVER_MIDNIGHT, seed=seed), [NIGHT, NEXT_NIGHT])
        both.append(contents(folder))
    return both


@pytest.mark.long
@pytest.mark.parametrize("exchange", ["exchange", "two renames"])
@pytest.mark.parametrize("moves", range(5))
@pytest.mark.parametrize("next_one", ["reads", "runs"])
def test_a_publisher_killed_at_any_move_has_published_both_nights_or_none(
    tmp_path, old_and_new, moves, exchange, next_one
):
    publish(tmp_path, night_tables(OVER_MIDNIGHT), [NIGHT, NEXT_NIGHT])
    paths = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    killed = subprocess.run(
        [sys.executable, "-c", KILLED, str(tmp_path), str(moves), exchange],
        env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True,
    )  # fmt: skip
    assert killed.returncode == -9, killed.stderr
    if next_one == "reads":
        assert nights_in(tmp_path) == [NIGHT, NEXT_NIGHT]
    with lock_nights(tmp_path, []):  # clears what was not committed
        pass
    assert contents(tmp_path) == old_and_new[moves > 0]


@pytest.mark.parametrize(
    "error", [PermissionError(), OSError(errno.EROFS, "Read-only file system")]
)
def test_a_reader_that_may_not_write_reads_what_is_there(error, tmp_path, monkeypatch):
    publish(tmp_path, night_tables(TIMES), [NIGHT])
    (tmp_path / ".staging" / "swap-0").mkdir(parents=True)
    (tmp_path / ".staging" / "swap-0" / "commit.json").write_text("{}")

    def refused(*_):
        raise error

    monkeypatch.setattr(local_nights, "opened", refused)
    assert nights_in(tmp_path) == [NIGHT]


def test_who_may_only_read_a_dataset_sees_which_nights_are_locked(tmp_path, monkeypatch):
    open_file = os.open

    def for_reading(path, flags, *more, **named):
        if flags & (os.O_RDWR | os.O_WRONLY):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return open_file(path, flags, *more, **named)

    (tmp_path / ".staging" / "run-0").mkdir(parents=True)
    (tmp_path / ".staging" / "run-0" / "claim").write_text(LockRecord.of([NEXT_NIGHT]).text())
    monkeypatch.setattr(os, "open", for_reading)
    assert locked_nights(tmp_path) == set()  # that run has ended
    monkeypatch.undo()
    with lock_nights(tmp_path, [NIGHT]), monkeypatch.context() as patched:
        patched.setattr(os, "open", for_reading)
        assert locked_nights(tmp_path) == {NIGHT}


def test_a_staging_folder_that_is_a_link_is_not_followed(tmp_path):
    elsewhere = tmp_path / "elsewhere"
    (elsewhere / "run-1").mkdir(parents=True)
    publish(tmp_path / "out", night_tables(TIMES), [NIGHT])
    (tmp_path / "out" / ".staging").symlink_to(elsewhere)
    with pytest.raises(DatasetError, match=r"\.staging: is a symbolic link; remove it"):
        publish(tmp_path / "out", night_tables(TIMES), [NIGHT])
    assert [path.name for path in elsewhere.iterdir()] == ["run-1"]


def test_links_and_stray_files_in_the_staging_folder_stop_nothing(tmp_path):
    (tmp_path / "kept" / "inside").mkdir(parents=True)
    staging = tmp_path / "out" / ".staging"
    staging.mkdir(parents=True)
    for name in ("run-stray", "swap-stray", ".DS_Store"):
        (staging / name).touch()
    (staging / "run-link").symlink_to(tmp_path / "kept")
    publish(tmp_path / "out", night_tables(TIMES), [NIGHT])
    assert nights_in(tmp_path / "out") == [NIGHT]
    assert (tmp_path / "kept" / "inside").is_dir()
    assert len(list(staging.iterdir())) == 4


def test_a_thread_does_not_wait_for_a_lock_that_an_interruption_left_open(tmp_path):
    def twice():
        interrupted = local_nights._locked(tmp_path)
        interrupted.__enter__()  # the exception of a Ctrl-C would keep it so
        with local_nights._locked(tmp_path):
            pass
        done.append(interrupted)

    done = []
    thread = threading.Thread(target=twice, daemon=True)
    thread.start()
    thread.join(10)
    assert done
