"""A run that was killed: the dataset is unchanged, and the next run reuses the finished parts."""

import datetime
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from scenes.dataset_tables import contents
from scenes.killed_runs import without_report

import epipole.flows.nightly as nightly_module
from epipole.flows.nightly import nightly
from epipole.flows.simulate import simulate
from epipole.io.datasets.dataset import read_table
from epipole.io.simulation.scenes import read_scene
from epipole.io.work.folder import work_root

pytestmark = pytest.mark.long

NIGHT = "2019-04-01"
WAIT_S = 240
COMMAND = "from epipole.flows.command_line.main import main; main()"


@pytest.fixture
def run(night_log, tmp_path):
    """Return a function that starts `epipole run` of the shared night in its own process."""
    started = []
    plain = without_report(tmp_path)

    def start(out: Path) -> subprocess.Popen:
        asked = ["run", str(night_log), "--out", str(out), "--again", "--settings", str(plain)]
        process = subprocess.Popen(
            [sys.executable, "-c", COMMAND, *asked],
            env=os.environ | {"PREFECT_HOME": str(tmp_path / "prefect")},
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
        )  # fmt: skip
        started.append(process)
        return process

    yield start
    for process in started:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def kill_when(process: subprocess.Popen, ready) -> None:
    """Kill a run and its child processes as soon as `ready` returns something true."""
    end = time.monotonic() + WAIT_S
    while not ready():
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < end
        time.sleep(0.005)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()


def parts(out: Path, stage: str) -> list[Path]:
    return [p for p in work_root(str(out)).glob(f"work-*/{stage}/*") if p.name.isdigit()]


def test_a_run_reuses_the_parts_of_a_killed_one_and_gives_the_same_rows(
    run, tmp_path, night_dataset
):
    out = tmp_path / "out"
    kill_when(run(out), lambda: parts(out, "track/0/*"))
    assert not list(out.glob("night=*"))
    done = {part: part.stat().st_ino for part in parts(out, "identify/*")}
    assert done

    again = run(out)
    kept = []
    while again.poll() is None:
        kept += [part for part, inode in done.items() if part.exists() and _is(part, inode)]
        time.sleep(0.01)
    output = again.communicate()[0]
    assert again.returncode == 0, output
    assert set(kept) == set(done)  # reused, not written again
    assert contents(out) == contents(night_dataset)


def _is(part: Path, inode: int) -> bool:
    try:
        return part.stat().st_ino == inode
    except FileNotFoundError:  # the run has just ended
        return False


def test_a_run_killed_while_it_replaces_a_night_leaves_the_night_whole(
    run, tmp_path, night_dataset
):
    out = tmp_path / "out"
    first = run(out)
    assert first.wait(WAIT_S) == 0, first.communicate()[0]
    kill_when(run(out), lambda: list(work_root(str(out)).glob("run-*/night=*/stars/*")))
    night = contents(out / f"night={NIGHT}")
    assert night == contents(night_dataset / f"night={NIGHT}")


def test_two_runs_of_one_night_at_once_end_with_one_night(run, tmp_path, night_dataset):
    out = tmp_path / "out"
    both = [run(out), run(out)]
    outputs = [process.communicate(timeout=WAIT_S)[0] for process in both]
    codes = [process.returncode for process in both]
    assert 0 in codes, outputs
    for code, output in zip(codes, outputs, strict=True):
        assert code == 0 or "has worked on it since" in output
    assert contents(out) == contents(night_dataset)


def test_a_new_sensor_of_another_day_takes_no_part_of_a_stopped_run(
    prefect, night_log, night_dataset, tmp_path, monkeypatch
):
    """Parts lie under the numbers of sensors, and its id comes before the others."""
    folder, out = tmp_path / "logs", tmp_path / "out"
    folder.mkdir()
    (folder / night_log.name).symlink_to(night_log)
    with monkeypatch.context() as patch:
        patch.setattr(nightly_module, "solve", _stopped)
        with pytest.raises(KeyboardInterrupt):
            nightly([str(folder)], str(out))
    assert parts(out, "track/0/*")
    scene = read_scene("four_sensor_geo")
    scene = scene.model_copy(
        update={"sensors": [scene.sensors[0].model_copy(update={"id": "aaa"})]}
    )
    later = datetime.datetime(2019, 4, 7, tzinfo=datetime.UTC)
    simulate(scene, folder / "later.mcap", hours=3 / 3600, start=later)
    nightly([str(folder)], str(out))
    for table in ("frames", "stars", "tracklets", "observations"):
        rows = read_table(str(out), table, NIGHT)
        assert rows.equals(read_table(str(night_dataset), table, NIGHT))


def _stopped(*_):
    raise KeyboardInterrupt
