"""Full disks, read-only folders, files that cannot be read: one line, and the dataset as before.

The limits are the kernel's, in a process of its own; none of it is made up.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from scenes.dataset_tables import NIGHT, TIMES, contents, night_tables
from scenes.published import publish

from epipole.io.datasets.dataset import lock_nights, read_table
from epipole.io.logs.reader import read_log
from epipole.schemas.errors import DatasetError, LogError

# Publishes a larger night, prints the error that came, then what is there.
PUBLISH = """
import os, resource, signal, sys
import numpy as np
from scenes.dataset_tables import NIGHT, TIMES, night_tables
from scenes.published import publish
from epipole.io.datasets.dataset import nights_in, read_table
from epipole.schemas.errors import DatasetError

tables = night_tables(TIMES[0] + np.arange(20_000))
if sys.argv[2]:
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)
try:
    publish(sys.argv[1], tables, [NIGHT])
except DatasetError as error:
    print(error)
print([read_table(sys.argv[1], "frames", night).num_rows for night in nights_in(sys.argv[1])])
print(os.listdir(sys.argv[1]) if os.path.isdir(sys.argv[1]) else None)
"""
# A small disk of the test's own, seen by nobody else, with a dataset on it.
DISK = """
mount -t tmpfs -o size=300k tmpfs "$1" && cp -r "$2"/. "$1" && {then} && exec "$3" -c "$4" "$1" ""
"""


def publish_by(command):
    """Return the lines that a process of `PUBLISH` prints."""
    paths = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": paths}
    run = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    return run.stdout.splitlines()


@pytest.mark.parametrize("there_before", [True, False])
def test_a_write_that_the_system_refuses_leaves_the_dataset_as_it_was(tmp_path, there_before):
    out = tmp_path / "out"
    if there_before:
        publish(out, night_tables(TIMES), [NIGHT])
    before = contents(tmp_path)
    error, rows, _ = publish_by([sys.executable, "-c", PUBLISH, str(out), "100000"])
    assert error.startswith(str(out))
    assert ": cannot be written (" in error
    assert "File too large" in error
    assert rows == (f"[{len(TIMES)}]" if there_before else "[]")
    assert contents(tmp_path) == before
    assert out.exists() == there_before


@pytest.mark.parametrize(
    ("then", "reason"),
    [
        ("true", "No space left on device"),
        ('mount -o remount,ro,bind "$1"', "Read-only file system"),
    ],
)
def test_a_full_or_read_only_disk_is_one_line_and_the_night_stays(tmp_path, then, reason):
    alone = ["unshare", "--map-root-user", "--mount"]
    if (
        not shutil.which("unshare")
        or subprocess.run([*alone, "true"], capture_output=True).returncode
    ):
        pytest.skip("no file system of one's own can be mounted here")
    publish(tmp_path / "out", night_tables(TIMES), [NIGHT])
    (tmp_path / "disk").mkdir()
    arguments = [str(tmp_path / "disk"), str(tmp_path / "out"), sys.executable, PUBLISH]
    script = DISK.replace("{then}", then)
    error, rows, entries = publish_by([*alone, "bash", "-c", script, "bash", *arguments])
    assert reason in error
    assert rows == f"[{len(TIMES)}]"
    assert entries == f"['night={NIGHT}']"


@pytest.fixture
def read_only(tmp_path):
    """Return a dataset in a folder that may not be written, as a user who is not root."""
    if os.geteuid() == 0:
        pytest.skip("root writes everywhere")
    publish(tmp_path / "out", night_tables(TIMES), [NIGHT])
    (tmp_path / "out").chmod(0o555)
    yield tmp_path / "out"
    (tmp_path / "out").chmod(0o755)


def test_a_read_only_dataset_is_refused_before_any_work(read_only):
    with (
        pytest.raises(DatasetError, match="cannot be written"),
        lock_nights(read_only, [NIGHT]),
    ):
        pytest.fail("it was locked")
    assert read_table(read_only, "frames", NIGHT).num_rows == len(TIMES)


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="asks Linux for a folder of its own")
def test_a_folder_in_which_nothing_can_be_made_is_refused_before_any_work():
    with (
        pytest.raises(DatasetError, match="/proc/epipole: cannot be written"),
        lock_nights("/proc/epipole", [NIGHT]),
    ):
        pytest.fail("it was locked")


@pytest.mark.skipif(not os.path.exists("/proc/self/mem"), reason="asks Linux for such a file")
def test_a_file_that_cannot_be_read_is_an_error_of_one_line():
    with pytest.raises(LogError) as caught:
        read_log("/proc/self/mem")
    assert "\n" not in str(caught.value)


def test_a_log_that_vanishes_before_it_is_read_is_an_error_of_one_line(tmp_path):
    (tmp_path / "a.mcap").symlink_to(tmp_path / "gone.mcap")
    with pytest.raises(LogError, match=r"a\.mcap: no such file; check the path"):
        read_log(tmp_path / "a.mcap")
