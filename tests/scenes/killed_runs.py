"""Runs of `epipole run` that are stopped at a random moment, and what must hold after each stop.

    python tests/scenes/killed_runs.py [--stops 100] [--seed 1]

The log has frames on both sides of midnight, so each run publishes two nights. Runs take turns
with two logs of the same nights: what a dataset holds is therefore of one run or of the other, and
a mixture shows. After each stop this is checked:

- each night is whole, of one of the runs, for a reader that knows only the files;
- both nights are of the same run for a reader of `epipole`;
- no process of the run is left, nothing is left in the temporary folder;
- a run that was asked to stop (SIGTERM, SIGINT) says so in one line.

After some of the stops the run is started again, and must give the same bytes as a run that was
never stopped.
"""

import argparse
import contextlib
import datetime
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import polars as pl

sys.path.append(str(Path(__file__).parents[1]))

from epipole.io.datasets.dataset import nights_in, read_table
from epipole.schemas.tables import TABLES
from scenes.dataset_tables import contents

NIGHTS = ["2019-04-01", "2019-04-02"]
SCENE = "four_sensor_geo"
START = datetime.datetime(2019, 4, 1, 23, 59, 48, tzinfo=datetime.UTC)
HOURS = 24 / 3600
STARTS_S = 1.5  # before it has started a program says nothing itself
RUN_S = 12.0  # most of a run, without the first one that compiles
ENDS_WITHIN_S = 900.0  # the first one compiles
LEFT_WITHIN_S = 15.0  # for the processes of a killed run to notice
PUBLISHING = "swap-"  # in the names of files while nights are put in place

# The program itself; it sends itself a signal before it changes a file of the dataset for the
# n-th time, counted from the first name with a mark in it.
STOPPED_AT_WRITE = """
import os, sys
folder, mark, left, number = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
del sys.argv[1:5]
CHANGES = {"os.rename", "os.mkdir", "os.remove", "os.rmdir", "shutil.rmtree"}
SWAP = "ctypes.dlopen"  # before folders are exchanged
counting = not mark

def changes(event, args):
    if event == "open":
        return isinstance(args[2], int) and args[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
    return event in CHANGES

def stop(event, args):
    global left, counting
    if left <= 0:
        return
    if event == SWAP:
        left -= counting
    elif changes(event, args):
        paths = [os.fspath(a) for a in args if isinstance(a, str | os.PathLike)]
        if any(path.startswith(folder) for path in paths):
            counting = counting or any(mark in path for path in paths)
            left -= counting
    if left <= 0 and counting:
        os.kill(os.getpid(), number)

sys.addaudithook(stop)
from epipole.flows.command_line.main import main
main()
"""
COMMAND = "from epipole.flows.command_line.main import main; main()"

Contents = dict[str, bytes]


class Stop(NamedTuple):
    """When a run is stopped, and by which signal."""

    by: signal.Signals
    seconds: float | None = None  # after its start; None: at a write
    write: int = 0  # the n-th change of a file
    mark: str = ""  # counted from the first name that has this in it

    @property
    def moment(self) -> str:
        """Return the kind of moment."""
        if self.seconds is not None:
            return "at any time"
        return "while it publishes" if self.mark else "at any change of a file"


def draw_stop(rng: random.Random) -> Stop:
    """Return a random stop: half of them SIGKILL, a third while nights are put in place."""
    by = rng.choice([signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
    kind = rng.randrange(3)
    if kind == 0:
        return Stop(by, seconds=rng.uniform(STARTS_S, RUN_S))
    if kind == 1:
        return Stop(by, write=rng.randint(1, 290))
    return Stop(by, write=rng.randint(1, 30), mark=PUBLISHING)


class StoppedRuns:
    """Runs in one folder, and the two datasets that they may give.

    `settings` is a file for all runs; None: as users without one have them.
    """

    def __init__(
        self, folder: Path, logs: list[Path], whole: list[Contents], settings: Path | None = None
    ) -> None:
        self.folder, self.logs, self.whole, self.settings = folder, logs, whole, settings
        self.temporary, self.home = folder / "temporary", folder / "prefect"
        self.temporary.mkdir()
        self.out = folder / "out"

    def stop(self, log: int, stop: Stop) -> str:
        """Start a run of a log, stop it, check what is left, and return how it ended."""
        if stop.seconds is None:
            at = [str(self.out), stop.mark, str(stop.write), str(int(stop.by))]
            run = self._start(log, STOPPED_AT_WRITE, *at)
        else:
            run = self._start(log, COMMAND)
            with contextlib.suppress(subprocess.TimeoutExpired):
                run.wait(stop.seconds)
            run.send_signal(stop.by)
        said = run.communicate(timeout=ENDS_WITHIN_S)[0]
        ended = _check_end(run.returncode, stop, said)
        check_dataset(self.out, self.whole)
        self._check_leftovers()
        return ended

    def finish(self, log: int) -> None:
        """Run a log to its end, and check that the dataset is that of a run never stopped."""
        run = self._start(log, COMMAND)
        said = run.communicate(timeout=ENDS_WITHIN_S)[0]
        assert run.returncode == 0, said
        assert contents(self.out) == self.whole[log], "other bytes than of a run never stopped"
        self._check_leftovers()

    def forget(self) -> None:
        """Remove the dataset: the next run makes it."""
        shutil.rmtree(self.out, ignore_errors=True)

    def _start(self, log: int, code: str, *arguments: str) -> subprocess.Popen[str]:
        kept = {name: value for name, value in os.environ.items() if "PREFECT" not in name}
        own = {"TMPDIR": str(self.temporary), "PREFECT_HOME": str(self.home)}
        asked = ["run", str(self.logs[log]), "--out", str(self.out), "--replace", "--again"]
        asked += ["--quiet", *(["--settings", str(self.settings)] if self.settings else [])]
        return subprocess.Popen(
            [sys.executable, "-c", code, *arguments, *asked], env=kept | own,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip

    def _check_leftovers(self) -> None:
        end = time.monotonic() + LEFT_WITHIN_S
        while left := [*_processes(self.home), *self.temporary.iterdir()]:
            assert time.monotonic() < end, f"left: {left}"
            time.sleep(0.1)


def check_dataset(out: Path, whole: list[Contents]) -> int | None:
    """Check that the nights of a dataset are whole, and return which of these runs made them.

    For a reader of files, for polars, then for a reader of `epipole`. None: there are no nights.
    """
    folders = {p.name.removeprefix("night="): contents(p) for p in out.glob("night=*")}
    found = {night: _which(whole, night, files) for night, files in folders.items()}
    for night in folders:
        _check_rows(out, night)
    nights = nights_in(out)  # finishes what was committed
    assert nights in ([], NIGHTS), (found, nights)
    for night in nights:
        for name in TABLES:
            read_table(out, name, night)
    runs = {_which(whole, night, contents(out / f"night={night}")) for night in nights}
    assert len(runs) <= 1, f"nights of different runs: {found}"
    return runs.pop() if runs else None


def _check_end(code: int, stop: Stop, said: str) -> str:
    if code == 0:
        return "ended before"
    if stop.by == signal.SIGKILL:
        assert code == -signal.SIGKILL, said
        return "killed"
    assert code == 128 + stop.by, (code, said)
    assert said in ("epipole: interrupted\n", "epipole: stopped\n"), said
    return "stopped"


def _which(whole: list[Contents], night: str, files: Contents) -> int:
    """Return which run's night this is; it must be one of them, whole."""
    for number, dataset in enumerate(whole):
        start = f"night={night}/"
        if files == {k.removeprefix(start): v for k, v in dataset.items() if k.startswith(start)}:
            return number
    raise AssertionError(f"night {night} is of no run: {sorted(files)}")


def _check_rows(out: Path, night: str) -> None:
    """Check by polars that tables of a night agree: each position has its views."""
    tables = {
        name: pl.read_parquet(f"{out}/night={night}/{name}/*.parquet", hive_partitioning=False)
        for name in ("positions", "associations", "frames", "stars")
    }
    keys = ["epoch", "object_id"]
    views = tables["associations"].filter("used")
    assert tables["positions"].join(views, on=keys, how="anti").is_empty()
    frame = ["sensor_id", "frame_number"]
    assert tables["stars"].join(tables["frames"], on=frame, how="anti").is_empty()


def _processes(home: Path) -> list[str]:
    mark, found = f"PREFECT_HOME={home}\0".encode(), []
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            if entry.name.isdigit() and mark in (entry / "environ").read_bytes():
                found.append((entry / "cmdline").read_bytes().replace(b"\0", b" ").decode())
    return found


def without_report(folder: Path) -> Path:
    """Return a file of settings in a folder: a report takes as long as all the rest of a run."""
    file = folder / "plain.toml"
    file.write_text("report.write = false\n")
    return file


def make_logs(folder: Path) -> list[Path]:
    """Return two logs of the same two nights, with other noise."""
    from epipole.flows.simulate import simulate

    logs = []
    for seed in (7, 8):
        logs.append(folder / f"seed-{seed}.mcap")
        simulate(SCENE, logs[-1], seed=seed, hours=HOURS, start=START)
    return logs


def stopped_runs(folder: Path) -> StoppedRuns:
    """Return the runs, after one whole run of each log by the command itself."""
    logs = make_logs(folder)
    runs = StoppedRuns(folder, logs, [{}, {}])
    for log in range(len(logs)):
        run = runs._start(log, COMMAND)
        said = run.communicate(timeout=ENDS_WITHIN_S)[0]
        assert run.returncode == 0, said
        runs.whole[log] = contents(runs.out)
    assert runs.whole[0] != runs.whole[1]
    return runs


def main() -> None:
    """Stop runs at random moments; print what came out."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--stops", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--finish-every", type=int, default=5)
    asked = parser.parse_args()
    rng, counts, faults = random.Random(asked.seed), Counter[tuple[str, ...]](), 0
    with tempfile.TemporaryDirectory(prefix="stopped-runs-") as folder:
        runs = stopped_runs(Path(folder))
        for number in range(1, asked.stops + 1):
            stop, log = draw_stop(rng), rng.randrange(2)
            try:
                ended = runs.stop(log, stop)
                if number % asked.finish_every == 0:
                    runs.finish(log)
                    counts["run again", "", "same bytes"] += 1
                    if rng.random() < 0.3:
                        runs.forget()
            except (AssertionError, subprocess.TimeoutExpired) as error:
                faults += 1
                ended = "FAULT"
                print(f"{number}: {stop}: {error}", flush=True)
            counts[stop.by.name, stop.moment, ended] += 1
            print(f"{number} {stop.by.name} {stop.moment}: {ended}", flush=True)
    for what, count in sorted(counts.items()):
        print(f"{count:5} {' '.join(what)}")
    sys.exit(faults > 0)


if __name__ == "__main__":
    main()
