"""A deployed night whose server, worker or run is stopped at a random moment.

    python tests/scenes/stopped_deployments.py [--stops 100] [--seed 1] [--pending 600]

Server and worker are started with the files of `epipole deploy-files`, and started again by what
their systemd units say. A run is asked for, something is stopped while it is made, and at once the
run of the next night is asked for. Then nobody does anything, and this is checked:

- both runs are Completed, and each night has the bytes of a run that was never stopped;
- the run of the next night has begun within six minutes of the stop.

An automation waits ten minutes for a run that its worker has lost before it began; `--pending`
makes that less (s). The run that follows need not wait for it.
"""

import argparse
import configparser
import contextlib
import datetime
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import httpx

sys.path.append(str(Path(__file__).parents[1]))

from scenes.dataset_tables import published
from scenes.killed_runs import HOURS, NIGHTS, SCENE, START
from scenes.prefect_server import POOL, Prefect, deploy_files, wait_for

RUN_S = 25.0  # from a request to the end of its run
ENDS_WITHIN_S = 1200.0  # ten minutes until a run that never began is seen to be lost
NEXT_WITHIN_S = 360.0


class Unit:
    """A service as its systemd unit describes it: started again whenever it ends."""

    def __init__(self, name: str, prefect: Prefect, start: Callable[[], subprocess.Popen[bytes]]):
        unit = configparser.ConfigParser(strict=False, interpolation=None)
        unit.read(prefect.folder / f"epipole-{name}.service")
        assert unit["Service"]["Restart"] == "always"
        self._pause_s = float(unit["Service"]["RestartSec"])
        self._prefect, self._start, self.process = prefect, start, start()
        self._ending = threading.Event()
        threading.Thread(target=self._keep, daemon=True).start()

    def _keep(self) -> None:
        while not self._ending.is_set():
            self.process.wait()
            # What is left of a service when its main process has gone, systemd kills.
            for pid in self._prefect.orphans():
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            if not self._ending.wait(self._pause_s):
                self.process = self._start()

    def end(self) -> None:
        """Do not start it again."""
        self._ending.set()


class Stop(NamedTuple):
    """What is stopped, when after the request for the run, and by which signal."""

    what: str
    seconds: float
    by: signal.Signals

    def __str__(self) -> str:
        return f"{self.what} by {self.by.name} after {self.seconds:.1f} s"


class Deployed:
    """The deployment in a folder of its own, with its server and worker."""

    def __init__(self, folder: Path, pending_s: int) -> None:
        from epipole.flows.simulate import simulate

        (folder / "logs").mkdir()
        simulate(SCENE, folder / "logs" / "night.mcap", seed=7, hours=HOURS, start=START)
        self.out = folder / "dataset"
        self.prefect = Prefect(folder, **deploy_files(folder, folder / "logs", self.out))
        automations = folder / "automations.yaml"
        text = automations.read_text()
        assert text.count("within: 600\n") == 1
        automations.write_text(text.replace("within: 600\n", f"within: {pending_s}\n"))
        self.server = Unit("server", self.prefect, self.prefect.start_server)
        wait_for(lambda: self._ask(lambda: self.prefect.get("ready")), "the server to start")
        for command in (
            ("work-pool", "create", POOL, "--type", "process"),
            ("deploy", "--all"),
            ("automation", "create", "--from-file", "automations.yaml"),
        ):
            ran = self.prefect.command(*command)
            assert ran.returncode == 0, ran.stdout + ran.stderr
        self.worker = Unit("worker", self.prefect, self.prefect.start_worker)
        self._deployment = self.prefect.get("deployments/name/nightly/nightly")["id"]

    def ask(self, night: str) -> str:
        """Ask for a run of a night, and return its id."""
        asked = {"parameters": {"night": night, "again": True}, "state": {"type": "SCHEDULED"}}
        path = f"deployments/{self._deployment}/create_flow_run"
        made: dict[str, Any] = wait_for(
            lambda: self._ask(lambda: self.prefect.post(path, asked)), "the server to take a run"
        )
        return str(made["id"])

    def wait(self, run_id: str) -> dict[str, Any]:
        """Wait until a run is Completed, and return it."""
        return wait_for(lambda: self._completed(run_id), "a run to be Completed", ENDS_WITHIN_S)

    def _completed(self, run_id: str) -> dict[str, Any] | None:
        time.sleep(0.9)
        run = self._ask(lambda: self.prefect.run(run_id))
        return run if run and run["state_type"] == "COMPLETED" else None

    def stop(self, stop: Stop) -> bool:
        """Send the signal; False: what it was for has ended, or has not begun."""
        unit = {"server": self.server, "worker": self.worker}.get(stop.what)
        pids = [unit.process.pid] if unit else self.prefect.flow_processes(self.worker.process)
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, stop.by)
        return bool(pids)

    def end(self) -> None:
        """End all processes."""
        self.server.end(), self.worker.end()
        self.prefect.kill_all()

    @staticmethod
    def _ask(request: Callable[[], Any]) -> Any:
        """Return the answer; None where the server is gone or starts."""
        with contextlib.suppress(httpx.HTTPError, ValueError):
            return request()
        return None


def stop_once(deployed: Deployed, stop: Stop, whole: dict[str, bytes]) -> tuple[bool, float]:
    """Stop something, and check both nights; return if it was there, and when the next began."""
    first = deployed.ask(NIGHTS[0])
    time.sleep(stop.seconds)
    stopped, was_there = datetime.datetime.now(datetime.UTC), deployed.stop(stop)
    following = deployed.ask(NIGHTS[1])
    runs = [deployed.wait(first), deployed.wait(following)]
    began = datetime.datetime.fromisoformat(runs[1]["start_time"])
    waited_s = (began - stopped).total_seconds()
    assert waited_s < NEXT_WITHIN_S, f"the next run began after {waited_s:.0f} s"
    assert published(deployed.out) == whole, "other bytes than of runs never stopped"
    return was_there, waited_s


def main() -> None:
    """Stop at random moments; print what came out."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--stops", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--pending", type=int, default=600)
    asked = parser.parse_args()
    rng, counts, faults, waits = random.Random(asked.seed), Counter[str](), 0, []
    with tempfile.TemporaryDirectory(prefix="stopped-deployments-") as folder:
        deployed = Deployed(Path(folder), asked.pending)
        try:
            for night in NIGHTS:
                deployed.wait(deployed.ask(night))
            whole = published(deployed.out)
            for number in range(1, asked.stops + 1):
                by = rng.choice([signal.SIGKILL, signal.SIGKILL, signal.SIGTERM])
                what = rng.choice(["server", "worker", "run"])
                stop = Stop(what, rng.uniform(0.0, RUN_S), by)
                try:
                    was_there, waited_s = stop_once(deployed, stop, whole)
                    waits.append(waited_s)
                    ended = f"the next began after {waited_s:.0f} s"
                    counts[f"{what} {by.name} {'' if was_there else '(not there)'}"] += 1
                except AssertionError as error:
                    faults += 1
                    ended = f"FAULT: {error}"
                print(f"{number}: {stop}: {ended}", flush=True)
        finally:
            deployed.end()
    for what, count in sorted(counts.items()):
        print(f"{count:5} {what}")
    print(f"{faults} faults; the next run began within {max(waits, default=0):.0f} s")
    sys.exit(faults > 0)


if __name__ == "__main__":
    main()
